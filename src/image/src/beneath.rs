//! Makes files below a directory whose content is untrusted, so that none can appear anywhere else.
//!
//! Every directory on the way is opened by `openat2`, which keeps even symbolic links to absolute paths inside
//! (`RESOLVE_IN_ROOT`) or refuses them (`RESOLVE_BENEATH | RESOLVE_NO_SYMLINKS`); the last name is only ever used
//! relative to the open directory and without following it.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::rc::Rc;

use rustix::fs::{AtFlags, FileType, Mode, OFlags, ResolveFlags, Stat};
use rustix::io::Errno;

use crate::names::split;

/// The root, and the directory that was used last: entries mostly come sorted.
pub(crate) struct Beneath {
    root: OwnedFd,
    resolve: ResolveFlags,
    last: Option<(Vec<u8>, Rc<OwnedFd>)>,
}

const DIRECTORY: OFlags = OFlags::RDONLY
    .union(OFlags::DIRECTORY)
    .union(OFlags::CLOEXEC);

impl Beneath {
    /// Symbolic links in the middle of a path lead where they would lead if `root` were `/`.
    pub(crate) fn following(root: &Path) -> Result<Self, Errno> {
        Self::new(root, ResolveFlags::IN_ROOT | ResolveFlags::NO_MAGICLINKS)
    }

    /// Symbolic links in the middle of a path are errors (`ELOOP`).
    pub(crate) fn strict(root: &Path) -> Result<Self, Errno> {
        Self::new(root, ResolveFlags::BENEATH | ResolveFlags::NO_SYMLINKS)
    }

    fn new(root: &Path, resolve: ResolveFlags) -> Result<Self, Errno> {
        let root = rustix::fs::open(root, DIRECTORY | OFlags::NOFOLLOW, Mode::empty())?;
        Ok(Self {
            root,
            resolve,
            last: None,
        })
    }

    pub(crate) fn root(&self) -> BorrowedFd<'_> {
        self.root.as_fd()
    }

    /// The directory at `path` (empty for the root).
    pub(crate) fn directory(&mut self, path: &[u8]) -> Result<Rc<OwnedFd>, Errno> {
        if let Some((known, directory)) = &self.last {
            if known == path {
                return Ok(Rc::clone(directory));
            }
        }
        let name = if path.is_empty() { &b"."[..] } else { path };
        let directory = Rc::new(rustix::fs::openat2(
            &self.root,
            name,
            DIRECTORY,
            Mode::empty(),
            self.resolve,
        )?);
        self.last = Some((path.to_vec(), Rc::clone(&directory)));
        Ok(directory)
    }

    /// The same, made with all above it where it is missing.
    pub(crate) fn make_directory(&mut self, path: &[u8]) -> Result<Rc<OwnedFd>, Errno> {
        match self.directory(path) {
            Err(Errno::NOENT) if !path.is_empty() => {
                let (above, name) = split(path);
                let above = self.make_directory(above)?;
                match rustix::fs::mkdirat(&*above, name, Mode::from_raw_mode(0o755)) {
                    // A dangling link, then: the second look says so.
                    Ok(()) | Err(Errno::EXIST) => self.directory(path),
                    Err(error) => Err(error),
                }
            }
            other => other,
        }
    }

    /// Forgets the last directory: something on the way to it was replaced.
    pub(crate) fn forget(&mut self) {
        self.last = None;
    }
}

/// What is at `name`, not following a link.
pub(crate) fn look(directory: &OwnedFd, name: &[u8]) -> Result<Option<Stat>, Errno> {
    match rustix::fs::statat(directory, name, AtFlags::SYMLINK_NOFOLLOW) {
        Ok(stat) => Ok(Some(stat)),
        Err(Errno::NOENT) => Ok(None),
        Err(error) => Err(error),
    }
}

pub(crate) fn is(stat: &Stat, kind: FileType) -> bool {
    FileType::from_raw_mode(stat.st_mode) == kind
}

/// A new file for writing; `EEXIST` if anything has that name.
pub(crate) fn create(directory: &OwnedFd, name: &[u8]) -> Result<OwnedFd, Errno> {
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    rustix::fs::openat(directory, name, flags, Mode::from_raw_mode(0o600))
}

/// The directory `name` itself, not one a link of that name points to.
pub(crate) fn open_directory(directory: &OwnedFd, name: &[u8]) -> Result<OwnedFd, Errno> {
    rustix::fs::openat(directory, name, DIRECTORY | OFlags::NOFOLLOW, Mode::empty())
}
