//! What no type can say of a configuration's values, each and together.

use super::{Codec, Config, MOST};
use crate::terms;

/// A key whose value cannot be.
#[derive(Debug, thiserror::Error)]
#[error("{key} {reason}")]
pub(super) struct Wrong {
    pub(super) key: &'static str,
    /// The reason, and what to do.
    reason: String,
}

impl Config {
    /// What no type can say.
    pub(super) fn check(&self) -> Result<(), Wrong> {
        let wrong = |key, reason| Err(Wrong { key, reason });
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
                    "({desired}) is less than frames_per_second ({least}), which is the least that will do; raise it, or lower frames_per_second"
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

    /// What must hold once all that say something have been heard.
    pub(super) fn check_whole(&self) -> Result<(), Wrong> {
        let without = |key, other| {
            let reason = format!("is given without {other}; set {other}, too, or remove {key}");
            Err(Wrong { key, reason })
        };
        if self.quality.is_some() && self.codec != Codec::Jpeg {
            return without("quality", "codec = \"jpeg\"");
        }
        if self.request.is_some() && self.requests.is_some() {
            let reason = "and requests are both given; remove one".to_owned();
            return Err(Wrong {
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
