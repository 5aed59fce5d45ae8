//! What failed in this run of the evaluation and would fail again: a push that takes minutes is not made once more for each run that needs
//! its service.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use anyhow::{Result, anyhow};

/// Why each thing failed, by its name.
static FAILED: Mutex<BTreeMap<String, String>> = Mutex::new(BTreeMap::new());

/// Does it, unless it has failed before.
///
/// # Errors
/// It fails, or has failed before: why it did then is said again. The next run of the evaluation tries it anew.
pub fn once(name: &str, does: impl FnOnce() -> Result<()>) -> Result<()> {
    let failed = || FAILED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(why) = failed().get(name) {
        return Err(anyhow!(
            "{why} (it failed before in this run and was not tried again)"
        ));
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
            once("test: fails", || {
                tries += 1;
                Err(anyhow!("no compiler"))
            })
        };
        assert_eq!(fails().expect_err("it fails").to_string(), "no compiler");
        let again = fails().expect_err("it has failed");
        assert!(
            again
                .to_string()
                .starts_with("no compiler (it failed before")
        );
        assert_eq!(tries, 1);
        once("test: another", || Ok(())).expect("it is another");
    }
}
