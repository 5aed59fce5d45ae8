//! Checks of a configuration's values, alone and together, that types cannot express.

use super::{CodecSetting, Config, MOST};
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
        for (key, value) in [
            ("desire", self.desire),
            ("max", self.max),
            ("age", self.age),
            ("desired_age", self.desired_age),
            ("frames_per_second", self.frames_per_second),
            ("desired_frames_per_second", self.desired_frames_per_second),
            ("threshold", self.threshold),
            ("initial", self.initial),
            ("fallback_after", Some(self.fallback_after)),
            ("call_limit", Some(self.call_limit)),
        ] {
            if let Some(value) = value.filter(|value| !(*value > 0.0 && *value < MOST)) {
                let reason = format!(
                    "is {value}; it should be a number greater than 0 and less than {MOST}"
                );
                return wrong(key, reason);
            }
        }
        if let Err((key, reason)) = terms::check(self) {
            return wrong(key, reason);
        }
        if let Some(quality) = self
            .quality
            .filter(|quality| !(1.0..=100.0).contains(quality))
        {
            let reason = format!("is {quality}; it should be a number from 1 to 100");
            return wrong("quality", reason);
        }
        if let Some(cap) = self.cap.filter(|cap| cap.is_nan() || *cap <= 0.0) {
            let reason = format!("is {cap}; it should be a number greater than threshold");
            return wrong("cap", reason);
        }
        if let (Some(desired), Some(least)) =
            (self.desired_frames_per_second, self.frames_per_second)
        {
            if desired < least {
                let reason = format!(
                    "({desired}) is less than frames_per_second ({least}), the minimum rate; raise it, or lower \
                        frames_per_second"
                );
                return wrong("desired_frames_per_second", reason);
            }
        }
        for (key, desired, (other, most)) in [
            ("desire", self.desire, ("max", self.max)),
            ("desired_age", self.desired_age, ("age", self.age)),
        ] {
            if let (Some(desired), Some(most)) = (desired, most) {
                if desired > most {
                    let reason = format!(
                        "({desired} s) is greater than {other} ({most} s); lower it, or raise {other}"
                    );
                    return wrong(key, reason);
                }
            }
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
            return Err(InvalidSetting {
                key: "request",
                reason,
            });
        }
        if self.desired_frames_per_second.is_some() && self.frames_per_second.is_none() {
            return without("desired_frames_per_second", "frames_per_second");
        }
        if self.desired_age.is_some() && self.age.is_none() {
            return without("desired_age", "age");
        }
        match (self.desire, self.max) {
            (Some(_), None) => without("desire", "max"),
            (None, Some(_)) => without("max", "desire"),
            _ => Ok(()),
        }
    }
}
