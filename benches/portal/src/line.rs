//! A client's end of a connection: sends prepared messages, counts the frames that arrive. As little work as there can
//! be, the same for all contestants; so what is measured is between the ends.

use std::io::{Read, Write};
use std::net::TcpStream;

use anyhow::{Context, Result, bail, ensure};
use bench_servant::Daemon;
use tokio_tungstenite::tungstenite;

use crate::node::PATIENCE;
use crate::secure::{self, Secure};

/// The path of the robot that everything is measured with.
pub(crate) const ROBOT: &str = "meter?robot=bench";

/// How messages follow one another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Framing {
    /// The length before each.
    Tcpros,
    /// A byte that says "good", then the length.
    Response,
    /// Frames of a WebSocket server.
    WebSocket,
}

/// With or without TLS.
enum Stream {
    Plain(TcpStream),
    Tls(Box<Secure>),
}

/// A connection.
pub(crate) struct Line {
    /// Where messages are sent, where that is another connection.
    sender: Option<TcpStream>,
    stream: Stream,
    framing: Framing,
    /// Read and not looked at: `buffer[at..filled]`.
    buffer: Vec<u8>,
    at: usize,
    filled: usize,
    /// Inside a frame: how many of its bytes are still to come.
    missing: Option<u64>,
}

impl Line {
    /// Over a connection that is ready for messages.
    pub(crate) fn new(stream: TcpStream, framing: Framing) -> Result<Self> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        Ok(Self::over(Stream::Plain(stream), framing))
    }

    fn over(stream: Stream, framing: Framing) -> Self {
        Self {
            sender: None,
            stream,
            framing,
            buffer: vec![0; 256 << 10],
            at: 0,
            filled: 0,
            missing: None,
        }
    }

    /// The robot at a daemon, through TLS where the daemon speaks it.
    pub(crate) fn robot(daemon: &Daemon) -> Result<Self> {
        let Some(token) = secure::token(daemon)? else {
            return Self::websocket(&daemon.address, ROBOT);
        };
        let stream = secure::connect(daemon)?;
        let url = format!("wss://localhost/{ROBOT}&token={token}");
        match tungstenite::client(url, stream) {
            Ok((socket, _)) => {
                let stream = Stream::Tls(Box::new(socket.into_inner()));
                Ok(Self::over(stream, Framing::WebSocket))
            }
            Err(error) => bail!("no WebSocket through TLS: {error}"),
        }
    }

    /// With another connection to send on.
    pub(crate) fn sending_on(mut self, sender: TcpStream) -> Result<Self> {
        sender.set_nodelay(true)?;
        self.sender = Some(sender);
        Ok(self)
    }

    /// A WebSocket at `ws://ADDRESS/PATH`.
    pub(crate) fn websocket(address: &str, path: &str) -> Result<Self> {
        Self::websocket_over(TcpStream::connect(address)?, address, path)
    }

    /// The same over a connection that is there.
    pub(crate) fn websocket_over(stream: TcpStream, address: &str, path: &str) -> Result<Self> {
        let kept = stream.try_clone()?;
        match tungstenite::client(format!("ws://{address}/{path}"), stream) {
            // A server that is not spoken to says nothing: there is nothing in its buffer.
            Ok(_) => Self::new(kept, Framing::WebSocket),
            Err(tungstenite::HandshakeError::Failure(error)) => Err(error).context(path.to_owned()),
            Err(tungstenite::HandshakeError::Interrupted(_)) => bail!("{path}: no answer"),
        }
    }

    /// Sends bytes that are framed already.
    pub(crate) fn send(&mut self, framed: &[u8]) -> Result<()> {
        match (&mut self.sender, &mut self.stream) {
            (Some(stream), _) | (None, Stream::Plain(stream)) => stream.write_all(framed)?,
            (None, Stream::Tls(stream)) => {
                stream.write_all(framed)?;
                stream.flush()?;
            }
        }
        Ok(())
    }

    /// Sends a text.
    pub(crate) fn say(&mut self, text: &str) -> Result<()> {
        self.send(&frame(TEXT, text.as_bytes()))
    }

    /// Sends a text and gives the next message.
    pub(crate) fn ask(&mut self, text: &str) -> Result<Vec<u8>> {
        self.say(text)?;
        self.whole()
    }

    /// Waits for messages; gives how many have come to their end.
    pub(crate) fn receive(&mut self) -> Result<u64> {
        loop {
            let ended = self.skim();
            if ended > 0 {
                return Ok(ended);
            }
            self.fill()?;
        }
    }

    /// The next message.
    pub(crate) fn whole(&mut self) -> Result<Vec<u8>> {
        ensure!(self.missing.is_none(), "inside a message");
        let length = loop {
            if let Some((header, length)) = self.header() {
                self.at += header;
                break length as usize;
            }
            self.fill()?;
        };
        let mut message = Vec::with_capacity(length);
        loop {
            let piece = (length - message.len()).min(self.filled - self.at);
            message.extend_from_slice(&self.buffer[self.at..self.at + piece]);
            self.at += piece;
            if message.len() == length {
                return Ok(message);
            }
            self.fill()?;
        }
    }

    /// Passes over what was read; gives how many messages ended in it.
    fn skim(&mut self) -> u64 {
        let mut ended = 0;
        loop {
            if let Some(missing) = &mut self.missing {
                let piece = (*missing).min((self.filled - self.at) as u64);
                self.at += piece as usize;
                *missing -= piece;
                if *missing > 0 {
                    return ended;
                }
                self.missing = None;
                ended += 1;
            }
            let Some((header, length)) = self.header() else {
                return ended;
            };
            self.at += header;
            self.missing = Some(length);
        }
    }

    /// Size of the next frame's header, and what it says of the frame's length.
    fn header(&self) -> Option<(usize, u64)> {
        let bytes = &self.buffer[self.at..self.filled];
        let little = |at: usize| {
            let word = bytes.get(at..at + 4)?.try_into().ok()?;
            Some(u32::from_le_bytes(word))
        };
        let big = |count: usize| {
            let digits = bytes.get(2..2 + count)?;
            Some(
                digits
                    .iter()
                    .fold(0, |sum, &byte| sum << 8 | u64::from(byte)),
            )
        };
        match self.framing {
            Framing::Tcpros => Some((4, little(0)?.into())),
            Framing::Response => Some((5, little(1)?.into())),
            Framing::WebSocket => match bytes.get(1)? {
                126 => Some((4, big(2)?)),
                127 => Some((10, big(8)?)),
                short => Some((2, (*short).into())),
            },
        }
    }

    fn fill(&mut self) -> Result<()> {
        if self.at == self.filled {
            (self.at, self.filled) = (0, 0);
        } else if self.filled == self.buffer.len() {
            self.buffer.copy_within(self.at..self.filled, 0);
            (self.at, self.filled) = (0, self.filled - self.at);
        }
        let space = &mut self.buffer[self.filled..];
        let read = match &mut self.stream {
            Stream::Plain(stream) => stream.read(space)?,
            Stream::Tls(stream) => stream.read(space)?,
        };
        ensure!(read > 0, "the connection was closed");
        self.filled += read;
        Ok(())
    }
}

/// Opcode of a text.
pub(crate) const TEXT: u8 = 1;
/// Opcode of bytes.
pub(crate) const BINARY: u8 = 2;

/// A WebSocket client's frame. Its mask is zero: the server has to take it off all the same, the client is spared it.
pub(crate) fn frame(opcode: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = vec![0x80 | opcode];
    match payload.len() {
        length @ 0..=125 => out.push(0x80 | length as u8),
        length @ 126..=0xffff => {
            out.push(0x80 | 126);
            out.extend_from_slice(&(length as u16).to_be_bytes());
        }
        length => {
            out.push(0x80 | 127);
            out.extend_from_slice(&(length as u64).to_be_bytes());
        }
    }
    out.extend_from_slice(&[0; 4]);
    out.extend_from_slice(payload);
    out
}

/// A TCPROS message.
pub(crate) fn tcpros(message: &[u8]) -> Vec<u8> {
    [&(message.len() as u32).to_le_bytes(), message].concat()
}
