//! Results so far, one file per run: an interrupted evaluation continues where it stopped, and the report says which
//! results exist and which do not.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::interrupt;
use crate::report::current_date;
use crate::section::{MissingMeasurement, Section};

/// Directory of the results.
pub struct RunCache {
    directory: PathBuf,
    /// Digest of the inputs that all runs depend on.
    basis: String,
    begun: Instant,
    /// Requested runs so far: time of the measurement, and result.
    used: Mutex<BTreeMap<String, (String, Value)>>,
}

/// Result of one run, as stored.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct CachedRun {
    /// Inputs of the run; it is measured again when they change.
    of: Value,
    measured: Value,
    /// Time of the measurement by this machine's clock, such as `2026-11-25 18:20`.
    on: String,
}

/// Result of a run, measured now or earlier.
#[derive(Debug, Clone)]
pub enum CachedResult<T> {
    /// The measurement.
    Done(T),
    /// The reason why there is none.
    Missing(String),
}

impl<T> CachedResult<T> {
    /// Returns the measurement, if there is one.
    pub fn value(&self) -> Option<&T> {
        match self {
            Self::Done(measured) => Some(measured),
            Self::Missing(_) => None,
        }
    }

    /// Returns the measurement; without one, lists it in the section as missing, with the next step.
    pub fn require(&self, section: &mut Section, what: impl Into<String>, next: &str) -> Option<&T> {
        match self {
            Self::Done(measured) => Some(measured),
            Self::Missing(why) => {
                let missing = MissingMeasurement::new(what, why, next);
                section.missing.push(missing);
                None
            }
        }
    }
}

impl RunCache {
    /// Opens a directory of results; with `fresh` they are deleted.
    pub fn new(directory: PathBuf, fresh: bool) -> Result<Self> {
        if fresh {
            match std::fs::remove_dir_all(&directory) {
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    return Err(error).context(directory.display().to_string());
                }
                _ => {}
            }
        }
        std::fs::create_dir_all(&directory).with_context(|| directory.display().to_string())?;
        Ok(Self { directory, basis: String::new(), begun: Instant::now(), used: Mutex::default() })
    }

    /// Sets the digest of common inputs; results with another one are measured again.
    pub fn with_basis(mut self, basis: String) -> Self {
        self.basis = basis;
        self
    }

    /// Logs progress, with the time since the beginning of the evaluation.
    fn log_progress(&self, words: &str) {
        let seconds = self.begun.elapsed().as_secs();
        eprintln!("{:3}:{:02}  {words}", seconds / 60, seconds % 60);
    }

    /// Returns the result of the run `name`, from the directory or by calling `run`. A failure is logged, and the run
    /// is repeated next time.
    pub fn measure<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        of: &impl Serialize,
        run: impl FnOnce() -> Result<T>,
    ) -> Result<CachedResult<T>> {
        let of = serde_json::to_value((&self.basis, of))?;
        if let Some((on, measured)) = self.load(name, &of) {
            self.log_progress(&format!("{name}: measured before, {on}"));
            self.record_use(name, on, serde_json::to_value(&measured)?);
            return Ok(CachedResult::Done(measured));
        }
        self.log_progress(name);
        let begun = Instant::now();
        match interrupt::ensure_not_requested().and_then(|()| run()) {
            Ok(measured) => {
                let took = begun.elapsed().as_secs_f64();
                self.log_progress(&format!("{name}: {took:.0} s"));
                let cell = CachedRun { of, measured: serde_json::to_value(&measured)?, on: current_date() };
                self.store(name, &cell)?;
                self.record_use(name, cell.on, cell.measured);
                Ok(CachedResult::Done(measured))
            }
            Err(error) => {
                self.log_progress(&format!("{name}: not measured: {error:#}"));
                Ok(CachedResult::Missing(format!("{error:#}")))
            }
        }
    }

    /// Returns the raw results of all requested runs by name; maps are reduced to their sizes.
    pub fn used_figures(&self) -> BTreeMap<String, Value> {
        let used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        let measured = used.iter().map(|(name, (_, measured))| (name, measured));
        measured.map(|(name, measured)| (name.clone(), measured.clone())).collect()
    }

    /// Returns the times of the oldest and the newest result; `None` without results.
    pub fn dates(&self) -> Option<(String, String)> {
        let used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        let dates = || used.values().map(|(on, _)| on);
        Some((dates().min()?.clone(), dates().max()?.clone()))
    }

    fn record_use(&self, name: &str, on: String, mut measured: Value) {
        remove_cells(&mut measured);
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.insert(name.to_owned(), (on, measured));
    }

    fn path(&self, name: &str) -> PathBuf {
        let name: String =
            name.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '-' }).collect();
        self.directory.join(format!("{name}.json"))
    }

    /// Returns a stored result; `None` if it is incomplete or has other inputs.
    fn load<T: DeserializeOwned>(&self, name: &str, of: &Value) -> Option<(String, T)> {
        let text = std::fs::read(self.path(name)).ok()?;
        let cell: CachedRun = serde_json::from_slice(&text).ok()?;
        let measured = (cell.of == *of).then(|| serde_json::from_value(cell.measured).ok())?;
        Some((cell.on, measured?))
    }

    /// Stores a result atomically, by renaming a complete file.
    fn store(&self, name: &str, cell: &CachedRun) -> Result<()> {
        let path = self.path(name);
        let half = path.with_extension("half");
        std::fs::write(&half, serde_json::to_vec(cell)?).with_context(|| half.display().to_string())?;
        Ok(std::fs::rename(half, path)?)
    }
}

