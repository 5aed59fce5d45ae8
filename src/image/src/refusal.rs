//! Reasons to refuse an archive.

use crate::entry::display_name;
use crate::error::Bytes;

/// Reason to refuse an archive, with the entry concerned.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// A name contains `..`.
    #[error("entry {entry:?} goes up with '..'; pack the directory so that every name is below it")]
    ParentDirectory {
        /// Path of the entry in the archive.
        entry: String,
    },
    /// A name begins with `/`.
    #[error("entry {entry:?} has an absolute path; pack the directory so that every name is relative to it")]
    AbsolutePath {
        /// Path of the entry in the archive.
        entry: String,
    },
    /// The entry is a device, FIFO or socket.
    #[error("entry {entry:?} is a {kind}; only files, directories and links are accepted")]
    Special {
        /// Path of the entry in the archive.
        entry: String,
        /// Kind of file, such as "block device".
        kind: String,
    },
    /// A symbolic or hard link points outside the archive's own tree.
    #[error(
        "entry {entry:?} is a link to {target:?}, which leaves the archive; replace it with a copy or leave it out"
    )]
    LinkLeaves {
        /// Path of the entry in the archive.
        entry: String,
        /// Target of the link.
        target: String,
    },
    /// A hard link does not point to an earlier file of the archive.
    #[error("entry {entry:?} is a hard link to {target:?}, which is no earlier file of the archive; pack it as a file")]
    LinkToNothing {
        /// Path of the entry in the archive.
        entry: String,
        /// Target of the link.
        target: String,
    },
    /// A directory of the path is an earlier symbolic link.
    #[error("entry {entry:?} lies behind the symbolic link {link:?}; pack what the link points to under its own name")]
    BehindLink {
        /// Path of the entry in the archive.
        entry: String,
        /// Earlier entry.
        link: String,
    },
    /// A name occurs twice, or is below a file.
    #[error("entry {entry:?} appears twice, or as a file and as a directory; pack it once")]
    Duplicate {
        /// Path of the entry in the archive.
        entry: String,
    },
    /// The name is not a valid file name.
    #[error("entry {entry:?} has a name that cannot be used: {problem}")]
    BadName {
        /// Name of the entry, shortened.
        entry: String,
        /// Description of the problem.
        problem: String,
    },
    /// Too many entries.
    #[error("entry {entry:?} exceeds the limit of {limit} entries; leave out build and devel directories")]
    TooManyEntries {
        /// First entry beyond the limit.
        entry: String,
        /// Maximum number of entries.
        limit: u64,
    },
    /// Too many bytes.
    #[error("entry {entry:?} makes the archive larger than the limit of {}; leave out data and \
        build directories", Bytes(*.limit))]
    TooLarge {
        /// Entry that exceeds the limit.
        entry: String,
        /// Limit in bytes.
        limit: u64,
    },
    /// The archive ends before its end mark.
    #[error("the archive is truncated after entry {after:?}; send it again")]
    Truncated {
        /// Last entry that was read.
        after: String,
    },
    /// The archive is not valid tar or gzip.
    #[error("cannot read the archive after entry {after:?}: {problem}; pack it again as tar or tar.gz")]
    Malformed {
        /// Last entry that was read.
        after: String,
        /// Description of the problem.
        problem: String,
    },
}

impl Refusal {
    /// Creates the refusal of a socket, device or other special file.
    pub(crate) fn special(entry: &[u8], kind: crate::entry::Kind) -> Self {
        use crate::entry::Kind;
        let kind = match kind {
            Kind::Character => "character device".to_owned(),
            Kind::Block => "block device".to_owned(),
            Kind::Fifo => "fifo".to_owned(),
            other => format!("entry of type {:?}", char::from(other.typeflag())),
        };
        Self::Special { entry: display_name(entry), kind }
    }
}
