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
use crate::section::{AGAIN, Section};
use crate::statistics::{Spread, quantile};
use crate::words::PERCENTILES;

/// Runs of a measurement in a whole evaluation.
pub const REPEATS: usize = 3;

/// Directory of the results.
pub struct RunCache {
    directory: PathBuf,
    basis: String,
    repeats: usize,
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

/// The runs of one measurement, made now or earlier.
#[derive(Debug, Clone)]
pub struct Runs<T> {
    pub done: Vec<T>,
    pub missing: Option<String>,
}

impl<T> Default for Runs<T> {
    fn default() -> Self {
        Self { done: Vec::new(), missing: None }
    }
}

impl<T> From<T> for Runs<T> {
    fn from(result: T) -> Self {
        Self { done: vec![result], missing: None }
    }
}

impl<T> Runs<T> {
    pub fn from_failure(why: impl Into<String>) -> Self {
        Self { done: Vec::new(), missing: Some(why.into()) }
    }

    /// Returns the first result, which is the one that is drawn.
    pub fn first(&self) -> Option<&T> {
        self.done.first()
    }

    /// Returns the first result; lists runs without one in the section as missing.
    pub fn require(&self, section: &mut Section, what: &str) -> Option<&T> {
        if let Some(why) = &self.missing {
            section.add_missing(what, why, AGAIN);
        }
        self.first()
    }

    /// Returns a figure of all runs that have it: its median and its spread.
    pub fn figure(&self, find: impl Fn(&T) -> Option<f64>) -> Option<Spread> {
        Spread::from_values(&self.done.iter().filter_map(find).collect::<Vec<_>>())
    }

    /// Returns p50, p95 and p99 of times.
    pub fn percentiles(&self, times: impl Fn(&T) -> Vec<f64>) -> [Option<Spread>; 3] {
        PERCENTILES.map(|fraction| self.figure(|run| quantile(&times(run), fraction)))
    }

    /// Returns a figure of each run and the run of another measurement that was made with it.
    pub fn compare<U>(&self, other: &Runs<U>, find: impl Fn(&T, &U) -> Option<f64>) -> Option<Spread> {
        let pairs = self.done.iter().zip(&other.done);
        Spread::from_values(&pairs.filter_map(|(one, other)| find(one, other)).collect::<Vec<_>>())
    }
}

impl RunCache {
    /// Opens a directory of results; with `fresh` they are deleted. Results of another `basis`, a digest of common
    /// inputs, are measured again. Measurements are repeated `repeats` times.
    pub fn new(directory: PathBuf, fresh: bool, basis: String, repeats: usize) -> Result<Self> {
        if fresh {
            match std::fs::remove_dir_all(&directory) {
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    return Err(error).context(directory.display().to_string());
                }
                _ => {}
            }
        }
        std::fs::create_dir_all(&directory).with_context(|| directory.display().to_string())?;
        Ok(Self { directory, basis, repeats, begun: Instant::now(), used: Mutex::default() })
    }

    /// Logs progress, with the time since the beginning of the evaluation.
    fn log_progress(&self, words: &str) {
        let seconds = self.begun.elapsed().as_secs();
        eprintln!("{:3}:{:02}  {words}", seconds / 60, seconds % 60);
    }

    /// Returns the names of the runs of a repeated measurement.
    pub fn run_names(&self, name: &str) -> Vec<String> {
        (1..=self.repeats).map(|run| if run == 1 { name.to_owned() } else { format!("{name} run {run}") }).collect()
    }

