//! Layers.

use serde::{Deserialize, Serialize};

use crate::Digest;

/// A layer in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LayerInfo {
    /// Of the compressed blob.
    pub digest: Digest,
    /// Of the tar stream inside.
    pub diff_id: Digest,
    /// Bytes of the compressed blob.
    pub size: u64,
    /// Bytes of the tar stream inside: about what the extracted tree takes.
    pub unpacked: u64,
}

/// How a file tree becomes a layer.
#[derive(Debug, Clone)]
pub struct TreeOptions {
    /// Subtracted from every owner and group: the first host id of the user namespace the tree was made in.
    /// Ids below it (files the daemon itself put there) become 0.
    pub uid_offset: u32,
    /// What to leave out: globs of paths relative to the root (`*` and `?` within one name, `**` across names),
    /// or of bare names at any depth (`*.log`) when there is no slash. What is left out is left out with all
    /// below it; `var/cache/*` keeps the directory itself.
    pub exclude: Vec<String>,
    /// The tree is the upper directory of an overlay mount: its marks for deletions become whiteouts.
    pub overlay_upper: bool,
    /// Which modification times are recorded.
    pub mtime: Mtime,
    /// gzip level, 1 (fast) to 9 (small).
    pub level: u32,
}

/// Modification times in a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mtime {
    /// All the same: seconds since 1970.
    Fixed(u64),
    /// Each file's own, but none later than this. For trees whose files carry dates that mean something and are
    /// reproducible, such as an unpacked Debian package: Python throws away a `.pyc` whose source has another
    /// time than the one it recorded.
    Clamp(u64),
}

impl Default for TreeOptions {
    fn default() -> Self {
        Self {
            uid_offset: 0,
            exclude: Vec::new(),
            overlay_upper: false,
            mtime: Mtime::Fixed(0),
            level: 6,
        }
    }
}
