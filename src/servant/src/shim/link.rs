//! The shim's end of init's socket.

use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::rc::Rc;

use init::socket::{self, MAX_FDS};
use init::{EncodeError, Reply, Request, Scope, StartRequest};
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// The longest reply, with room.
const REPLY: usize = 64;

/// Sends requests, receives replies.
#[derive(Clone)]
pub(super) struct Link {
    socket: Rc<AsyncFd<OwnedFd>>,
}

/// Why a request was not sent.
#[derive(Debug, thiserror::Error)]
pub(super) enum LinkError {
    #[error(transparent)]
    Request(#[from] EncodeError),
    #[error("init does not answer: {0}")]
    Gone(#[from] io::Error),
}

impl Link {
    pub(super) fn new(socket: OwnedFd) -> io::Result<Self> {
        fcntl(&socket, FcntlArg::F_SETFL(OFlag::O_NONBLOCK))?;
        // SAFETY: the descriptor is owned by what is registered, and nothing else closes it.
        let socket = unsafe { AsyncFd::register(socket) }?;
        Ok(Self {
            socket: Rc::new(socket),
        })
    }

    /// The next reply and the pidfd beside it; none when init has closed.
    pub(super) async fn receive(&self) -> io::Result<Option<(Reply, Option<OwnedFd>)>> {
        loop {
            let receive = |fd: &OwnedFd| {
                let (mut bytes, mut fds) = ([0; REPLY], [-1; MAX_FDS]);
                let (length, count) = socket::receive(fd.as_raw_fd(), &mut bytes, &mut fds)?;
                // SAFETY: received just now, owned by nobody else.
                let mut owned = fds[..count]
                    .iter()
                    .map(|fd| unsafe { OwnedFd::from_raw_fd(*fd) });
                let first = owned.next();
                owned.for_each(drop);
                Ok((Reply::decode(&bytes[..length]), length, first))
            };
            match self.socket.async_io(Interest::READABLE, receive).await? {
                (_, 0, None) => return Ok(None),
                (Some(reply), _, fd) => return Ok(Some((reply, fd))),
                // Init speaks no other language; whatever this is, nobody waits for it.
                (None, ..) => {}
            }
        }
    }

    /// Asks for a program; the streams are its standard output and error.
    pub(super) async fn start(
        &self,
        request: &StartRequest<'_>,
        streams: [RawFd; 2],
    ) -> Result<(), LinkError> {
        let bytes = request.encode()?;
        Ok(self.send(&bytes, &streams).await?)
    }

    /// Asks for a signal.
    pub(super) async fn signal(
        &self,
        pid: i32,
        signal: i32,
        scope: Scope,
    ) -> Result<(), LinkError> {
        Ok(self.send(&Request::signal(pid, signal, scope), &[]).await?)
    }

    async fn send(&self, bytes: &[u8], fds: &[RawFd]) -> io::Result<()> {
        let send = |fd: &OwnedFd| socket::send(fd.as_raw_fd(), bytes, fds);
        self.socket
            .async_io(Interest::WRITABLE, send)
            .await
            .map(drop)
    }
}