    /// Returns all runs of a measurement: those that are stored, and the others by calling `run`.
    pub fn repeat<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        of: &impl Serialize,
        mut run: impl FnMut() -> Result<T>,
    ) -> Result<Runs<T>> {
        let mut runs = Runs::default();
        for name in self.run_names(name) {
            self.add_run(&mut runs, &name, of, &mut run)?;
        }
        Ok(runs)
    }

    pub fn measure<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        of: &impl Serialize,
        run: impl FnOnce() -> Result<T>,
    ) -> Result<Runs<T>> {
        let mut runs = Runs::default();
        self.add_run(&mut runs, name, of, run)?;
        Ok(runs)
    }

    /// Adds the run `name`, from the directory or by calling `run`. A failure is logged, and the run is repeated next
    /// time.
    pub fn add_run<T: Serialize + DeserializeOwned>(
        &self,
        runs: &mut Runs<T>,
        name: &str,
        of: &impl Serialize,
        run: impl FnOnce() -> Result<T>,
    ) -> Result<()> {
        let of = serde_json::to_value((&self.basis, of))?;
        if let Some((on, measured)) = self.load(name, &of) {
            self.log_progress(&format!("{name}: measured before, {on}"));
            self.record_use(name, on, serde_json::to_value(&measured)?);
            runs.done.push(measured);
            return Ok(());
        }
        self.log_progress(name);
        let begun = Instant::now();
        match interrupt::ensure_not_requested().and_then(|()| run()) {
            Ok(measured) => {
                self.log_progress(&format!("{name}: {:.0} s", begun.elapsed().as_secs_f64()));
                let cell = CachedRun { of, measured: serde_json::to_value(&measured)?, on: current_date() };
                self.store(name, &cell)?;
                self.record_use(name, cell.on, cell.measured);
                runs.done.push(measured);
            }
            Err(error) => {
                self.log_progress(&format!("{name}: not measured: {error:#}"));
                runs.missing.get_or_insert(format!("{error:#}"));
            }
        }
        Ok(())
    }

    /// Returns the raw results of all requested runs by name; maps are reduced to their sizes.
    pub fn used_figures(&self) -> BTreeMap<String, Value> {
        let used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.iter().map(|(name, (_, measured))| (name.clone(), measured.clone())).collect()
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
        let name = name.replace(|letter: char| !letter.is_ascii_alphanumeric(), "-");
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

    fn open(place: &tempfile::TempDir, basis: &str, repeats: usize) -> RunCache {
        RunCache::new(place.path().join("cells"), false, basis.to_owned(), repeats).expect("a directory of cells")
    }

    #[test]
    fn what_was_measured_is_not_measured_again() {
        let place = tempfile::tempdir().expect("a directory");
        let cells = open(&place, "", 1);
        assert_eq!(cells.measure("a/b", &1, || Ok(41)).expect("it is kept").done, [41]);
        assert_eq!(cells.measure::<i32>("a/b", &1, || bail!("it ran again")).expect("it is read").done, [41]);
        assert_eq!(cells.measure("a/b", &2, || Ok(42)).expect("another plan").done, [42]);
        assert_eq!(open(&place, "others", 1).measure("a/b", &2, || Ok(43)).expect("another basis").done, [43]);
        let fresh = RunCache::new(place.path().join("cells"), true, "others".to_owned(), 1).expect("a directory");
        assert_eq!(fresh.measure("a/b", &2, || Ok(44)).expect("anew").done, [44]);
    }

    /// Each run is kept by itself, so that an interrupted measurement goes on with the runs that it lacks.
    #[test]
    fn a_figure_is_the_median_of_its_runs() {
        let place = tempfile::tempdir().expect("a directory");
        let mut next = [Some(1.0), None, Some(5.0), Some(3.0)].into_iter();
        let mut measure = || next.next().flatten().context("no such file");
        let cells = open(&place, "", REPEATS);
        let runs = cells.repeat("a", &1, &mut measure).expect("two are kept");
        assert_eq!((runs.done, runs.missing.as_deref()), (vec![1.0, 5.0], Some("no such file")));
        let runs = cells.repeat("a", &1, &mut measure).expect("the third is kept");
        let figure = runs.figure(|value| Some(*value)).expect("values");
        assert_eq!((figure.low, figure.median, figure.high), (1.0, 3.0, 5.0));
        let twice = runs.compare(&runs, |one, other| Some(one + other)).expect("values");
        assert_eq!(twice.median, 6.0);
        assert!(next.next().is_none());
    }

    #[test]
    fn what_was_cut_off_is_tried_again() {
        let place = tempfile::tempdir().expect("a directory");
        let cells = open(&place, "", 1);
        std::fs::write(cells.path("a"), b"{\"of\": 1, \"measu").expect("a file that was cut off");
        assert_eq!(cells.measure("a", &1, || Ok(7)).expect("it is kept").done, [7]);
    }

    #[test]
    fn raw_figures_are_those_of_the_runs_that_were_asked_for() {
        let place = tempfile::tempdir().expect("a directory");
        let cells = open(&place, "", 1);
        let run = serde_json::json!([0.1234567, {"map": {"width": 1, "resolution": 0.5, "cells": [0]}}]);
        let told = serde_json::json!([0.1234567, {"map": {"width": 1, "resolution": 0.5}}]);
        cells.measure("a", &1, || Ok(run)).expect("it is kept");
        cells.measure("b", &1, || Ok(2)).expect("it is kept");
        assert_eq!(cells.used_figures()["a"], told);
        let later = open(&place, "", 1);
        later.measure::<Value>("a", &1, || bail!("it ran again")).expect("it is read");
        assert_eq!(later.used_figures(), BTreeMap::from([("a".to_owned(), told)]));
    }

    #[test]
    fn the_oldest_and_the_newest_run_are_known() {
        let place = tempfile::tempdir().expect("a directory");
        let cells = open(&place, "", 1);
        assert_eq!(cells.dates(), None);
        let old = r#"{"of": ["", 1], "measured": 2, "on": "2001-02-03 04:05"}"#;
        std::fs::write(cells.path("b"), old).expect("a run of another day");
        for name in ["a", "b"] {
            cells.measure(name, &1, || Ok(1)).expect("it is kept");
        }
        let (oldest, newest) = cells.dates().expect("two runs");
        assert!(oldest == "2001-02-03 04:05" && newest > oldest, "{newest}");
    }
}
