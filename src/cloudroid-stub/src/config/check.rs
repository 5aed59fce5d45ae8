//! Checks of a configuration's values, alone and together, that types cannot express.

use super::{CodecSetting, Config, MAX_NUMBER, OUTPUT_MEASURES};
use crate::terms;

/// A key with an invalid value.
#[derive(Debug, thiserror::Error)]
#[error("{key} {reason}")]
pub(super) struct InvalidSetting {
    pub(super) key: &'static str,
    /// Reason, and what to do.
    reason: String,
}

impl Config {
    /// Checks the values of all keys.
    pub(super) fn check(&self) -> Result<(), InvalidSetting> {
        let wrong = |key, reason| Err(InvalidSetting { key, reason });
        let measured = OUTPUT_MEASURES.iter().flat_map(|measure| {
            let [desired, bound] = measure.values(self);
            [(measure.desired_key, desired), (measure.key, bound)]
        });
        let times = [
            ("desire", self.desire),
            ("max", self.max),
            ("threshold", self.threshold),
            ("initial", self.initial),
            ("fallback_after", Some(self.fallback_after)),
            ("call_limit", Some(self.call_limit)),
        ];
        for (key, value) in times.into_iter().chain(measured) {
            if let Some(value) = value.filter(|value| !(*value > 0.0 && *value < MAX_NUMBER)) {
                let reason = format!("is {value}; it should be a number greater than 0 and less than {MAX_NUMBER}");
                return wrong(key, reason);
            }
        }
        if let Err((key, reason)) = terms::check(self) {
            return wrong(key, reason);
        }
        if let Some(quality) = self.quality.filter(|quality| !(1.0..=100.0).contains(quality)) {
            let reason = format!("is {quality}; it should be a number from 1 to 100");
            return wrong("quality", reason);
        }
        if let Some(cap) = self.cap.filter(|cap| cap.is_nan() || *cap <= 0.0) {
            let reason = format!("is {cap}; it should be a number greater than threshold");
            return wrong("cap", reason);
        }
        for measure in &OUTPUT_MEASURES {
            if let Some(reason) = measure.find_contradiction(self) {
                return wrong(measure.desired_key, reason);
            }
        }
        if let Some((desire, max)) = self.desire.zip(self.max).filter(|(desire, max)| desire > max) {
            let reason = format!("({desire} s) is greater than max ({max} s); lower it, or raise max");
            return wrong("desire", reason);
        }
        Ok(())
    }

    /// Checks the combination of keys, after all sources have been merged.
    pub(super) fn check_combined(&self) -> Result<(), InvalidSetting> {
        let without = |key, other| {
            let reason = format!("is given without {other}; set {other}, too, or remove {key}");
            Err(InvalidSetting { key, reason })
        };
        if self.quality.is_some() && self.codec != CodecSetting::Jpeg {
            return without("quality", "codec = \"jpeg\"");
        }
        if self.request.is_some() && self.requests.is_some() {
            let reason = "and requests are both given; remove one".to_owned();
            return Err(InvalidSetting { key: "request", reason });
        }
        for measure in &OUTPUT_MEASURES {
            if let [Some(_), None] = measure.values(self) {
                return without(measure.desired_key, measure.key);
            }
        }
        match (self.desire, self.max) {
            (Some(_), None) => without("desire", "max"),
            (None, Some(_)) => without("max", "desire"),
            _ => Ok(()),
        }
    }
}
