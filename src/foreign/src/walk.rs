//! Walking of a tree, by descriptors and without recursion.

use std::ffi::{CString, OsStr};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, Dir, FileType, Mode, Stat};
use rustix::io::Errno;

use crate::tree::{DIRECTORY, FILE, INSIDE_TREE, is_something_else};
use crate::{Error, cancel};

/// Maximum nesting depth of directories. Each level costs an open file during the walk.
pub const MAX_DEPTH: usize = 256;

/// Decision of the visitor on how the walk goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Visit {
    /// Enters a directory: its entries come next. Has no effect on other entries.
    Into,
    /// Skips the entries of a directory.
    Skip,
}

/// A file, directory, link or other entry of a tree.
#[derive(Debug)]
pub struct WalkEntry<'a> {
    parent: BorrowedFd<'a>,
    name: &'a CString,
    /// Path relative to the tree's root; empty for the root itself.
    pub path: &'a Path,
    /// Type, mode, owner, size and times.
    pub stat: Stat,
    root: &'a Path,
}

impl WalkEntry<'_> {
    /// Returns the type: file, directory, link or another.
    pub fn kind(&self) -> FileType {
        FileType::from_raw_mode(self.stat.st_mode)
    }

    /// Returns the name within its directory.
    pub fn name(&self) -> &OsStr {
        OsStr::from_bytes(self.name.as_bytes())
    }

    /// Returns the full path, for messages only: a component of it may have become a link meanwhile.
    pub fn display_path(&self) -> PathBuf {
        if self.path.as_os_str().is_empty() { self.root.to_owned() } else { self.root.join(self.path) }
    }

    /// Opens the file or directory for reading: the one that was visited, or an error.
    pub fn open(&self) -> Result<std::fs::File, Error> {
        let failed = |error: Errno| Error::file("open", &self.display_path(), error);
        let flags = if self.kind() == FileType::Directory { DIRECTORY } else { FILE };
        let file = rustix::fs::openat2(self.parent, self.name, flags, Mode::empty(), INSIDE_TREE).map_err(failed)?;
        let now = rustix::fs::fstat(&file).map_err(failed)?;
        if (now.st_dev, now.st_ino) != (self.stat.st_dev, self.stat.st_ino) {
            return Err(Error::NotAFile { path: self.display_path() });
        }
        Ok(file.into())
    }

    /// Returns the target of a link.
    pub fn read_link(&self) -> Result<Vec<u8>, Error> {
        rustix::fs::readlinkat(self.parent, self.name, Vec::new())
            .map(CString::into_bytes)
            .map_err(|error| Error::file("read the link", &self.display_path(), error))
    }

    /// Returns the parent directory and the name in it, for calls that take these two and follow no link.
    pub fn parent_and_name(&self) -> (BorrowedFd<'_>, &CString) {
        (self.parent, self.name)
    }
}

