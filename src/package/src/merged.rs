//! A stack of extracted layers, read as one tree.
//!
//! The layers are other people's: each is a tree whose links, device nodes and sizes mean nothing good. So the
//! stack is walked by directory descriptors, as an overlay mount would merge it, without following any link.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use rustix::fs::{Dir, FileType, Mode, OFlags};
use rustix::io::Errno;

use crate::{Error, read};

/// The most names in one directory.
pub(crate) const MAX_FILES: usize = 20_000;

const DIRECTORY: OFlags = OFlags::RDONLY
    .union(OFlags::DIRECTORY)
    .union(OFlags::NOFOLLOW)
    .union(OFlags::CLOEXEC);
const FILE: OFlags = OFlags::RDONLY
    .union(OFlags::NOFOLLOW)
    .union(OFlags::NONBLOCK)
    .union(OFlags::CLOEXEC);

/// Opens extracted trees, given lowest first; the uppermost comes first.
pub(crate) fn open<L: AsRef<Path>>(layers: &[L]) -> Result<Vec<Level>, Error> {
    let mut stack = Vec::new();
    for layer in layers.iter().rev() {
        let path = layer.as_ref().to_owned();
        // The layers' own paths are ours, and may lead through links.
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let directory = rustix::fs::open(&path, flags, Mode::empty())
            .map_err(|error| read::failed("open", &path, error))?;
        stack.push(Level { directory, path });
    }
    Ok(stack)
}

/// A regular file.
pub(crate) struct File {
    pub(crate) bytes: Vec<u8>,
    pub(crate) executable: bool,
}

impl Level {
    /// A file in this part; none for a link, a deletion or anything else that is no file.
    pub(crate) fn file(&self, name: &[u8], limit: u64) -> Result<Option<File>, Error> {
        let path = self.path.join(shown(name));
        let file = match rustix::fs::openat(&self.directory, name, FILE, Mode::empty()) {
            Ok(file) => file,
            Err(Errno::LOOP | Errno::NXIO | Errno::NODEV | Errno::NOENT) => return Ok(None),
            Err(error) => return Err(read::failed("open", &path, error)),
        };
        let stat =
            rustix::fs::fstat(&file).map_err(|error| read::failed("look at", &path, error))?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
            return Ok(None);
        }
        Ok(Some(File {
            bytes: read::bytes(file, &path, limit)?,
            executable: stat.st_mode & 0o111 != 0,
        }))
    }

    /// Whether a name in this part is a file that somebody may execute.
    pub(crate) fn is_executable(&self, name: &[u8]) -> bool {
        let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
        rustix::fs::statat(&self.directory, name, flags).is_ok_and(|stat| {
            FileType::from_raw_mode(stat.st_mode) == FileType::RegularFile
                && stat.st_mode & 0o111 != 0
        })
    }

    /// Where a link in this part leads, unless it is none.
    pub(crate) fn link(&self, name: &[u8]) -> Option<PathBuf> {
        let target = rustix::fs::readlinkat(&self.directory, name, Vec::new()).ok()?;
        Some(PathBuf::from(OsStr::from_bytes(target.as_bytes())))
    }
}

/// One layer's part of a directory.
pub(crate) struct Level {
    directory: OwnedFd,
    pub(crate) path: PathBuf,
}

/// A directory as an overlay mount shows it: its parts, the uppermost first.
pub(crate) struct Merged {
    levels: Vec<Level>,
}

impl Merged {
    /// The directory at a path such as `usr/share`.
    pub(crate) fn at(stack: &[Level], path: &str) -> Result<Self, Error> {
        let parts = path
            .split('/')
            .filter(|part| !part.is_empty() && *part != ".");
        let mut merged = Self::top(stack)?;
        for part in parts {
            merged = merged.below(part.as_bytes())?;
        }
        Ok(merged)
    }

    fn top(stack: &[Level]) -> Result<Self, Error> {
        let levels = stack.iter().map(|level| {
            let directory = level
                .directory
                .try_clone()
                .map_err(|error| read::failed("open", &level.path, error))?;
            Ok(Level {
                directory,
                path: level.path.clone(),
            })
        });
        Ok(Self {
            levels: levels.collect::<Result<_, Error>>()?,
        })
    }

    /// A directory in this one; one without parts if there is none.
    pub(crate) fn below(&self, name: &[u8]) -> Result<Self, Error> {
        let mut levels = Vec::new();
        for level in &self.levels {
            let path = level.path.join(shown(name));
            match rustix::fs::openat(&level.directory, name, DIRECTORY, Mode::empty()) {
                Ok(directory) => {
                    let opaque = is_opaque(&directory);
                    levels.push(Level { directory, path });
                    if opaque {
                        break;
                    }
                }
                Err(Errno::NOENT) => {}
                // A file, a link or a deletion: it hides what the layers below have.
                Err(Errno::NOTDIR | Errno::LOOP | Errno::NXIO) => break,
                Err(error) => return Err(read::failed("open", &path, error)),
            }
        }
        Ok(Self { levels })
    }

    /// All names in it, each with the uppermost level that has it.
    pub(crate) fn names(&self) -> Result<BTreeMap<Vec<u8>, &Level>, Error> {
        let mut names = BTreeMap::new();
        for level in &self.levels {
            let failed = |error| read::failed("list", &level.path, error);
            for entry in Dir::read_from(level.directory.as_fd()).map_err(failed)? {
                let name = entry.map_err(failed)?.file_name().to_bytes().to_vec();
                names.entry(name).or_insert(level);
            }
            if names.len() > MAX_FILES {
                return Err(Error::TooMany {
                    path: level.path.clone(),
                    what: "files",
                    limit: MAX_FILES,
                });
            }
        }
        Ok(names)
    }
}

/// Whether a directory hides those of its name in the layers below.
fn is_opaque(directory: &OwnedFd) -> bool {
    ["trusted.overlay.opaque", "user.overlay.opaque"]
        .iter()
        .any(|name| {
            let mut value = [0; 4];
            rustix::fs::fgetxattr(directory, *name, &mut value[..])
                .is_ok_and(|length| &value[..length] == b"y")
        })
}

fn shown(name: &[u8]) -> PathBuf {
    PathBuf::from(String::from_utf8_lossy(name).into_owned())
}
