//! What was measured so far, one file for each run: an evaluation that was cut off goes on where it stopped, and the report tells of what is
//! there and of what is not.

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
use crate::report::date;

/// Runs that were measured.
pub struct Cells {
    directory: PathBuf,
    /// What all of them depend on.
    basis: String,
    begun: Instant,
    /// What was asked for so far: when it was measured, and what came out.
    used: Mutex<BTreeMap<String, (String, Value)>>,
}

/// One run.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Cell {
    /// What it depends on; another one is measured anew.
    of: Value,
    measured: Value,
    /// When: `2026-11-25 18:20`, by this machine's clock.
    on: String,
}

/// What a run came to.
#[derive(Debug, Clone)]
pub enum Measured<T> {
    /// This.
    Done(T),
    /// Nothing, because of this.
    Missing(String),
}

impl<T> Measured<T> {
    /// What was measured.
    pub fn done(&self) -> Option<&T> {
        match self {
            Self::Done(measured) => Some(measured),
            Self::Missing(_) => None,
        }
    }
}

impl Cells {
    /// Those of a directory; none of them where `fresh`.
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
        Ok(Self {
            directory,
            basis: String::new(),
            begun: Instant::now(),
            used: Mutex::default(),
        })
    }

    /// Runs that were measured with another `basis` are measured anew.
    pub fn based_on(mut self, basis: String) -> Self {
        self.basis = basis;
        self
    }

    /// Says how a run goes, with the time since the evaluation's beginning.
    fn tell(&self, words: &str) {
        let seconds = self.begun.elapsed().as_secs();
        eprintln!("{:3}:{:02}  {words}", seconds / 60, seconds % 60);
    }

    /// The run of this name, measured unless that was done before. What cannot be measured is told, and tried again the next time.
    pub fn measure<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        of: &impl Serialize,
        run: impl FnOnce() -> Result<T>,
    ) -> Result<Measured<T>> {
        let of = serde_json::to_value((&self.basis, of))?;
        if let Some((on, measured)) = self.known(name, &of) {
            self.tell(&format!("{name}: measured before, {on}"));
            self.note(name, on, serde_json::to_value(&measured)?);
            return Ok(Measured::Done(measured));
        }
        self.tell(name);
        let begun = Instant::now();
        match interrupt::none().and_then(|()| run()) {
            Ok(measured) => {
                let took = begun.elapsed().as_secs_f64();
                self.tell(&format!("{name}: {took:.0} s"));
                let cell = Cell {
                    of,
                    measured: serde_json::to_value(&measured)?,
                    on: date(),
                };
                self.keep(name, &cell)?;
                self.note(name, cell.on, cell.measured);
                Ok(Measured::Done(measured))
            }
            Err(error) => {
                self.tell(&format!("{name}: not measured: {error:#}"));
                Ok(Measured::Missing(format!("{error:#}")))
            }
        }
    }

    /// Raw figures of all runs that were asked for and are there, by their names; of maps, their sizes without their cells.
    pub fn used(&self) -> BTreeMap<String, Value> {
        let used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        let measured = used.iter().map(|(name, (_, measured))| (name, measured));
        measured
            .map(|(name, measured)| (name.clone(), measured.clone()))
            .collect()
    }

    /// When the oldest and the newest of them were measured; none where there are none.
    pub fn dates(&self) -> Option<(String, String)> {
        let used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        let dates = || used.values().map(|(on, _)| on);
        Some((dates().min()?.clone(), dates().max()?.clone()))
    }

    fn note(&self, name: &str, on: String, mut measured: Value) {
        without_cells(&mut measured);
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.insert(name.to_owned(), (on, measured));
    }

    fn path(&self, name: &str) -> PathBuf {
        let name: String = name
            .chars()
            .map(|letter| {
                if letter.is_ascii_alphanumeric() {
                    letter
                } else {
                    '-'
                }
            })
            .collect();
        self.directory.join(format!("{name}.json"))
    }

    /// None where it was never measured whole, or depended on something else.
    fn known<T: DeserializeOwned>(&self, name: &str, of: &Value) -> Option<(String, T)> {
        let text = std::fs::read(self.path(name)).ok()?;
        let cell: Cell = serde_json::from_slice(&text).ok()?;
        let measured = (cell.of == *of).then(|| serde_json::from_value(cell.measured).ok())?;
        Some((cell.on, measured?))
    }

    /// Under its name when it is whole.
    fn keep(&self, name: &str, cell: &Cell) -> Result<()> {
        let path = self.path(name);
        let half = path.with_extension("half");
        std::fs::write(&half, serde_json::to_vec(cell)?)
            .with_context(|| half.display().to_string())?;
        Ok(std::fs::rename(half, path)?)
    }
}

