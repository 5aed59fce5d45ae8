//! The shim's end of init's socket.

use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::rc::Rc;

use init::socket::{self, MAX_FDS};
use init::{EncodeError, InitReply, InitRequest, Scope, StartRequest};
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// Buffer size: more than the longest reply.
const REPLY: usize = 64;

/// Sends requests and receives replies.
#[derive(Clone)]
pub(super) struct InitLink {
    socket: Rc<AsyncFd<OwnedFd>>,
}

/// Reason why a request was not sent.
#[derive(Debug, thiserror::Error)]
pub(super) enum LinkError {
    #[error(transparent)]
    Request(#[from] EncodeError),
    #[error("init does not answer: {0}")]
    Gone(#[from] io::Error),
}

impl InitLink {
    pub(super) fn new(socket: OwnedFd) -> io::Result<Self> {
        fcntl(&socket, FcntlArg::F_SETFL(OFlag::O_NONBLOCK))?;
        // SAFETY: the descriptor is owned by the registration, and nothing else closes it.
        let socket = unsafe { AsyncFd::register(socket) }?;
        Ok(Self { socket: Rc::new(socket) })
    }

    /// Receives the next reply and the pidfd attached to it; `None` when init has closed the socket.
    pub(super) async fn receive(&self) -> io::Result<Option<(InitReply, Option<OwnedFd>)>> {
        loop {
            let receive = |fd: &OwnedFd| {
                let (mut bytes, mut fds) = ([0; REPLY], [-1; MAX_FDS]);
                let (length, count) = socket::receive(fd.as_raw_fd(), &mut bytes, &mut fds)?;
                // SAFETY: just received, owned by nobody else.
                let mut owned = fds[..count].iter().map(|fd| unsafe { OwnedFd::from_raw_fd(*fd) });
                let first = owned.next();
                owned.for_each(drop);
                Ok((InitReply::decode(&bytes[..length]), length, first))
            };
            match self.socket.async_io(Interest::READABLE, receive).await? {
                (_, 0, None) => return Ok(None),
                (Some(reply), _, fd) => return Ok(Some((reply, fd))),
                // Malformed; nobody waits for it.
                (None, ..) => {}
            }
        }
    }

    /// Requests the start of a program. Of a node, `streams` are its standard output and error; of an exec session, one
    /// terminal, or input, output and error.
    pub(super) async fn start(&self, request: &StartRequest<'_>, streams: &[RawFd]) -> Result<(), LinkError> {
        let bytes = request.encode()?;
        Ok(self.send(&bytes, streams).await?)
    }

    /// Requests a signal.
    pub(super) async fn signal(&self, pid: i32, signal: i32, scope: Scope) -> Result<(), LinkError> {
        Ok(self.send(&InitRequest::encode_signal(pid, signal, scope), &[]).await?)
    }

    async fn send(&self, bytes: &[u8], fds: &[RawFd]) -> io::Result<()> {
        let send = |fd: &OwnedFd| socket::send(fd.as_raw_fd(), bytes, fds);
        self.socket.async_io(Interest::WRITABLE, send).await.map(drop)
    }
}
