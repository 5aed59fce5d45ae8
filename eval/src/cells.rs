//! What was measured so far, one file for each run: an evaluation that was cut off goes on where it stopped, and the report tells of what is
//! there and of what is not.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::interrupt;

/// Runs that were measured.
pub struct Cells {
    directory: PathBuf,
    /// What all of them depend on.
    basis: String,
    begun: Instant,
}

/// One run.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Cell {
    /// What it depends on; another one is measured anew.
    of: Value,
    measured: Value,
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
        if let Some(measured) = self.known(name, &of) {
            self.tell(&format!("{name}: measured before"));
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
                };
                self.keep(name, &cell)?;
                Ok(Measured::Done(measured))
            }
            Err(error) => {
                self.tell(&format!("{name}: not measured: {error:#}"));
                Ok(Measured::Missing(format!("{error:#}")))
            }
        }
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
    fn known<T: DeserializeOwned>(&self, name: &str, of: &Value) -> Option<T> {
        let text = std::fs::read(self.path(name)).ok()?;
        let cell: Cell = serde_json::from_slice(&text).ok()?;
        (cell.of == *of).then(|| serde_json::from_value(cell.measured).ok())?
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
    fn a_fresh_evaluation_forgets() {
        let (place, cells) = cells();
        cells.measure("a", &1, || Ok(1)).expect("it is kept");
        let fresh = Cells::new(place.path().join("cells"), true).expect("a directory");
        let anew = fresh.measure("a", &1, || Ok(2)).expect("it is kept");
        assert_eq!(anew.done(), Some(&2));
    }
}