/// Calls `visit` for the root and everything below it: a directory before its entries, entries sorted by the bytes of
/// their names.
///
/// # Errors
/// [`Error::TooDeep`] below [`MAX_DEPTH`] directories, the first error of the system or of `visit`, and
/// [`Error::Cancelled`].
pub fn walk<E: From<Error>>(root: &Path, visit: impl FnMut(&WalkEntry<'_>) -> Result<Visit, E>) -> Result<(), E> {
    Walker { root, changing: false, visit }.run()
}

/// Walks like [`walk`] a tree that other processes change meanwhile: entries that disappear after they were listed are
/// skipped.
pub fn walk_changing<E: From<Error>>(
    root: &Path,
    visit: impl FnMut(&WalkEntry<'_>) -> Result<Visit, E>,
) -> Result<(), E> {
    Walker { root, changing: true, visit }.run()
}

struct Walker<'a, V> {
    root: &'a Path,
    changing: bool,
    visit: V,
}

/// A directory whose entries are being visited.
struct WalkLevel {
    directory: OwnedFd,
    /// Entries still to be visited, in reverse order.
    left: Vec<CString>,
}

impl<V> Walker<'_, V> {
    fn run<E: From<Error>>(mut self) -> Result<(), E>
    where
        V: FnMut(&WalkEntry<'_>) -> Result<Visit, E>,
    {
        let mut path = PathBuf::new();
        let failed = |error: Errno| Error::file("open", self.root, error);
        let top = rustix::fs::open(self.root, DIRECTORY, Mode::empty()).map_err(failed)?;
        let here = c".".to_owned();
        let entry = WalkEntry {
            parent: top.as_fd(),
            name: &here,
            path: &path,
            stat: rustix::fs::fstat(&top).map_err(failed)?,
            root: self.root,
        };
        if (self.visit)(&entry)? == Visit::Skip {
            return Ok(());
        }
        let mut stack = vec![WalkLevel { left: self.names(&top, &path)?, directory: top }];
        while let Some(level) = stack.last_mut() {
            let Some(name) = level.left.pop() else {
                stack.pop();
                path.pop();
                continue;
            };
            cancel::check().map_err(Error::from)?;
            path.push(OsStr::from_bytes(name.as_bytes()));
            let below = self.visit_child::<E>(&level.directory, &name, &path)?;
            match below {
                Some(_) if stack.len() >= MAX_DEPTH => {
                    return Err(Error::TooDeep { path: self.root.join(&path), limit: MAX_DEPTH }.into());
                }
                Some(directory) => stack.push(WalkLevel { left: self.names(&directory, &path)?, directory }),
                None => {
                    path.pop();
                }
            }
        }
        Ok(())
    }

    /// Visits one entry; returns a directory whose entries are to be visited next.
    fn visit_child<E: From<Error>>(
        &mut self,
        parent: &OwnedFd,
        name: &CString,
        path: &Path,
    ) -> Result<Option<OwnedFd>, E>
    where
        V: FnMut(&WalkEntry<'_>) -> Result<Visit, E>,
    {
        let stat = match rustix::fs::statat(parent, name, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) => stat,
            Err(Errno::NOENT) if self.changing => return Ok(None),
            Err(error) => return Err(Error::file("look at", &self.root.join(path), error).into()),
        };
        let entry = WalkEntry { parent: parent.as_fd(), name, path, stat, root: self.root };
        let visit = (self.visit)(&entry)?;
        if visit == Visit::Skip || entry.kind() != FileType::Directory {
            return Ok(None);
        }
        match rustix::fs::openat2(parent, name, DIRECTORY, Mode::empty(), INSIDE_TREE) {
            Ok(directory) => Ok(Some(directory)),
            Err(error) if self.changing && is_something_else(error) => Ok(None),
            Err(error) => Err(Error::file("open", &self.root.join(path), error).into()),
        }
    }

    fn names(&self, directory: &OwnedFd, path: &Path) -> Result<Vec<CString>, Error> {
        let mut names = names(directory).map_err(|error| Error::file("list", &self.root.join(path), error))?;
        names.sort_unstable_by(|a, b| b.cmp(a));
        Ok(names)
    }
}

/// Returns the names in a directory, without `.` and `..`, unordered.
pub(crate) fn names(directory: &OwnedFd) -> Result<Vec<CString>, Errno> {
    let mut names = Vec::new();
    for entry in Dir::read_from(directory)? {
        let entry = entry?;
        let name = entry.file_name();
        if name != c"." && name != c".." {
            names.push(name.to_owned());
        }
    }
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cancel::Cancel;

    fn visited_paths(root: &Path) -> Result<Vec<String>, Error> {
        let mut seen = Vec::new();
        walk(root, |entry| {
            seen.push(entry.path.display().to_string());
            Ok::<_, Error>(if entry.name() == "skipped" { Visit::Skip } else { Visit::Into })
        })?;
        Ok(seen)
    }

    #[test]
    fn everything_is_seen_in_order_and_links_are_not_followed() {
        let place = tempfile::tempdir().expect("a directory");
        for directory in ["b/c", "skipped/x"] {
            std::fs::create_dir_all(place.path().join(directory)).expect("made");
        }
        std::fs::write(place.path().join("b/c/f"), "").expect("written");
        std::fs::write(place.path().join("b.txt"), "").expect("written");
        std::os::unix::fs::symlink("/", place.path().join("a")).expect("linked");
        let expected = ["", "a", "b", "b/c", "b/c/f", "b.txt", "skipped"];
        assert_eq!(visited_paths(place.path()).expect("walked"), expected);
    }

    #[test]
    fn a_tree_that_is_too_deep_is_refused() {
        let place = tempfile::tempdir().expect("a directory");
        let levels = |count: usize| vec!["d"; count].join("/");
        std::fs::create_dir_all(place.path().join(levels(MAX_DEPTH - 1))).expect("made");
        assert_eq!(visited_paths(place.path()).expect("walked").len(), MAX_DEPTH);
        std::fs::create_dir_all(place.path().join(levels(MAX_DEPTH))).expect("made");
        let refused = visited_paths(place.path()).expect_err("too deep");
        assert!(matches!(refused, Error::TooDeep { .. }), "{refused}");
    }

    #[test]
    fn a_walk_ends_when_it_is_cancelled() {
        let place = tempfile::tempdir().expect("a directory");
        for number in 0..10 {
            std::fs::write(place.path().join(number.to_string()), "").expect("written");
        }
        let cancel = Cancel::default();
        let mut count = 0;
        let ended = cancel.run(|| {
            walk(place.path(), |_| {
                count += 1;
                if count == 3 {
                    cancel.cancel();
                }
                Ok::<_, Error>(Visit::Into)
            })
        });
        assert!(matches!(ended, Err(Error::Cancelled(_))), "{ended:?}");
        assert_eq!(count, 3);
    }
}
