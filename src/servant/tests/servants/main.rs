//! Servants as they are lived with: started, reached, limited, stopped, killed, found again. Needs root.
//!
//! This program is three things: the tests; the shim of the servants that they start; and, inside those, the nodes. See
//! `support.rs` for how it tells which it is.

mod adoption;
mod builds;
mod isolation;
mod life;
mod limits;
mod logs;
mod node;
mod shared_memory;
mod support;
