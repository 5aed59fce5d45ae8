//! Files that are written atomically.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// A temporary file that is renamed to its target when complete, and removed otherwise.
pub struct AtomicFile {
    /// The temporary file, open for writing.
    pub file: File,
    path: PathBuf,
    target: PathBuf,
}

impl AtomicFile {
    /// Creates the temporary file in the directory of `target`, which stays as it is.
    pub fn create_beside(target: &Path) -> anyhow::Result<AtomicFile> {
        let Some(name) = target.file_name() else {
            bail!("{} is not a file name; pass one with -o FILE", target.display());
        };
        let part = format!(".{}.{}.part", name.to_string_lossy(), std::process::id());
        let path = target.with_file_name(part);
        let file = File::create(&path).with_context(|| format!("cannot write {}", target.display()))?;
        Ok(AtomicFile { file, path, target: target.to_owned() })
    }

    /// Returns the context for write errors.
    pub fn error_context(&self) -> String {
        format!("cannot write {}", self.target.display())
    }

    /// Renames the file to its target; an existing file is replaced.
    pub fn persist(&self) -> anyhow::Result<()> {
        self.file.sync_all().with_context(|| self.error_context())?;
        std::fs::rename(&self.path, &self.target).with_context(|| self.error_context())
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        // Usually it has been renamed already.
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
        drop(AtomicFile::create_beside(&target).expect("begun"));
        let names = std::fs::read_dir(directory.path()).expect("listed").count();
        assert_eq!(names, 1);
        let half = AtomicFile::create_beside(&target).expect("begun");
        (&half.file).write_all(b"new").expect("written");
        half.persist().expect("named");
        drop(half);
        assert_eq!(std::fs::read(&target).expect("there"), b"new");
    }
}
