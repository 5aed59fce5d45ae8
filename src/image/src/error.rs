//! Errors of the image store.

use std::io;
use std::path::{Path, PathBuf};

use crate::tar_reader::ReadStop;
use crate::{Digest, Refusal};

/// Every error names the file, blob or entry it is about.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk (or the quota) is full. Partial files are removed.
    #[error("no space to write {}: {}; free some space there or use a home directory \
             on a larger disk", .path.display(), FreeSpace { needed: *.needed, free: *.free })]
    DiskFull {
        /// File or tree that was being written.
        path: PathBuf,
        /// Total number of bytes needed, if known.
        needed: Option<u64>,
        /// Number of bytes free now, if known.
        free: Option<u64>,
    },
    /// A file operation failed.
    #[error("cannot {action} {}: {source}", .path.display())]
    File {
        /// Operation, such as "open".
        action: &'static str,
        /// File.
        path: PathBuf,
        /// Error of the system call.
        source: io::Error,
    },
    /// The directory is not an image store, or one of a later version.
    #[error("{} is not an OCI image layout of version 1.x: {problem}; move it away or choose \
             another directory", .path.display())]
    NotALayout {
        /// Directory, or a file in it.
        path: PathBuf,
        /// Description of the problem.
        problem: String,
    },
    /// A JSON document of the store cannot be parsed.
    #[error("cannot parse {}: {source}; check the store and push the package again", .path.display())]
    Json {
        /// File.
        path: PathBuf,
        /// Error of the JSON parser.
        source: serde_json::Error,
    },
    /// The text is not a digest.
    #[error("{text:?} is not a digest: it must be sha256: and 64 hexadecimal digits in lower case")]
    BadDigest {
        /// Text that was given.
        text: String,
    },
    /// The tag violates the grammar of the image specification.
    #[error("{name:?} is not a tag: 1 to 255 of the characters A-Z a-z 0-9 . _ : @ + / -, the first a letter or digit")]
    BadTag {
        /// Tag that was given.
        name: String,
    },
    /// The image cannot be received.
    #[error("cannot import the image: {problem}")]
    Unreceivable {
        /// Description of the problem.
        problem: String,
    },
    /// The layer is not in the store.
    #[error("layer {diff_id} is not in the store at {}; push the package again", .store.display())]
    UnknownLayer {
        /// Diff-id of the layer.
        diff_id: Digest,
        /// Path of the store.
        store: PathBuf,
    },
    /// The image is not in the store.
    #[error("image {digest} is not in the store at {}; push the package again", .store.display())]
    UnknownImage {
        /// Digest of the image's manifest.
        digest: Digest,
        /// Path of the store.
        store: PathBuf,
    },
    /// The content does not match its digest.
    #[error("{} is damaged: its content is {found}, not {expected}; push the package again", .path.display())]
    Damaged {
        /// Blob or tree.
        path: PathBuf,
        /// Digest in its name.
        expected: Digest,
        /// Digest of its content.
        found: Digest,
    },
    /// A file tree cannot be packed into a layer.
    #[error("{} cannot go into a layer: {problem}", .path.display())]
    Tree {
        /// File.
        path: PathBuf,
        /// Description of the problem.
        problem: String,
    },
    /// The archive is refused; nothing of it is kept.
    #[error("{archive}: {problem}")]
    Archive {
        /// Path of the archive, or "the archive" for a stream.
        archive: String,
        /// Entry and reason.
        #[source]
        problem: Refusal,
    },
}

/// Formats "N bytes are needed, M are free", as far as known.
struct FreeSpace {
    needed: Option<u64>,
    free: Option<u64>,
}

impl std::fmt::Display for FreeSpace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match (self.needed, self.free) {
            (Some(needed), Some(free)) => {
                write!(f, "{} are needed and {} are free", Bytes(needed), Bytes(free))
            }
            (Some(needed), None) => write!(f, "{} are needed", Bytes(needed)),
            (None, Some(free)) => write!(f, "only {} are free", Bytes(free)),
            (None, None) => write!(f, "the disk is full"),
        }
    }
}

/// Number of bytes in human-readable form.
pub(crate) struct Bytes(pub(crate) u64);

impl std::fmt::Display for Bytes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            n if n >= 10_000_000_000 => write!(f, "{} GB", n / 1_000_000_000),
            n if n >= 10_000_000 => write!(f, "{} MB", n / 1_000_000),
            n if n >= 10_000 => write!(f, "{} kB", n / 1000),
            n => write!(f, "{n} bytes"),
        }
    }
}

impl Error {
    /// Creates the error of a failed file operation; a full disk becomes [`Error::DiskFull`].
    pub(crate) fn file(action: &'static str, path: impl AsRef<Path>, source: impl Into<io::Error>) -> Self {
        let (path, source) = (path.as_ref().to_owned(), source.into());
        if is_disk_full(&source) { Self::disk_full(&path, None) } else { Self::File { action, path, source } }
    }

    /// Creates the error of a full disk while writing `path`, which needs `needed` bytes.
    pub(crate) fn disk_full(path: &Path, needed: Option<u64>) -> Self {
        Self::DiskFull { path: path.to_owned(), needed, free: free_bytes(path) }
    }

    /// Creates the error of an interrupted read of an archive.
    pub(crate) fn from_stop(archive: &str, path: &Path, stop: ReadStop) -> Self {
        match stop {
            ReadStop::Refused(problem) => Self::Archive { archive: archive.to_owned(), problem },
            ReadStop::Source(error) => Self::file("read", path, error),
        }
    }

    /// Adds the total number of bytes needed, if the error is a full disk.
    pub(crate) fn with_needed_bytes(self, needed: u64) -> Self {
        match self {
            Self::DiskFull { path, needed: None, free } => Self::DiskFull { path, needed: Some(needed), free },
            other => other,
        }
    }
}

/// Returns whether the error is a full disk or an exhausted quota.
pub(crate) fn is_disk_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

/// Returns the free bytes of the file system that contains `path` or would contain it.
fn free_bytes(path: &Path) -> Option<u64> {
    path.ancestors()
        .find_map(|directory| rustix::fs::statvfs(directory).ok())
        .map(|found| found.f_bavail * found.f_frsize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_told_with_the_space_needed_and_left() {
        let error = std::fs::write("/dev/full", "x").unwrap_err();
        let text = Error::file("write", "/dev/full", error).with_needed_bytes(230_000_000).to_string();
        assert!(text.starts_with("no space to write /dev/full: 230 MB are needed and "), "{text}");
        assert!(text.contains(" are free; free some space there"), "{text}");
    }
}
