//! What is said between a servant's shim and its init, and how it is sent.
//!
//! In: [`Request`] datagrams on a `SEQPACKET` socket that is init's standard input, with file descriptors beside
//! them. Out: [`Reply`] datagrams. Every integer is little-endian. Decoding borrows and allocates nothing, because
//! init lives as long as its servant does and is to cost next to nothing.
//!
//! ```text
//!   shim                          init (pid 1)
//!    | <--------------------------- Ready
//!    | Start + [stdout, stderr] --> fork, exec
//!    | <------------- Started + [pidfd]   or   Failed(errno)
//!    | <--------------------------- Exited(pid, status)   every process it reaps, orphans too
//!    | Signal --------------------> kill(2)
//!    | (end of file) -------------> kill all, exit
//! ```

pub mod socket;
pub mod wire;

pub use wire::{EncodeError, MAX_MESSAGE, Reply, Request, Scope, Stage, Start, StartRequest};
