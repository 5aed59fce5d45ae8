//! File trees with untrusted content: pushed sources, leftovers of containers, image layers. In: a trusted path to the
//! tree. Out: bytes of files, and directory entries, of this tree only.
//!
//! ```text
//!   path of ours ──Tree::open──▶ descriptor ──read──▶ bytes: beneath it, through no link, up to a limit
//!                                    │
//!                                    ├─────walk──▶ every entry: no recursion, limited depth, no link followed
//!                                    └────remove─▶ everything removed: any depth, at most three open files
//! ```
//!
//! In such a tree a name may be a symbolic link to anywhere, a device or a pipe, a file may be larger than memory, and
//! directories may be nested thousands deep. Nothing here follows a link, leaves the tree, blocks when opening, reads
//! more than its limit, or uses the stack in proportion to the tree's depth. Calls block; [`cancel`] ends them early.
//!
//! Untrusted text is also printed: [`terminal`] makes it safe for that.

#![forbid(unsafe_code)]

pub mod cancel;
mod error;
mod remove;
pub mod terminal;
mod tree;
mod walk;

pub use error::Error;
pub use remove::remove;
pub use tree::{DirectoryLookup, File, Tree};
pub use walk::{MAX_DEPTH, Visit, WalkEntry, walk, walk_changing};
