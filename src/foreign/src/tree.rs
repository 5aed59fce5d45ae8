//! Reading of single files of a tree.

use std::ffi::OsString;
use std::io::Read;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};

use rustix::fs::{FileType, Mode, OFlags, ResolveFlags};
use rustix::io::Errno;

use crate::Error;

/// Resolves paths inside the tree only, and through no link.
pub(crate) const INSIDE_TREE: ResolveFlags =
    ResolveFlags::BENEATH.union(ResolveFlags::NO_SYMLINKS).union(ResolveFlags::NO_MAGICLINKS);
/// Resolves paths inside the tree only, through links that stay in it.
const FOLLOWING: ResolveFlags = ResolveFlags::BENEATH.union(ResolveFlags::NO_MAGICLINKS);
/// Non-blocking, because opening a pipe would wait for its other end.
pub(crate) const FILE: OFlags =
    OFlags::RDONLY.union(OFlags::NOFOLLOW).union(OFlags::NONBLOCK).union(OFlags::NOCTTY).union(OFlags::CLOEXEC);
pub(crate) const DIRECTORY: OFlags =
    OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);

/// A directory of a tree, held by its descriptor, so that renames and links above it have no effect.
#[derive(Debug)]
pub struct Tree {
    directory: OwnedFd,
    path: PathBuf,
}

/// Result of looking up a path that should be a directory.
#[derive(Debug)]
pub enum DirectoryLookup {
    /// A directory.
    Directory(Tree),
    /// A file, link, device or the like; or the path leads out of the tree.
    SomethingElse,
    /// There is no such entry.
    Nothing,
}

/// Content of a regular file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct File {
    /// The whole content.
    pub bytes: Vec<u8>,
    /// One of the execute bits is set.
    pub executable: bool,
}

impl Tree {
    /// Opens the root of a tree. The path is trusted and may contain links.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let directory =
            rustix::fs::open(path, flags, Mode::empty()).map_err(|error| Error::file("open", path, error))?;
        Ok(Self { directory, path: path.to_owned() })
    }

    /// Returns the path of the tree, for messages only.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the descriptor of the directory.
    pub fn as_fd(&self) -> BorrowedFd<'_> {
        self.directory.as_fd()
    }

    /// Returns another handle to the same directory.
    pub fn try_clone(&self) -> Result<Self, Error> {
        let directory = self.directory.try_clone();
        Ok(Self {
            directory: directory.map_err(|error| Error::file("open", &self.path, error))?,
            path: self.path.clone(),
        })
    }

    /// Opens the directory at `path` in this one.
    pub fn open_directory(&self, path: impl AsRef<Path>) -> Result<DirectoryLookup, Error> {
        let shown = self.path.join(path.as_ref());
        match rustix::fs::openat2(&self.directory, path.as_ref(), DIRECTORY, Mode::empty(), INSIDE_TREE) {
            Ok(directory) => Ok(DirectoryLookup::Directory(Self { directory, path: shown })),
            Err(Errno::NOENT) => Ok(DirectoryLookup::Nothing),
            Err(error) if is_something_else(error) => Ok(DirectoryLookup::SomethingElse),
            Err(error) => Err(Error::file("open", &shown, error)),
        }
    }

    /// Reads the regular file at `path`, of at most `limit` bytes; `None` if there is no such entry.
    ///
    /// # Errors
    /// [`Error::NotAFile`] for anything that is not a regular file or is behind a link, [`Error::Outside`] for a path
    /// that leaves the tree, [`Error::TooLarge`] for a file above the limit, of which no more than the limit is read.
    pub fn read_file(&self, path: impl AsRef<Path>, limit: u64) -> Result<Option<File>, Error> {
        self.open_and_read(path.as_ref(), limit, INSIDE_TREE)
    }

    /// Returns the names in the directory, without `.` and `..`, unordered.
    pub fn names(&self) -> Result<Vec<OsString>, Error> {
        let names = crate::walk::names(&self.directory).map_err(|error| Error::file("list", &self.path, error))?;
        let names = names.into_iter();
        Ok(names.map(|name| OsString::from_vec(name.into_bytes())).collect())
    }

    /// Returns whether a regular file is at `path`, behind no link.
    pub fn has_file(&self, path: impl AsRef<Path>) -> bool {
        let flags = OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        rustix::fs::openat2(&self.directory, path.as_ref(), flags, Mode::empty(), INSIDE_TREE)
            .and_then(rustix::fs::fstat)
            .is_ok_and(|stat| FileType::from_raw_mode(stat.st_mode) == FileType::RegularFile)
    }

    /// Reads a file like [`Tree::read_file`], but follows symbolic links that stay in the tree.
    pub fn read_file_following(&self, path: impl AsRef<Path>, limit: u64) -> Result<Option<File>, Error> {
        self.open_and_read(path.as_ref(), limit, FOLLOWING)
    }

    /// Opens the regular file at `path` for reading; `None` if there is no such entry.
    ///
    /// # Errors
    /// The same as those of [`Tree::read_file`].
    pub fn open_file(&self, path: impl AsRef<Path>) -> Result<Option<OwnedFd>, Error> {
        self.open_regular(path.as_ref(), INSIDE_TREE)
    }

    /// Opens a file like [`Tree::open_file`], but follows symbolic links that stay in the tree.
    pub fn open_file_following(&self, path: impl AsRef<Path>) -> Result<Option<OwnedFd>, Error> {
        self.open_regular(path.as_ref(), FOLLOWING)
    }

    fn open_regular(&self, path: &Path, resolve: ResolveFlags) -> Result<Option<OwnedFd>, Error> {
        let Some(file) = self.open_beneath(path, resolve)? else {
            return Ok(None);
        };
        let shown = self.path.join(path);
        let stat = rustix::fs::fstat(&file).map_err(|error| Error::file("look at", &shown, error))?;
        match FileType::from_raw_mode(stat.st_mode) {
            FileType::RegularFile => Ok(Some(file)),
            _ => Err(Error::NotAFile { path: shown }),
        }
    }

    fn open_and_read(&self, path: &Path, limit: u64, resolve: ResolveFlags) -> Result<Option<File>, Error> {
        let file = self.open_beneath(path, resolve)?;
        file.map(|file| read(file, &self.path.join(path), limit)).transpose()
    }

    fn open_beneath(&self, path: &Path, resolve: ResolveFlags) -> Result<Option<OwnedFd>, Error> {
        let shown = self.path.join(path);
        let flags = if resolve.contains(ResolveFlags::NO_SYMLINKS) { FILE } else { FILE.difference(OFlags::NOFOLLOW) };
        match rustix::fs::openat2(&self.directory, path, flags, Mode::empty(), resolve) {
            Ok(file) => Ok(Some(file)),
            Err(Errno::NOENT) => Ok(None),
            Err(Errno::XDEV) => Err(Error::Outside { path: shown, root: self.path.clone() }),
            Err(error) if is_something_else(error) => Err(Error::NotAFile { path: shown }),
            Err(error) => Err(Error::file("open", &shown, error)),
        }
    }
}

