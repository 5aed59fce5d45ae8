//! Exec sessions as known to the shim. Each has a socket to the daemon: the end of either side ends the session.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::net::UnixStream as StdStream;

use nix::sys::socket::MsgFlags;
use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;
use tokio::net::unix::OwnedWriteHalf;
use tokio::sync::mpsc;

use super::input::ShimEvent;

/// Maximum number of sessions of a servant.
const MAX_SESSIONS: usize = 16;

/// A running session.
#[derive(Debug)]
struct RunningExec {
    /// Pid of its supervisor in the container.
    inside: i32,
    socket: OwnedWriteHalf,
}

/// All exec sessions of the servant, by the number of their start.
#[derive(Debug)]
pub(super) struct ExecTable {
    inputs: mpsc::UnboundedSender<ShimEvent>,
    /// Sessions whose start init has not answered yet.
    starting: BTreeMap<u32, UnixStream>,
    running: BTreeMap<u32, RunningExec>,
}

/// Reason why a session cannot be added.
#[derive(Debug, thiserror::Error)]
pub(super) enum ExecTableError {
    #[error("{MAX_SESSIONS} programs run beside its nodes already, which is the limit: end one first")]
    Full,
    #[error("its streams did not arrive")]
    NoStreams,
    #[error("its socket cannot be watched: {0}")]
    Socket(#[from] io::Error),
}

impl ExecTable {
    pub(super) fn new(inputs: mpsc::UnboundedSender<ShimEvent>) -> Self {
        Self { inputs, starting: BTreeMap::new(), running: BTreeMap::new() }
    }

    /// Adds a session that is being started.
    pub(super) fn add(&mut self, number: u32, socket: OwnedFd) -> Result<(), ExecTableError> {
        if self.starting.len() + self.running.len() >= MAX_SESSIONS {
            return Err(ExecTableError::Full);
        }
        let socket = StdStream::from(socket);
        socket.set_nonblocking(true)?;
        self.starting.insert(number, UnixStream::from_std(socket)?);
        Ok(())
    }

    /// Called when init has executed the program; returns false if the number is not a session's.
    pub(super) fn on_started(&mut self, number: u32, inside: i32) -> bool {
        let Some(socket) = self.starting.remove(&number) else {
            return false;
        };
        let (mut read, socket) = socket.into_split();
        self.running.insert(number, RunningExec { inside, socket });
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            let mut ignored = [0; 16];
            while matches!(read.read(&mut ignored).await, Ok(1..)) {}
            let _ = inputs.send(ShimEvent::ExecLeft(number));
        });
        true
    }

    /// Removes a session whose program could not be executed; returns false if the number is not a session's.
    pub(super) fn remove_starting(&mut self, number: u32) -> bool {
        self.starting.remove(&number).is_some()
    }

    /// Returns the pid in the container of a session's supervisor, while it runs.
    pub(super) fn supervisor(&self, number: u32) -> Option<i32> {
        self.running.get(&number).map(|exec| exec.inside)
    }

    /// Called when the process with this pid in the container has ended. If it is a supervisor, reports its exit status
    /// to the daemon.
    pub(super) fn on_exited(&mut self, inside: i32, status: i32) {
        let found = self.running.iter().find(|(_, exec)| exec.inside == inside);
        let Some(exec) = found.map(|(number, _)| *number).and_then(|number| self.running.remove(&number)) else {
            return;
        };
        // A supervisor returns its program's status; one that was killed itself is told as a shell would.
        let code = if libc::WIFSIGNALED(status) { 128 + libc::WTERMSIG(status) } else { libc::WEXITSTATUS(status) };
        // Four bytes fit into an empty socket. On an error the daemon has left. Tokio would not try before it
        // knows that the socket is writable.
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
        let _ = nix::sys::socket::send(exec.socket.as_ref().as_raw_fd(), &code.to_le_bytes(), flags);
    }

    /// Removes all sessions, because the servant has ended; returns the numbers of those not started yet.
    pub(super) fn clear(&mut self) -> Vec<u32> {
        self.running.clear();
        std::mem::take(&mut self.starting).into_keys().collect()
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use tokio::task::LocalSet;

    use super::*;

    #[tokio::test]
    async fn either_side_ends_a_session() {
        let (inputs, mut queue) = mpsc::unbounded_channel();
        let mut execs = ExecTable::new(inputs);
        let socket = || {
            let (ours, theirs) = StdStream::pair().unwrap();
            (ours, OwnedFd::from(theirs))
        };
        let begin = async {
            let (mut first, theirs) = socket();
            execs.add(1, theirs).unwrap();
            assert_eq!(execs.supervisor(1), None);
            assert!(execs.on_started(1, 20) && !execs.on_started(1, 20) && !execs.on_started(7, 21));
            execs.on_exited(99, 0);
            execs.on_exited(20, 3 << 8);
            let mut status = Vec::new();
            // Not blocking: the session is shut down in this direction.
            first.read_to_end(&mut status).unwrap();
            assert_eq!(status, 3_i32.to_le_bytes());
            let (second, theirs) = socket();
            execs.add(2, theirs).unwrap();
            assert!(execs.on_started(2, 22));
            drop((first, second));
            let mut left = Vec::new();
            while left.len() < 2 {
                match queue.recv().await {
                    Some(ShimEvent::ExecLeft(number)) => left.push(execs.supervisor(number)),
                    other => panic!("{other:?}"),
                }
            }
            left.sort_unstable();
            assert_eq!(left, [None, Some(22)], "one had ended");
        };
        LocalSet::new().run_until(begin).await;
    }

    #[tokio::test]
    async fn there_are_no_more_than_so_many() {
        let mut execs = ExecTable::new(mpsc::unbounded_channel().0);
        let add = |execs: &mut ExecTable, number| execs.add(number, StdStream::pair().unwrap().1.into());
        for number in 0..MAX_SESSIONS as u32 {
            add(&mut execs, number).unwrap();
        }
        let refused = add(&mut execs, 99).unwrap_err().to_string();
        assert!(refused.contains("the limit"), "{refused}");
        assert!(execs.remove_starting(3) && !execs.remove_starting(3));
        add(&mut execs, 99).unwrap();
        assert_eq!(execs.clear().len(), MAX_SESSIONS);
    }
}
