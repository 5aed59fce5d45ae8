//! Events of a shim: one queue, which its driver processes.

use std::os::fd::OwnedFd;

use init::InitReply;
use tokio::net::UnixStream;

use crate::protocol::ShimRequest;

/// An event.
#[derive(Debug)]
pub(super) enum ShimEvent {
    /// A daemon connected.
    Connected(UnixStream),
    /// A daemon sent a request, with descriptors attached.
    Request(u64, ShimRequest, Vec<OwnedFd>),
    /// A daemon disconnected.
    Disconnected(u64),
    /// Init sent a reply.
    Init(InitReply, Option<OwnedFd>),
    /// A child was reaped: init, or a leftover of the creator.
    Reaped(i32, i32),
    /// The daemon has left an exec session, or it has ended.
    ExecLeft(u32),
    /// The restart delay of a node is over.
    Respawn(String),
    /// The time of a stage of the stop is over.
    Patience(StopStage),
    /// SIGTERM was received.
    Terminate,
}

/// Stages of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum StopStage {
    Interrupt,
    Terminate,
    Kill,
    /// The kill timeout has passed, and something still runs: SIGKILL again.
    KillAgain,
}
