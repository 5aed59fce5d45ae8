//! Exec sessions: programs that people run in a servant, beside its nodes. Init starts them as it starts nodes, so they
//! have its user, namespaces, cgroup, seccomp filter and capabilities, and cannot have more.
//!
//! ```text
//!   LocalServant -- Exec + [socket, streams] --> shim -- Start + streams --> init --> supervisor --> program
//!        |  <------------- exit status, end of file -----  |                              ^
//!        |  end of file (left, or the daemon has ended) -> |  SIGTERM ------------------> |  kills all that is left
//!        `---- input, output: this side's ends of the streams, which pass neither shim nor init
//! ```
//!
//! All descriptors are made here and sent inwards; none is ever received from a servant. A terminal is of the host's
//! devpts, where the servant can reach only the one that it was given.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream as StdStream;
use std::sync::Arc;

use api::exec::TerminalSize;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::stat::{Mode, fchmod};
use nix::unistd::{Gid, Uid, fchown, pipe2};
use serde::{Deserialize, Serialize};
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncReadExt, Interest};
use tokio::net::UnixStream;

use crate::{Error, sys};

/// A program to run in a servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExecSpec {
    /// Absolute path of the executable in the container, then its arguments.
    pub argv: Vec<String>,
    /// Variables added to the servant's environment.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// The standard streams are one terminal.
    #[serde(default)]
    pub terminal: bool,
}

/// A running program and this side's ends of its streams. Dropping it kills the program with all that it has started.
#[derive(Debug)]
pub struct ExecSession {
    /// Standard input; dropping all copies closes it. Of a terminal, what is typed.
    pub input: ExecStream,
    /// Standard output; of a terminal, what it shows.
    pub output: ExecStream,
    /// Standard error, which a terminal does not tell from its output.
    pub error: Option<ExecStream>,
    /// End of the program.
    pub end: ExecEnd,
}

/// One end of a stream of an exec session.
#[derive(Debug, Clone)]
pub struct ExecStream(Arc<AsyncFd<OwnedFd>>);

impl ExecStream {
    fn new(descriptor: OwnedFd) -> io::Result<ExecStream> {
        // SAFETY: the descriptor is owned by the registration, and nothing else closes it.
        let registered = unsafe { AsyncFd::register(descriptor) }?;
        Ok(ExecStream(Arc::new(registered)))
    }

    /// Reads some bytes; returns 0 at the end. Cancelling it loses nothing.
    pub async fn read(&self, into: &mut [u8]) -> io::Result<usize> {
        let read = |descriptor: &OwnedFd| Ok(nix::unistd::read(descriptor, &mut *into)?);
        match self.0.async_io(Interest::READABLE, read).await {
            // No process has the terminal open any more.
            Err(error) if error.raw_os_error() == Some(libc::EIO) => Ok(0),
            outcome => outcome,
        }
    }

    /// Writes all bytes, waiting for the program to read if necessary.
    pub async fn write_all(&self, mut bytes: &[u8]) -> io::Result<()> {
        while !bytes.is_empty() {
            let write = |descriptor: &OwnedFd| Ok(nix::unistd::write(descriptor, bytes)?);
            let written = self.0.async_io(Interest::WRITABLE, write).await?;
            bytes = &bytes[written..];
        }
        Ok(())
    }

    /// Sets the size of the terminal and tells its programs (SIGWINCH). Fails if it is none.
    pub fn resize(&self, size: TerminalSize) -> io::Result<()> {
        sys::set_terminal_size(self.0.get_ref().as_fd(), size.columns, size.rows)
    }
}

/// Tells how a program ended.
#[derive(Debug)]
pub struct ExecEnd(UnixStream);

impl ExecEnd {
    /// Waits until the program and all that it has started have ended. Returns its exit status, 128 more than the
    /// number of a signal that killed it; `None` if its servant ended.
    pub async fn wait(&mut self) -> Option<i32> {
        let mut status = [0; size_of::<i32>()];
        self.0.read_exact(&mut status).await.ok()?;
        Some(i32::from_le_bytes(status))
    }
}

/// This side's ends of a session's descriptors, before they are registered with the runtime.
#[derive(Debug)]
pub struct ExecEnds {
    socket: StdStream,
    input: OwnedFd,
    output: OwnedFd,
    error: Option<OwnedFd>,
}

