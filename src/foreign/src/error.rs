//! What can be wrong with a foreign tree.

use std::io;
use std::path::{Path, PathBuf};

use crate::cancel::Cancelled;

/// Why a foreign tree is not read, walked or removed any further.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A system call failed.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    File {
        /// What was being done: "open", "read", "list".
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file is larger than the caller allows.
    #[error("{path} is larger than the {limit} bytes that are read of it", path = path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The caller's limit in bytes.
        limit: u64,
    },
    /// Directories are nested too deep.
    #[error("{path} is more than {limit} directories deep; nest them less", path = path.display())]
    TooDeep {
        /// The first directory that is too deep.
        path: PathBuf,
        /// The most levels.
        limit: usize,
    },
    /// A link, a directory, a pipe or a device stands where a file should.
    #[error("{path} is not a regular file, or lies behind a symbolic link", path = path.display())]
    NotAFile {
        /// What was to be read.
        path: PathBuf,
    },
    /// A name or a link that leads out of the tree.
    #[error("{path} leads out of {root}", path = path.display(), root = root.display())]
    Outside {
        /// What was to be read.
        path: PathBuf,
        /// The tree.
        root: PathBuf,
    },
    /// Something is mounted in a tree that is to be removed; what is in the mount may be the host's.
    #[error(
        "a file system is mounted at {path}; detach it with `umount --lazy {path}`, and try again",
        path = path.display()
    )]
    Mounted {
        /// Where it is mounted.
        path: PathBuf,
    },
    /// The work was cancelled.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl Error {
    pub(crate) fn file(action: &'static str, path: &Path, source: impl Into<io::Error>) -> Self {
        Self::File {
            action,
            path: path.to_owned(),
            source: source.into(),
        }
    }
}

impl From<Error> for io::Error {
    fn from(error: Error) -> Self {
        match error {
            // Whoever tells a full disk from other failures can go on doing so.
            Error::File { source, .. } if source.raw_os_error().is_some() => source,
            Error::Cancelled(cancelled) => cancelled.into(),
            other => io::Error::other(other),
        }
    }
}
