//! What can go wrong in the store.

use std::io;
use std::path::{Path, PathBuf};

use crate::tar_reader::Stop;
use crate::{Digest, Refusal};

/// Every failure names the file, blob or entry it is about.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk (or the quota) is full. Nothing half-made remains.
    #[error("no space to write {}: {}; free some space there or use a home directory on a larger disk", .path.display(), FreeSpace { needed: *.needed, free: *.free })]
    DiskFull {
        /// The file or tree that was being written.
        path: PathBuf,
        /// Bytes it takes in all, where known.
        needed: Option<u64>,
        /// Bytes that are free there now, where known.
        free: Option<u64>,
    },
    /// A file operation failed.
    #[error("cannot {action} {}: {source}", .path.display())]
    File {
        /// What was attempted, such as "open".
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// Error of the system call.
        source: io::Error,
    },
    /// A directory that is no store, or one of a later version.
    #[error("{} is not an OCI image layout of version 1.x: {problem}; move it away or choose another directory", .path.display())]
    NotALayout {
        /// The directory or its file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// JSON of the store that does not parse.
    #[error("{} does not parse: {source}; run a check of the store and push the package again", .path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Error of the JSON parser.
        source: serde_json::Error,
    },
    /// Not the text of a digest.
    #[error("{text:?} is not a digest: it must be sha256: and 64 hexadecimal digits in lower case")]
    BadDigest {
        /// What was given.
        text: String,
    },
    /// A tag that the image specification's grammar forbids.
    #[error(
        "{name:?} is not a tag: 1 to 255 of the characters A-Z a-z 0-9 . _ : @ + / -, the first a letter or digit"
    )]
    BadTag {
        /// What was given.
        name: String,
    },
    /// What was sent is no image that can be taken in.
    #[error("the image cannot be taken in: {problem}")]
    Unreceivable {
        /// What is wrong.
        problem: String,
    },
    /// A layer that is not in the store.
    #[error("layer {diff_id} is not in the store at {}; push the package again", .store.display())]
    UnknownLayer {
        /// The layer.
        diff_id: Digest,
        /// The store.
        store: PathBuf,
    },
    /// An image that is not in the store.
    #[error("image {digest} is not in the store at {}; push the package again", .store.display())]
    UnknownImage {
        /// The image's manifest.
        digest: Digest,
        /// The store.
        store: PathBuf,
    },
    /// Bytes that are not what their name says.
    #[error("{} is damaged: its content is {found}, not {expected}; push the package again", .path.display())]
    Damaged {
        /// The blob or tree.
        path: PathBuf,
        /// What its name promises.
        expected: Digest,
        /// What it holds.
        found: Digest,
    },
    /// A file tree that cannot become a layer.
    #[error("{} cannot go into a layer: {problem}", .path.display())]
    Tree {
        /// The file.
        path: PathBuf,
        /// In which way it is invalid.
        problem: String,
    },
    /// An archive that is not accepted; nothing of it remains.
    #[error("{archive}: {problem}")]
    Archive {
        /// The archive: a path, or "the archive" for a stream.
        archive: String,
        /// Which entry and why.
        #[source]
        problem: Refusal,
    },
}

/// "N bytes are needed, M are free", as far as known.
struct FreeSpace {
    needed: Option<u64>,
    free: Option<u64>,
}

impl std::fmt::Display for FreeSpace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match (self.needed, self.free) {
            (Some(needed), Some(free)) => {
                write!(
                    f,
                    "{} are needed and {} are free",
                    Bytes(needed),
                    Bytes(free)
                )
            }
            (Some(needed), None) => write!(f, "{} are needed", Bytes(needed)),
            (None, Some(free)) => write!(f, "only {} are free", Bytes(free)),
            (None, None) => write!(f, "the disk is full"),
        }
    }
}

/// A byte count for people.
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
    /// A failed file operation; a full disk becomes [`Error::DiskFull`].
    pub(crate) fn file(
        action: &'static str,
        path: impl AsRef<Path>,
        source: impl Into<io::Error>,
    ) -> Self {
        let (path, source) = (path.as_ref().to_owned(), source.into());
        if is_disk_full(&source) {
            Self::disk_full(&path, None)
        } else {
            Self::File {
                action,
                path,
                source,
            }
        }
    }

    /// The disk is full while writing `path`, which takes `needed` bytes.
    pub(crate) fn disk_full(path: &Path, needed: Option<u64>) -> Self {
        Self::DiskFull {
            path: path.to_owned(),
            needed,
            free: free_bytes(path),
        }
    }

    /// Reading an archive stopped.
    pub(crate) fn stopped(archive: &str, path: &Path, stop: Stop) -> Self {
        match stop {
            Stop::Refused(problem) => Self::Archive {
                archive: archive.to_owned(),
                problem,
            },
            Stop::Source(error) => Self::file("read", path, error),
        }
    }

    /// The same error, with what the whole thing takes filled in where it is a full disk.
    pub(crate) fn needing(self, needed: u64) -> Self {
        match self {
            Self::DiskFull {
                path,
                needed: None,
                free,
            } => Self::DiskFull {
                path,
                needed: Some(needed),
                free,
            },
            other => other,
        }
    }
}

/// Whether this is a full disk or an exhausted quota.
pub(crate) fn is_disk_full(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded
    )
}

/// Free bytes of the file system that holds `path`, or would.
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
        let text = Error::file("write", "/dev/full", error)
            .needing(230_000_000)
            .to_string();
        assert!(
            text.starts_with("no space to write /dev/full: 230 MB are needed and "),
            "{text}"
        );
        assert!(text.contains(" are free; free some space there"), "{text}");
    }
}
