//! What happens to a shim: one queue of it all, which its driver works off.

use std::os::fd::OwnedFd;

use init::Reply;
use tokio::net::UnixStream;

use crate::protocol::Request;

/// What happens.
#[derive(Debug)]
pub(super) enum Input {
    /// A daemon connected.
    Connected(UnixStream),
    /// It asked.
    Request(u64, Request),
    /// It left.
    Disconnected(u64),
    /// Init said something.
    Init(Reply, Option<OwnedFd>),
    /// A child of ours was reaped: init, or what the creator left.
    Reaped(i32, i32),
    /// A node's delay is over.
    Respawn(String),
    /// A stage of the stop has lasted long enough.
    Patience(StopStage),
    /// We were asked to end.
    Terminate,
}

/// The stages of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum StopStage {
    Interrupt,
    Terminate,
    Kill,
    /// The kill timeout has passed, and something still runs: SIGKILL again.
    KillAgain,
}
