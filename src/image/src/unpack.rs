//! Reading other people's archives.

use std::io::Read;
use std::path::Path;

use crate::Error;

/// How much an archive may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Files, directories and links.
    pub entries: u64,
    /// Bytes of the uncompressed archive.
    pub bytes: u64,
    /// Bytes of one entry's path.
    pub path: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            entries: 200_000,
            bytes: 8 << 30,
            path: 1024,
        }
    }
}

/// What was unpacked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Unpacked {
    /// Files, directories and links.
    pub entries: u64,
    /// Bytes in files.
    pub bytes: u64,
}

/// Why an archive is not accepted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// Unfinished.
    #[error("unfinished")]
    Unfinished,
}

/// Unpacks a tar archive, gzip or not, into `destination`, which must not exist yet or be empty.
pub fn unpack(
    _archive: impl Read,
    _destination: &Path,
    _limits: &Limits,
) -> Result<Unpacked, Error> {
    Err(Error::Archive {
        archive: "the archive".into(),
        problem: Refusal::Unfinished,
    })
}
