//! Confined file creation below a directory with untrusted content: no file can be created anywhere else.
//!
//! Every directory on the path is opened by `openat2`, which confines symbolic links, even absolute ones, to the root
//! (`RESOLVE_IN_ROOT`) or rejects them (`RESOLVE_BENEATH | RESOLVE_NO_SYMLINKS`); the last component is only used
//! relative to the open directory and is not followed.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::rc::Rc;

use rustix::fs::{AtFlags, FileType, Mode, OFlags, ResolveFlags, Stat};
use rustix::io::Errno;

use crate::names::split;

/// A root directory, with a cache of the last directory opened, since entries mostly come sorted.
pub(crate) struct ConfinedRoot {
    root: OwnedFd,
    resolve: ResolveFlags,
    last: Option<(Vec<u8>, Rc<OwnedFd>)>,
}

const DIRECTORY: OFlags = OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::CLOEXEC);

impl ConfinedRoot {
    /// Opens a root in which symbolic links in the middle of a path are resolved as if `root` were `/`.
    pub(crate) fn following_links(root: &Path) -> Result<Self, Errno> {
        Self::new(root, ResolveFlags::IN_ROOT | ResolveFlags::NO_MAGICLINKS)
    }

    /// Opens a root in which symbolic links in the middle of a path are errors (`ELOOP`).
    pub(crate) fn without_links(root: &Path) -> Result<Self, Errno> {
        Self::new(root, ResolveFlags::BENEATH | ResolveFlags::NO_SYMLINKS)
    }

    fn new(root: &Path, resolve: ResolveFlags) -> Result<Self, Errno> {
        let root = rustix::fs::open(root, DIRECTORY | OFlags::NOFOLLOW, Mode::empty())?;
        Ok(Self { root, resolve, last: None })
    }

    pub(crate) fn root(&self) -> BorrowedFd<'_> {
        self.root.as_fd()
    }

    /// Opens the directory at `path` (empty for the root).
    pub(crate) fn directory(&mut self, path: &[u8]) -> Result<Rc<OwnedFd>, Errno> {
        if let Some((known, directory)) = &self.last {
            if known == path {
                return Ok(Rc::clone(directory));
            }
        }
        let name = if path.is_empty() { &b"."[..] } else { path };
        let directory = Rc::new(rustix::fs::openat2(&self.root, name, DIRECTORY, Mode::empty(), self.resolve)?);
        self.last = Some((path.to_vec(), Rc::clone(&directory)));
        Ok(directory)
    }

    /// Opens the directory at `path`, creating it and its missing parents.
    pub(crate) fn make_directory(&mut self, path: &[u8]) -> Result<Rc<OwnedFd>, Errno> {
        match self.directory(path) {
            Err(Errno::NOENT) if !path.is_empty() => {
                let (above, name) = split(path);
                let above = self.make_directory(above)?;
                match rustix::fs::mkdirat(&*above, name, Mode::from_raw_mode(0o755)) {
                    // If this is a dangling link, the second lookup fails.
                    Ok(()) | Err(Errno::EXIST) => self.directory(path),
                    Err(error) => Err(error),
                }
            }
            other => other,
        }
    }

    /// Clears the cache, because a component of the path was replaced.
    pub(crate) fn invalidate_cache(&mut self) {
        self.last = None;
    }
}

/// Returns the metadata of `name` without following a link; `None` if it does not exist.
pub(crate) fn stat_entry(directory: &OwnedFd, name: &[u8]) -> Result<Option<Stat>, Errno> {
    match rustix::fs::statat(directory, name, AtFlags::SYMLINK_NOFOLLOW) {
        Ok(stat) => Ok(Some(stat)),
        Err(Errno::NOENT) => Ok(None),
        Err(error) => Err(error),
    }
}

pub(crate) fn is_kind(stat: &Stat, kind: FileType) -> bool {
    FileType::from_raw_mode(stat.st_mode) == kind
}

/// Creates a file for writing; `EEXIST` if the name exists.
pub(crate) fn create(directory: &OwnedFd, name: &[u8]) -> Result<OwnedFd, Errno> {
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    rustix::fs::openat(directory, name, flags, Mode::from_raw_mode(0o600))
}

/// Opens the directory `name` without following a link.
pub(crate) fn open_directory(directory: &OwnedFd, name: &[u8]) -> Result<OwnedFd, Errno> {
    rustix::fs::openat(directory, name, DIRECTORY | OFlags::NOFOLLOW, Mode::empty())
}
