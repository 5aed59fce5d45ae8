//! Errors of reading, walking or removing an untrusted tree.

use std::io;
use std::path::{Path, PathBuf};

use crate::cancel::Cancelled;

/// An error of reading, walking or removing an untrusted tree.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A system call failed.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    File {
        /// Operation that failed: "open", "read", "list".
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// Error of the system call.
        source: io::Error,
    },
    /// A file is larger than the caller allows.
    #[error("{path} is larger than the limit of {limit} bytes", path = path.display())]
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
        /// Maximum number of levels.
        limit: usize,
    },
    /// A link, directory, pipe or device was found where a file is expected.
    #[error("{path} is not a regular file, or lies behind a symbolic link", path = path.display())]
    NotAFile {
        /// Path that was to be read.
        path: PathBuf,
    },
    /// A name or link leads out of the tree.
    #[error("{path} leads out of {root}", path = path.display(), root = root.display())]
    Outside {
        /// Path that was to be read.
        path: PathBuf,
        /// Root of the tree.
        root: PathBuf,
    },
    /// A file system is mounted in a tree that is to be removed; its content may belong to the host.
    #[error(
        "a file system is mounted at {path}; detach it with `umount --lazy {path}`, and try again",
        path = path.display()
    )]
    Mounted {
        /// Mount point.
        path: PathBuf,
    },
    /// The work was cancelled.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl Error {
    pub(crate) fn file(action: &'static str, path: &Path, source: impl Into<io::Error>) -> Self {
        Self::File { action, path: path.to_owned(), source: source.into() }
    }
}

impl From<Error> for io::Error {
    fn from(error: Error) -> Self {
        match error {
            // Keeps the error code, so that callers can still recognise a full disk.
            Error::File { source, .. } if source.raw_os_error().is_some() => source,
            Error::Cancelled(cancelled) => cancelled.into(),
            other => io::Error::other(other),
        }
    }
}
