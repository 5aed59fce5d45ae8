//! Files that appear whole or not at all.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// A file that gets its name when it is whole, and is removed if that does not come.
pub struct Half {
    /// What is written.
    pub file: File,
    path: PathBuf,
    target: PathBuf,
}

impl Half {
    /// Makes it beside `target`, which stays as it is.
    pub fn beside(target: &Path) -> anyhow::Result<Half> {
        let Some(name) = target.file_name() else {
            bail!("{} names no file; give one with -o FILE", target.display());
        };
        let part = format!(".{}.{}.part", name.to_string_lossy(), std::process::id());
        let path = target.with_file_name(part);
        let file =
            File::create(&path).with_context(|| format!("cannot write {}", target.display()))?;
        Ok(Half {
            file,
            path,
            target: target.to_owned(),
        })
    }

    /// What cannot be done, for an error.
    pub fn failed(&self) -> String {
        format!("cannot write {}", self.target.display())
    }

    /// Gives it its name; an earlier file of that name is replaced.
    pub fn publish(&self) -> anyhow::Result<()> {
        self.file.sync_all().with_context(|| self.failed())?;
        std::fs::rename(&self.path, &self.target).with_context(|| self.failed())
    }
}

impl Drop for Half {
    fn drop(&mut self) {
        // It has its own name already, mostly.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn a_file_that_is_not_whole_leaves_nothing() {
        let directory = tempfile::tempdir().expect("a directory");
        let target = directory.path().join("x.tar");
        std::fs::write(&target, "earlier").expect("written");
        drop(Half::beside(&target).expect("begun"));
        let names = std::fs::read_dir(directory.path()).expect("listed").count();
        assert_eq!(names, 1);
        let half = Half::beside(&target).expect("begun");
        (&half.file).write_all(b"new").expect("written");
        half.publish().expect("named");
        drop(half);
        assert_eq!(std::fs::read(&target).expect("there"), b"new");
    }
}