/// Returns whether `openat2` failed because the name is a link, not a directory, outside the tree, or a device or
/// socket that cannot be opened.
pub(crate) fn is_something_else(error: Errno) -> bool {
    matches!(error, Errno::NOENT | Errno::LOOP | Errno::NOTDIR | Errno::XDEV | Errno::NXIO | Errno::NODEV)
}

/// Reads an open regular file, of at most `limit` bytes.
pub(crate) fn read(file: OwnedFd, path: &Path, limit: u64) -> Result<File, Error> {
    let stat = rustix::fs::fstat(&file).map_err(|error| Error::file("look at", path, error))?;
    if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
        return Err(Error::NotAFile { path: path.to_owned() });
    }
    let too_large = || Error::TooLarge { path: path.to_owned(), limit };
    if u64::try_from(stat.st_size).is_ok_and(|size| size > limit) {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    std::fs::File::from(file)
        .take(limit + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| Error::file("read", path, error))?;
    if bytes.len() as u64 > limit {
        return Err(too_large());
    }
    Ok(File { bytes, executable: stat.st_mode & 0o111 != 0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn world() -> (tempfile::TempDir, Tree) {
        let place = tempfile::tempdir().expect("a directory");
        let inside = place.path().join("tree");
        std::fs::create_dir_all(inside.join("d")).expect("made");
        std::fs::write(place.path().join("secret"), "the host's").expect("written");
        std::fs::write(inside.join("d/f"), "mine").expect("written");
        symlink("../secret", inside.join("out")).expect("linked");
        symlink(place.path().join("secret"), inside.join("absolute")).expect("linked");
        symlink("d", inside.join("into")).expect("linked");
        symlink("/proc/self/cwd", inside.join("magic")).expect("linked");
        let tree = Tree::open(&inside).expect("opened");
        (place, tree)
    }

    #[test]
    fn nothing_is_read_but_what_is_in_the_tree() {
        let (_place, tree) = world();
        let found = tree.read_file("d/f", 10).expect("read").expect("there");
        assert_eq!((&found.bytes[..], found.executable), (&b"mine"[..], false));
        assert!(tree.read_file("d/none", 10).expect("looked").is_none());
        let there = ["d/f", "d", "into/f", "out", "d/none"].map(|path| tree.has_file(path));
        assert_eq!(there, [true, false, false, false, false]);
        for path in ["out", "absolute", "into/f", "../secret", "/etc/passwd", "d", "d/../../secret", "magic"] {
            let refused = tree.read_file(path, 10).expect_err(path);
            let expected = if path.contains("..") || path.starts_with('/') {
                matches!(refused, Error::Outside { .. })
            } else {
                matches!(refused, Error::NotAFile { .. })
            };
            assert!(expected, "{path}: {refused}");
        }
        for (path, expected) in [("into", "else"), ("..", "else"), ("x", "nothing"), ("d", "it")] {
            let found = match tree.open_directory(path).expect(path) {
                DirectoryLookup::Directory(_) => "it",
                DirectoryLookup::SomethingElse => "else",
                DirectoryLookup::Nothing => "nothing",
            };
            assert_eq!(found, expected, "{path}");
        }
    }

    #[test]
    fn links_that_stay_inside_are_followed_where_that_is_asked_for() {
        let (_place, tree) = world();
        let found = tree.read_file_following("into/f", 10).expect("read");
        assert_eq!(found.expect("there").bytes, b"mine");
        for path in ["out", "absolute", "magic/f"] {
            tree.read_file_following(path, 10).expect_err(path);
        }
    }

    #[test]
    fn a_file_larger_than_allowed_is_not_read() {
        let (place, tree) = world();
        let file = std::fs::File::create(place.path().join("tree/sparse")).expect("made");
        // If the file were read, this test would run out of memory.
        file.set_len(1 << 42).expect("set");
        let refused = tree.read_file("sparse", 1 << 20).expect_err("too large");
        assert!(matches!(refused, Error::TooLarge { .. }), "{refused}");
    }

    #[test]
    fn a_pipe_stops_nobody() {
        let (place, tree) = world();
        let mode = Mode::from_raw_mode(0o600);
        rustix::fs::mknodat(rustix::fs::CWD, place.path().join("tree/pipe"), FileType::Fifo, mode, 0).expect("made");
        let refused = tree.read_file("pipe", 10).expect_err("no file");
        assert!(matches!(refused, Error::NotAFile { .. }), "{refused}");
    }
}