/// Removes the cells of maps ([`crate::trace::MapGrid`]): the report has images of them, and they are a hundred times
/// as large as the rest.
fn remove_cells(value: &mut Value) {
    match value {
        Value::Array(all) => all.iter_mut().for_each(remove_cells),
        Value::Object(fields) => {
            if fields.contains_key("resolution") {
                fields.remove("cells");
            }
            fields.values_mut().for_each(remove_cells);
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use anyhow::bail;

    use super::*;

    fn new_cache() -> (tempfile::TempDir, RunCache) {
        let place = tempfile::tempdir().expect("a directory");
        let cells = RunCache::new(place.path().join("cells"), false).expect("a directory of cells");
        (place, cells)
    }

    #[test]
    fn what_was_measured_is_not_measured_again() {
        let (_place, cells) = new_cache();
        let first = cells.measure("a/b", &1, || Ok(41)).expect("it is kept");
        assert_eq!(first.value(), Some(&41));
        let again = cells.measure("a/b", &1, || bail!("it ran again"));
        assert_eq!(again.expect("it is read").value(), Some(&41));
    }

    #[test]
    fn another_plan_is_measured_anew() {
        let (_place, cells) = new_cache();
        cells.measure("a", &1, || Ok(41)).expect("it is kept");
        let other = cells.measure("a", &2, || Ok(42)).expect("it is kept");
        assert_eq!(other.value(), Some(&42));
    }

    #[test]
    fn another_basis_is_measured_anew() {
        let (place, cells) = new_cache();
        cells.measure("a", &1, || Ok(41)).expect("it is kept");
        let later = RunCache::new(place.path().join("cells"), false).expect("a directory");
        let later = later.with_basis("other packages".to_owned());
        let anew = later.measure("a", &1, || Ok(42)).expect("it is kept");
        assert_eq!(anew.value(), Some(&42));
    }

    #[test]
    fn what_failed_or_was_cut_off_is_tried_again() {
        let (_place, cells) = new_cache();
        let failed = cells.measure::<u32>("a", &1, || bail!("no such file"));
        assert!(matches!(failed, Ok(CachedResult::Missing(why)) if why == "no such file"));
        std::fs::write(cells.path("a"), b"{\"of\": 1, \"measu").expect("a file that was cut off");
        let again = cells.measure("a", &1, || Ok(7)).expect("it is kept");
        assert_eq!(again.value(), Some(&7));
    }

    #[test]
    fn raw_figures_are_those_of_the_runs_that_were_asked_for() {
        let (place, cells) = new_cache();
        let run = serde_json::json!([0.1234567, {"map": {"width": 1, "resolution": 0.5, "cells": [0]}}]);
        let told = serde_json::json!([0.1234567, {"map": {"width": 1, "resolution": 0.5}}]);
        cells.measure("a", &1, || Ok(run)).expect("it is kept");
        cells.measure("b", &1, || Ok(2)).expect("it is kept");
        assert_eq!(cells.used_figures()["a"], told);
        let later = RunCache::new(place.path().join("cells"), false).expect("a directory");
        let again = later.measure::<Value>("a", &1, || bail!("it ran again"));
        assert!(again.expect("it is read").value().is_some());
        assert_eq!(later.used_figures(), BTreeMap::from([("a".to_owned(), told)]));
    }

    #[test]
    fn the_oldest_and_the_newest_run_are_known() {
        let (place, cells) = new_cache();
        assert_eq!(cells.dates(), None);
        cells.measure("a", &1, || Ok(1)).expect("it is kept");
        let old = r#"{"of": ["", 1], "measured": 2, "on": "2001-02-03 04:05"}"#;
        std::fs::write(cells.path("b"), old).expect("a run of another day");
        let later = RunCache::new(place.path().join("cells"), false).expect("a directory");
        for name in ["a", "b"] {
            let known = later.measure::<u32>(name, &1, || bail!("it ran again"));
            assert!(known.expect("it is read").value().is_some());
        }
        let (oldest, newest) = later.dates().expect("two runs");
        assert_eq!(oldest, "2001-02-03 04:05");
        assert!(newest > oldest, "{newest}");
    }

    #[test]
    fn a_fresh_evaluation_forgets() {
        let (place, cells) = new_cache();
        cells.measure("a", &1, || Ok(1)).expect("it is kept");
        let fresh = RunCache::new(place.path().join("cells"), true).expect("a directory");
        let anew = fresh.measure("a", &1, || Ok(2)).expect("it is kept");
        assert_eq!(anew.value(), Some(&2));
    }
}
