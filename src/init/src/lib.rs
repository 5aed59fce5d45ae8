//! Messages between a servant's shim and its init, and their transport.
//!
//! In: [`InitRequest`] datagrams on a `SEQPACKET` socket that is init's standard input, with file descriptors attached.
//! Out: [`InitReply`] datagrams. All integers are little-endian. Decoding borrows and allocates nothing, because init
//! lives as long as its servant and should cost next to nothing.
//!
//! ```text
//!   shim                          init (pid 1)
//!    | <--------------------------- Ready
//!    | Start + streams -----------> fork, exec
//!    | <------------- Started + [pidfd]   or   Failed(errno)
//!    | <--------------------------- Exited(pid, status)   every process it reaps, orphans too
//!    | Signal --------------------> kill(2)
//!    | (end of file) -------------> kill all, exit
//! ```
//!
//! The number of attached streams says what is started: two (output, error) a node, three (input, output, error) or
//! one (a terminal) a program of an exec session. Its pid is that of a supervisor, which ends with the program's status
//! when all that the program has started has ended, and on SIGTERM kills it.

pub mod socket;
pub mod wire;

pub use wire::{EncodeError, InitReply, InitRequest, MAX_MESSAGE, Scope, Start, StartRequest, StartStage};
