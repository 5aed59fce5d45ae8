//! Parameters that were refused, as one error.

use std::fmt::Display;

use ros::bus::BusError;

/// Maximum number of refused parameters that an error names.
const MAX_NAMED_PARAMETERS: usize = 5;
/// Maximum number of characters of a reason, which a node may have given.
const MAX_REASON_LENGTH: usize = 200;

/// Refused parameters with their reasons. Only the first ones are remembered.
#[derive(Debug, Default, PartialEq)]
pub(super) struct RefusedParameters {
    named: Vec<(String, String)>,
    others: usize,
}

impl RefusedParameters {
    /// Adds a parameter.
    pub(super) fn add(&mut self, parameter: &str, reason: &dyn Display) {
        if self.named.len() >= MAX_NAMED_PARAMETERS {
            self.others += 1;
            return;
        }
        let reason = reason.to_string().chars().take(MAX_REASON_LENGTH).collect();
        self.named.push((parameter.to_owned(), reason));
    }

    /// Returns the error of a change of `key`, if a part of it was refused.
    pub(super) fn into_result(self, key: &str) -> Result<(), BusError> {
        let mut named = self.named.into_iter();
        let Some((first, reason)) = named.next() else {
            return Ok(());
        };
        let mut all = reason;
        for (parameter, reason) in named {
            all.push_str(&format!("; {parameter}: {reason}"));
        }
        if self.others > 0 {
            all.push_str(&format!("; and {} more", self.others));
        }
        if first != key {
            all.push_str(&format!(" (the others of {key} are set)"));
        }
        Err(BusError::BadParam { key: first, reason: all })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_first_refused_parameters() {
        assert!(RefusedParameters::default().into_result("/a").is_ok());
        let mut one = RefusedParameters::default();
        one.add("/a", &"why");
        assert_eq!(one.into_result("/a").expect_err("refused").to_string(), "parameter /a cannot be sent: why");
        let mut many = RefusedParameters::default();
        (0..8).for_each(|number| many.add(&format!("/see:p{number}"), &"x".repeat(1000)));
        let error = many.into_result("/see").expect_err("refused").to_string();
        assert!(error.starts_with("parameter /see:p0 cannot be sent: xxx"), "{error}");
        assert!(error.contains("; /see:p4: ") && !error.contains("p5"), "{error}");
        assert!(error.ends_with("; and 3 more (the others of /see are set)") && error.len() < 1200, "{error}");
    }
}
