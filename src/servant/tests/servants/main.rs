//! Tests of servants: started, reached, limited, stopped, killed, found again. Needs root.
//!
//! This program has three roles: the tests; the shim of the servants that they start; and, inside those, the nodes. See
//! `support.rs` for how it tells them apart.

mod adoption;
mod builds;
mod exec;
mod isolation;
mod life;
mod limits;
mod logs;
mod node;
mod shared_memory;
mod support;
