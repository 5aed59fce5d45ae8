//! Messages between a servant's shim and its init, and their transport.
//!
//! In: [`InitRequest`] datagrams on a `SEQPACKET` socket that is init's standard input, with file descriptors attached.
//! Out: [`InitReply`] datagrams. All integers are little-endian. Decoding borrows and allocates nothing, because init
//! lives as long as its servant and should cost next to nothing.
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

pub use wire::{EncodeError, InitReply, InitRequest, MAX_MESSAGE, Scope, Start, StartRequest, StartStage};