impl ExecEnds {
    /// Makes the descriptors of a session; also returns the other ends, in the order in which the shim expects them.
    /// The streams belong to the user with this host uid (= gid), so that the program can open `/dev/stdout` and the
    /// like. With a size, they are a terminal.
    pub fn create(terminal: Option<TerminalSize>, user: u32) -> Result<(ExecEnds, Vec<OwnedFd>), Error> {
        let (socket, far) = StdStream::pair().map_err(Error::call("making the socket of an exec session"))?;
        let mut theirs = vec![OwnedFd::from(far)];
        let ends = match terminal {
            Some(size) => {
                let (master, slave) = sys::open_terminal().map_err(Error::call("opening a terminal"))?;
                let sized = sys::set_terminal_size(master.as_fd(), size.columns, size.rows);
                sized.map_err(Error::call("setting the size of a terminal"))?;
                fchmod(&slave, Mode::S_IRUSR | Mode::S_IWUSR).map_err(Error::nix("fchmod of a terminal"))?;
                let input = master.try_clone().map_err(Error::call("dup of a terminal"))?;
                theirs.push(slave);
                ExecEnds { socket, input, output: master, error: None }
            }
            None => {
                let ((their_input, input), (output, their_output)) = (open_pipe()?, open_pipe()?);
                let (error, their_error) = open_pipe()?;
                for own in [&input, &output, &error] {
                    fcntl(own, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).map_err(Error::nix("fcntl on a pipe"))?;
                }
                theirs.extend([their_input, their_output, their_error]);
                ExecEnds { socket, input, output, error: Some(error) }
            }
        };
        for stream in &theirs[1..] {
            let owned = fchown(stream, Some(Uid::from_raw(user)), Some(Gid::from_raw(user)));
            owned.map_err(Error::nix("giving a stream to the servant's user"))?;
        }
        Ok((ends, theirs))
    }

    /// Registers the descriptors with this runtime.
    pub fn register(self) -> io::Result<ExecSession> {
        self.socket.set_nonblocking(true)?;
        Ok(ExecSession {
            input: ExecStream::new(self.input)?,
            output: ExecStream::new(self.output)?,
            error: self.error.map(ExecStream::new).transpose()?,
            end: ExecEnd(UnixStream::from_std(self.socket)?),
        })
    }
}

/// Opens a pipe; returns its read end and its write end.
fn open_pipe() -> Result<(OwnedFd, OwnedFd), Error> {
    pipe2(OFlag::O_CLOEXEC).map_err(Error::nix("pipe"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn own_user() -> u32 {
        nix::unistd::geteuid().as_raw()
    }

    #[tokio::test]
    async fn what_is_written_at_one_end_is_read_at_the_other_until_it_closes() {
        let (ends, theirs) = ExecEnds::create(None, own_user()).unwrap();
        let mut session = ends.register().unwrap();
        let [socket, input, output, error] = <[OwnedFd; 4]>::try_from(theirs).unwrap();
        session.input.write_all(b"typed").await.unwrap();
        let mut block = [0; 16];
        assert_eq!(nix::unistd::read(&input, &mut block).unwrap(), 5);
        nix::unistd::write(&output, b"printed").unwrap();
        assert_eq!(session.output.read(&mut block).await.unwrap(), 7);
        assert_eq!(&block[..7], b"printed");
        drop((output, error));
        assert_eq!(session.output.read(&mut block).await.unwrap(), 0);
        assert_eq!(session.error.unwrap().read(&mut block).await.unwrap(), 0);
        nix::unistd::write(&socket, &7_i32.to_le_bytes()).unwrap();
        assert_eq!(session.end.wait().await, Some(7));
        drop(socket);
        assert_eq!(session.end.wait().await, None, "its servant ended");
    }

    #[tokio::test]
    async fn a_terminal_has_the_size_that_was_asked_for_and_ends_with_its_last_program() {
        let size = TerminalSize { columns: 97, rows: 31 };
        let (ends, theirs) = ExecEnds::create(Some(size), own_user()).unwrap();
        let session = ends.register().unwrap();
        let [_socket, slave] = <[OwnedFd; 2]>::try_from(theirs).unwrap();
        assert_eq!(sys::terminal_size(slave.as_fd()).unwrap(), (97, 31));
        session.output.resize(TerminalSize { columns: 80, rows: 24 }).unwrap();
        assert_eq!(sys::terminal_size(slave.as_fd()).unwrap(), (80, 24));
        nix::unistd::write(&slave, b"shown\n").unwrap();
        let mut block = [0; 16];
        assert_eq!(session.output.read(&mut block).await.unwrap(), 7, "the line's end is CR LF there");
        drop(slave);
        assert_eq!(session.output.read(&mut block).await.unwrap(), 0);
    }
}
