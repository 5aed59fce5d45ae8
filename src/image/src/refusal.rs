//! Why an archive is not accepted.

use crate::entry::shown;
use crate::error::Bytes;

/// Names the entry and what is wrong with it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// A name with `..`.
    #[error("entry {entry:?} goes up with '..'; pack the directory so that every name is below it")]
    ParentDirectory {
        /// The entry's path in the archive.
        entry: String,
    },
    /// A name that begins with `/`.
    #[error(
        "entry {entry:?} has an absolute path; pack the directory so that every name is relative to it"
    )]
    AbsolutePath {
        /// The entry's path in the archive.
        entry: String,
    },
    /// A device, fifo or socket.
    #[error("entry {entry:?} is a {kind}; only files, directories and links are accepted")]
    Special {
        /// The entry's path in the archive.
        entry: String,
        /// Such as "block device".
        kind: String,
    },
    /// A symbolic or hard link to something that is not in the archive's own tree.
    #[error(
        "entry {entry:?} is a link to {target:?}, which leaves the archive; replace it with a copy or leave it out"
    )]
    LinkLeaves {
        /// The entry's path in the archive.
        entry: String,
        /// Where it leads.
        target: String,
    },
    /// A hard link to what is no earlier file of the archive.
    #[error(
        "entry {entry:?} is a hard link to {target:?}, which is no earlier file of the archive; pack it as a file"
    )]
    LinkToNothing {
        /// The entry's path in the archive.
        entry: String,
        /// What it names.
        target: String,
    },
    /// A path of which a directory is an earlier symbolic link.
    #[error(
        "entry {entry:?} lies behind the symbolic link {link:?}; pack what the link points to under its own name"
    )]
    BehindLink {
        /// The entry's path in the archive.
        entry: String,
        /// The earlier entry.
        link: String,
    },
    /// A second entry of one name, or one below a file.
    #[error(
        "entry {entry:?} is there twice, or is a file in one place and a directory in another; pack it once"
    )]
    Duplicate {
        /// The entry's path in the archive.
        entry: String,
    },
    /// A name that cannot be a file's.
    #[error("entry {entry:?} has a name that cannot be used: {problem}")]
    BadName {
        /// Its name, shortened.
        entry: String,
        /// In which way it is invalid.
        problem: String,
    },
    /// More entries than allowed.
    #[error(
        "entry {entry:?} is one too many: at most {limit} entries are accepted; leave out build and devel directories"
    )]
    TooManyEntries {
        /// The first beyond the limit.
        entry: String,
        /// Most that is accepted.
        limit: u64,
    },
    /// More bytes than allowed.
    #[error("entry {entry:?} makes the archive larger than the {} that are accepted; leave out data and build directories", Bytes(*.limit))]
    TooLarge {
        /// The entry that goes beyond the limit.
        entry: String,
        /// The limit in bytes.
        limit: u64,
    },
    /// The archive ends before its end mark.
    #[error("the archive is cut off after entry {after:?}; send it again")]
    Truncated {
        /// The last entry that was seen.
        after: String,
    },
    /// Not tar or not gzip.
    #[error(
        "the archive does not read after entry {after:?}: {problem}; pack it again as tar or tar.gz"
    )]
    Malformed {
        /// The last entry that was seen.
        after: String,
        /// What is wrong.
        problem: String,
    },
}

impl Refusal {
    /// A socket, device or anything else that is no file.
    pub(crate) fn special(entry: &[u8], kind: crate::entry::Kind) -> Self {
        use crate::entry::Kind;
        let kind = match kind {
            Kind::Character => "character device".to_owned(),
            Kind::Block => "block device".to_owned(),
            Kind::Fifo => "fifo".to_owned(),
            other => format!("entry of type {:?}", char::from(other.typeflag())),
        };
        Self::Special {
            entry: shown(entry),
            kind,
        }
    }
}
