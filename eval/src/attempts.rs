//! Remembers what has failed in this run of the evaluation: a push that takes minutes is not repeated for each run that
//! needs its service.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use anyhow::{Result, anyhow};

/// Errors, by the name of what failed.
static FAILED: Mutex<BTreeMap<String, String>> = Mutex::new(BTreeMap::new());

/// Runs `does`, unless it has failed before under this name.
///
/// # Errors
/// If it fails, or has failed before: then the error repeats the earlier one. The next run of the evaluation tries
/// again.
pub fn try_once(name: &str, does: impl FnOnce() -> Result<()>) -> Result<()> {
    let failed = || FAILED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(why) = failed().get(name) {
        return Err(anyhow!("{why} (it failed before in this run and was not tried again)"));
    }
    does().inspect_err(|error| {
        failed().insert(name.to_owned(), format!("{error:#}"));
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_failed_is_not_tried_again() {
        let mut tries = 0;
        let mut fails = || {
            try_once("test: fails", || {
                tries += 1;
                Err(anyhow!("no compiler"))
            })
        };
        assert_eq!(fails().expect_err("it fails").to_string(), "no compiler");
        let again = fails().expect_err("it has failed");
        assert!(again.to_string().starts_with("no compiler (it failed before"));
        assert_eq!(tries, 1);
        try_once("test: another", || Ok(())).expect("it is another");
    }
}