/// Takes the cells from maps ([`crate::trace::Grid`]): pictures of them are drawn, and they are a hundred times what is left.
fn without_cells(value: &mut Value) {
    match value {
        Value::Array(all) => all.iter_mut().for_each(without_cells),
        Value::Object(fields) => {
            if fields.contains_key("resolution") {
                fields.remove("cells");
            }
            fields.values_mut().for_each(without_cells);
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use anyhow::bail;

    use super::*;

    fn cells() -> (tempfile::TempDir, Cells) {
        let place = tempfile::tempdir().expect("a directory");
        let cells = Cells::new(place.path().join("cells"), false).expect("a directory of cells");
        (place, cells)
    }

    #[test]
    fn what_was_measured_is_not_measured_again() {
        let (_place, cells) = cells();
        let first = cells.measure("a/b", &1, || Ok(41)).expect("it is kept");
        assert_eq!(first.done(), Some(&41));
        let again = cells.measure("a/b", &1, || bail!("it ran again"));
        assert_eq!(again.expect("it is read").done(), Some(&41));
    }

    #[test]
    fn another_plan_is_measured_anew() {
        let (_place, cells) = cells();
        cells.measure("a", &1, || Ok(41)).expect("it is kept");
        let other = cells.measure("a", &2, || Ok(42)).expect("it is kept");
        assert_eq!(other.done(), Some(&42));
    }

    #[test]
    fn another_basis_is_measured_anew() {
        let (place, cells) = cells();
        cells.measure("a", &1, || Ok(41)).expect("it is kept");
        let later = Cells::new(place.path().join("cells"), false).expect("a directory");
        let later = later.based_on("other packages".to_owned());
        let anew = later.measure("a", &1, || Ok(42)).expect("it is kept");
        assert_eq!(anew.done(), Some(&42));
    }

    #[test]
    fn what_failed_or_was_cut_off_is_tried_again() {
        let (_place, cells) = cells();
        let failed = cells.measure::<u32>("a", &1, || bail!("no such file"));
        assert!(matches!(failed, Ok(Measured::Missing(why)) if why == "no such file"));
        std::fs::write(cells.path("a"), b"{\"of\": 1, \"measu").expect("a file that was cut off");
        let again = cells.measure("a", &1, || Ok(7)).expect("it is kept");
        assert_eq!(again.done(), Some(&7));
    }

    #[test]
    fn raw_figures_are_those_of_the_runs_that_were_asked_for() {
        let (place, cells) = cells();
        let run =
            serde_json::json!([0.1234567, {"map": {"width": 1, "resolution": 0.5, "cells": [0]}}]);
        let told = serde_json::json!([0.1234567, {"map": {"width": 1, "resolution": 0.5}}]);
        cells.measure("a", &1, || Ok(run)).expect("it is kept");
        cells.measure("b", &1, || Ok(2)).expect("it is kept");
        assert_eq!(cells.used()["a"], told);
        let later = Cells::new(place.path().join("cells"), false).expect("a directory");
        let again = later.measure::<Value>("a", &1, || bail!("it ran again"));
        assert!(again.expect("it is read").done().is_some());
        assert_eq!(later.used(), BTreeMap::from([("a".to_owned(), told)]));
    }

    #[test]
    fn the_oldest_and_the_newest_run_are_known() {
        let (place, cells) = cells();
        assert_eq!(cells.dates(), None);
        cells.measure("a", &1, || Ok(1)).expect("it is kept");
        let old = r#"{"of": ["", 1], "measured": 2, "on": "2001-02-03 04:05"}"#;
        std::fs::write(cells.path("b"), old).expect("a run of another day");
        let later = Cells::new(place.path().join("cells"), false).expect("a directory");
        for name in ["a", "b"] {
            let known = later.measure::<u32>(name, &1, || bail!("it ran again"));
            assert!(known.expect("it is read").done().is_some());
        }
        let (oldest, newest) = later.dates().expect("two runs");
        assert_eq!(oldest, "2001-02-03 04:05");
        assert!(newest > oldest, "{newest}");
    }

    #[test]
    fn a_fresh_evaluation_forgets() {
        let (place, cells) = cells();
        cells.measure("a", &1, || Ok(1)).expect("it is kept");
        let fresh = Cells::new(place.path().join("cells"), true).expect("a directory");
        let anew = fresh.measure("a", &1, || Ok(2)).expect("it is kept");
        assert_eq!(anew.done(), Some(&2));
    }
}
