//! A stack of extracted layers, read as one tree.
//!
//! The layers are other people's: each is a tree whose links, device nodes and sizes mean nothing good. So the
//! stack is walked by directory descriptors, as an overlay mount would merge it, without following any link and
//! without leaving any layer ([`foreign`]).

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use foreign::{Found, Tree};
use rustix::fs::{Dir, FileType};

use crate::{Error, read};

/// The most names in one directory.
pub(crate) const MAX_FILES: usize = 20_000;

/// Opens extracted trees, given lowest first; the uppermost comes first.
pub(crate) fn open<L: AsRef<Path>>(layers: &[L]) -> Result<Vec<Level>, Error> {
    let layers = layers.iter().rev();
    layers
        .map(|layer| Ok(Level(Tree::open(layer.as_ref())?)))
        .collect()
}

/// One layer's part of a directory.
pub(crate) struct Level(Tree);

impl Level {
    /// A file in this part; none for a link, a deletion or anything else that is no file.
    pub(crate) fn file(&self, name: &[u8], limit: u64) -> Result<Option<foreign::File>, Error> {
        match self.0.file(OsStr::from_bytes(name), limit) {
            Err(foreign::Error::NotAFile { .. }) => Ok(None),
            read => Ok(read?),
        }
    }

    /// Whether a name in this part is a file that somebody may execute.
    pub(crate) fn is_executable(&self, name: &[u8]) -> bool {
        let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
        rustix::fs::statat(self.0.as_fd(), name, flags).is_ok_and(|stat| {
            FileType::from_raw_mode(stat.st_mode) == FileType::RegularFile
                && stat.st_mode & 0o111 != 0
        })
    }

    /// Whether a name in this part says that the layers below have nothing of it.
    pub(crate) fn is_deletion(&self, name: &[u8]) -> bool {
        let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
        rustix::fs::statat(self.0.as_fd(), name, flags)
            .is_ok_and(|stat| FileType::from_raw_mode(stat.st_mode) == FileType::CharacterDevice)
    }

    /// Where a link in this part leads, unless it is none.
    pub(crate) fn link(&self, name: &[u8]) -> Option<PathBuf> {
        let target = rustix::fs::readlinkat(self.0.as_fd(), name, Vec::new()).ok()?;
        Some(PathBuf::from(OsStr::from_bytes(target.as_bytes())))
    }

    /// For messages.
    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }
}

/// A directory as an overlay mount shows it: its parts, the uppermost first.
pub(crate) struct Merged {
    levels: Vec<Level>,
}

impl Merged {
    /// The directory at a path such as `usr/share`. `..` leads up, and at the top nowhere, as it does for a process
    /// whose root this is.
    pub(crate) fn at(stack: &[Level], path: &str) -> Result<Self, Error> {
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
        let mut merged = Self::top(stack)?;
        for part in parts {
            merged = merged.below(part.as_bytes())?;
        }
        Ok(merged)
    }

    fn top(stack: &[Level]) -> Result<Self, Error> {
        let levels = stack.iter().map(|level| Ok(Level(level.0.try_clone()?)));
        Ok(Self {
            levels: levels.collect::<Result<_, Error>>()?,
        })
    }

    /// Whether there is such a directory.
    pub(crate) fn exists(&self) -> bool {
        !self.levels.is_empty()
    }

    /// A directory in this one; one without parts if there is none.
    pub(crate) fn below(&self, name: &[u8]) -> Result<Self, Error> {
        let mut levels = Vec::new();
        for level in &self.levels {
            match level.0.directory(OsStr::from_bytes(name))? {
                Found::Directory(directory) => {
                    let opaque = is_opaque(&directory);
                    levels.push(Level(directory));
                    if opaque {
                        break;
                    }
                }
                Found::Nothing => {}
                // A file, a link or a deletion: it hides what the layers below have.
                Found::SomethingElse => break,
            }
        }
        Ok(Self { levels })
    }

    /// All names in it, each with the uppermost level that has it.
    pub(crate) fn names(&self) -> Result<BTreeMap<Vec<u8>, &Level>, Error> {
        let mut names = BTreeMap::new();
        for level in &self.levels {
            let failed = |error| read::failed("list", level.path(), error);
            for entry in Dir::read_from(level.0.as_fd()).map_err(failed)? {
                let name = entry.map_err(failed)?.file_name().to_bytes().to_vec();
                if name != b"." && name != b".." {
                    names.entry(name).or_insert(level);
                }
            }
            if names.len() > MAX_FILES {
                return Err(Error::TooMany {
                    path: level.path().to_owned(),
                    what: "files",
                    limit: MAX_FILES,
                });
            }
        }
        Ok(names)
    }
}

/// Whether a directory hides those of its name in the layers below.
fn is_opaque(directory: &Tree) -> bool {
    ["trusted.overlay.opaque", "user.overlay.opaque"]
        .iter()
        .any(|name| {
            let mut value = [0; 4];
            rustix::fs::fgetxattr(directory.as_fd(), *name, &mut value[..])
                .is_ok_and(|length| &value[..length] == b"y")
        })
}
