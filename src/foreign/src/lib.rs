//! File trees whose content is not ours: what a push sent, what a container left, layers of images. In: a path of ours to
//! the tree. Out: bytes of files, and entries, of this tree only.
//!
//! ```text
//!   path of ours ──Tree::open──▶ descriptor ──read──▶ bytes: beneath it, through no link, at most so many
//!                                    │
//!                                    ├─────walk──▶ every entry: no recursion, a limit of depth, no link followed
//!                                    └────remove─▶ nothing left: any depth, three open files at most
//! ```
//!
//! In such a tree a name may be a symbolic link to anywhere, a device or a pipe, a file may be larger than memory, and
//! directories may lie in each other by the thousand. Nothing here follows a link, leaves the tree, blocks on what it
//! opens, reads more than it was told to, or uses the stack in proportion to the tree's depth. Calls block; [`cancel`]
//! ends them early.
//!
//! What strangers wrote is also printed: [`terminal`] makes text of theirs safe for that.

#![forbid(unsafe_code)]

pub mod cancel;
mod error;
mod remove;
pub mod terminal;
mod tree;
mod walk;

pub use error::Error;
pub use remove::remove;
pub use tree::{File, Found, Tree};
pub use walk::{Entry, MAX_DEPTH, Visit, walk, walk_changing};
