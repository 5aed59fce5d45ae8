//! Output of the nodes, from their pipes into the log.

use std::cell::RefCell;
use std::os::fd::OwnedFd;
use std::rc::Rc;

use tokio::io::AsyncReadExt;
use tokio::net::unix::pipe;
use tokio::sync::watch;

use crate::Error;
use crate::logs::{LineSplitter, LogWriter};

/// Reads pipes until they end.
#[derive(Clone)]
pub(super) struct Streams {
    log: Rc<RefCell<LogWriter>>,
    open: watch::Sender<usize>,
}

impl Streams {
    pub(super) fn new(log: LogWriter) -> Self {
        Self { log: Rc::new(RefCell::new(log)), open: watch::Sender::new(0) }
    }

    /// Creates a pipe whose lines are logged as `stream` of `node`; returns the write end.
    pub(super) fn open(&self, node: &str, stream: &'static str) -> Result<OwnedFd, Error> {
        let (read, write) = nix::unistd::pipe2(nix::fcntl::OFlag::O_CLOEXEC).map_err(Error::nix("pipe"))?;
        let set = nix::fcntl::FcntlArg::F_SETFL(nix::fcntl::OFlag::O_NONBLOCK);
        nix::fcntl::fcntl(&read, set).map_err(Error::nix("fcntl on a pipe"))?;
        let receiver = pipe::Receiver::from_owned_fd(read).map_err(Error::call("watching a pipe"))?;
        self.open.send_modify(|count| *count += 1);
        tokio::task::spawn_local(self.clone().copy(receiver, node.to_owned(), stream));
        Ok(write)
    }

    /// Completes when every pipe has ended, and dropped lines are reported in the log.
    pub(super) async fn wait_drained(&self) {
        // The sender lives in self, so that this cannot fail.
        let _ = self.open.subscribe().wait_for(|count| *count == 0).await;
        self.log.borrow_mut().log_dropped();
    }

    async fn copy(self, mut receiver: pipe::Receiver, node: String, stream: &'static str) {
        let mut lines = LineSplitter::default();
        let mut block = vec![0; 4096];
        // Reading fails only for descriptors that are not pipes.
        while let Ok(length @ 1..) = receiver.read(&mut block).await {
            let mut log = self.log.borrow_mut();
            lines.push(&block[..length], |line| log.append(&node, stream, line));
        }
        let mut log = self.log.borrow_mut();
        lines.finish(|line| log.append(&node, stream, line));
        drop(log);
        self.open.send_modify(|count| *count -= 1);
    }
}
