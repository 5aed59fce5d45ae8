//! Reading of single files and directories of a stack of layers, by absolute path and through no link.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::Error;
use crate::merged::{self, LayerDirectory, MergedDirectory};

/// A stack of layers.
pub(super) struct View {
    stack: Vec<LayerDirectory>,
}

impl View {
    /// Opens extracted trees, given lowest first.
    pub(super) fn open<L: AsRef<Path>>(layers: &[L]) -> Result<Self, Error> {
        Ok(Self { stack: merged::open_layers(layers)? })
    }

    /// Opens a directory; the result is empty if it does not exist.
    pub(super) fn directory(&self, path: &str) -> Result<MergedDirectory, Error> {
        MergedDirectory::open_path(&self.stack, path)
    }

    /// Returns whether a directory exists.
    pub(super) fn has_directory(&self, path: &str) -> Result<bool, Error> {
        Ok(self.directory(path)?.exists())
    }

    /// Returns the names in a directory that are text and not deleted; empty if it does not exist.
    pub(super) fn names(&self, path: &str) -> Result<BTreeSet<String>, Error> {
        let directory = self.directory(path)?;
        let names = directory.names()?.into_iter().filter(|(name, level)| !level.is_deletion(name));
        Ok(names.filter_map(|(name, _)| String::from_utf8(name).ok()).collect())
    }

    /// Reads a file; `None` if there is no regular file at the path.
    pub(super) fn read(&self, path: &str, limit: u64) -> Result<Option<Vec<u8>>, Error> {
        let Some((parent, name)) = path.rsplit_once('/') else {
            return Ok(None);
        };
        let directory = self.directory(parent)?;
        let names = directory.names()?;
        let Some(level) = names.get(name.as_bytes()) else {
            return Ok(None);
        };
        Ok(level.file(name.as_bytes(), limit)?.map(|file| file.bytes))
    }

    /// Reads a file as text, in which invalid bytes are replaced.
    pub(super) fn read_text(&self, path: &str, limit: u64) -> Result<Option<String>, Error> {
        Ok(self.read(path, limit)?.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()))
    }

    /// Returns the target of a link; `None` if the path is not one.
    pub(super) fn read_link(&self, path: &str) -> Result<Option<PathBuf>, Error> {
        let Some((parent, name)) = path.rsplit_once('/') else {
            return Ok(None);
        };
        let directory = self.directory(parent)?;
        Ok(directory.names()?.get(name.as_bytes()).and_then(|level| level.link(name.as_bytes())))
    }
}
