//! Merged view of a stack of extracted layers.
//!
//! The layers are untrusted: their links, device nodes and sizes may be malicious. So the stack is walked by directory
//! descriptors and merged like an overlay mount, without following links and without leaving any layer ([`foreign`]).

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use foreign::{DirectoryLookup, Tree};
use rustix::fs::{Dir, FileType};

use crate::{Error, read};

/// Maximum number of names in a directory.
pub(crate) const MAX_FILES: usize = 20_000;

/// Opens extracted trees, given lowest first; returns them uppermost first.
pub(crate) fn open_layers<L: AsRef<Path>>(layers: &[L]) -> Result<Vec<LayerDirectory>, Error> {
    let layers = layers.iter().rev();
    layers.map(|layer| Ok(LayerDirectory(Tree::open(layer.as_ref())?))).collect()
}

/// A directory in one layer.
pub(crate) struct LayerDirectory(Tree);

impl LayerDirectory {
    /// Reads a file in this layer; `None` for a link, a deletion or anything else that is not a file.
    pub(crate) fn file(&self, name: &[u8], limit: u64) -> Result<Option<foreign::File>, Error> {
        match self.0.read_file(OsStr::from_bytes(name), limit) {
            Err(foreign::Error::NotAFile { .. }) => Ok(None),
            read => Ok(read?),
        }
    }

    /// Returns whether a name in this layer is an executable file.
    pub(crate) fn is_executable(&self, name: &[u8]) -> bool {
        let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
        rustix::fs::statat(self.0.as_fd(), name, flags).is_ok_and(|stat| {
            FileType::from_raw_mode(stat.st_mode) == FileType::RegularFile && stat.st_mode & 0o111 != 0
        })
    }

    /// Returns whether a name in this layer deletes that of the layers below.
    pub(crate) fn is_deletion(&self, name: &[u8]) -> bool {
        let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
        rustix::fs::statat(self.0.as_fd(), name, flags)
            .is_ok_and(|stat| FileType::from_raw_mode(stat.st_mode) == FileType::CharacterDevice)
    }

    /// Returns the target of a link in this layer; `None` if it is not a link.
    pub(crate) fn link(&self, name: &[u8]) -> Option<PathBuf> {
        let target = rustix::fs::readlinkat(self.0.as_fd(), name, Vec::new()).ok()?;
        Some(PathBuf::from(OsStr::from_bytes(target.as_bytes())))
    }

    /// Returns the path, for messages.
    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }
}

/// A directory merged as by an overlay mount: the directories of the layers, uppermost first.
pub(crate) struct MergedDirectory {
    levels: Vec<LayerDirectory>,
}

impl MergedDirectory {
    /// Opens the directory at a path such as `usr/share`. `..` goes up, but not beyond the root, as in a process with
    /// this root directory.
    pub(crate) fn open_path(stack: &[LayerDirectory], path: &str) -> Result<Self, Error> {
        let mut parts = Vec::new();
        for part in path.split('/') {
            match part {
                "" | "." => {}
                ".." => {
                    parts.pop();
                }
                name => parts.push(name),
            }
        }
        let mut merged = Self::open_root(stack)?;
        for part in parts {
            merged = merged.open_child(part.as_bytes())?;
        }
        Ok(merged)
    }

    fn open_root(stack: &[LayerDirectory]) -> Result<Self, Error> {
        let levels = stack.iter().map(|level| Ok(LayerDirectory(level.0.try_clone()?)));
        Ok(Self { levels: levels.collect::<Result<_, Error>>()? })
    }

    /// Returns whether the directory exists.
    pub(crate) fn exists(&self) -> bool {
        !self.levels.is_empty()
    }

    /// Opens a subdirectory; the result is empty if it does not exist.
    pub(crate) fn open_child(&self, name: &[u8]) -> Result<Self, Error> {
        let mut levels = Vec::new();
        for level in &self.levels {
            match level.0.open_directory(OsStr::from_bytes(name))? {
                DirectoryLookup::Directory(directory) => {
                    let opaque = is_opaque(&directory);
                    levels.push(LayerDirectory(directory));
                    if opaque {
                        break;
                    }
                }
                DirectoryLookup::Nothing => {}
                // A file, a link or a deletion hides the layers below.
                DirectoryLookup::SomethingElse => break,
            }
        }
        Ok(Self { levels })
    }

    /// Returns all names in the directory, each with the uppermost layer that contains it.
    pub(crate) fn names(&self) -> Result<BTreeMap<Vec<u8>, &LayerDirectory>, Error> {
        let mut names = BTreeMap::new();
        for level in &self.levels {
            let failed = |error| read::file_error("list", level.path(), error);
            for entry in Dir::read_from(level.0.as_fd()).map_err(failed)? {
                let name = entry.map_err(failed)?.file_name().to_bytes().to_vec();
                if name != b"." && name != b".." {
                    names.entry(name).or_insert(level);
                }
            }
            if names.len() > MAX_FILES {
                return Err(Error::TooMany { path: level.path().to_owned(), what: "files", limit: MAX_FILES });
            }
        }
        Ok(names)
    }
}

/// Returns whether a directory hides those of its name in the layers below.
fn is_opaque(directory: &Tree) -> bool {
    ["trusted.overlay.opaque", "user.overlay.opaque"].iter().any(|name| {
        let mut value = [0; 4];
        rustix::fs::fgetxattr(directory.as_fd(), *name, &mut value[..]).is_ok_and(|length| &value[..length] == b"y")
    })
}
