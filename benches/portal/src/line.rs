//! The client's end of a connection: sends prepared messages and counts frames, with as little work as possible.

use std::io::{Read, Write};
use std::net::TcpStream;

use anyhow::{Context, Result, bail, ensure};
use bench_report::BenchDaemon;
use tokio_tungstenite::tungstenite;

use crate::node::PATIENCE;
use crate::tls;

/// URL path of the robot that all measurements use.
pub(crate) const ROBOT: &str = "meter?robot=bench";

/// Framing of the received messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Framing {
    /// A length before each message.
    Tcpros,
    /// A byte for success, then the length.
    Response,
    /// Frames of a WebSocket server.
    WebSocket,
}

/// A socket with or without TLS.
trait LineStream: Read + Write + Send {}

impl<T: Read + Write + Send> LineStream for T {}

/// A client's connection.
pub(crate) struct BenchConnection {
    /// Connection to send on, if it is not the one that is read.
    sender: Option<TcpStream>,
    stream: Box<dyn LineStream>,
    framing: Framing,
    /// `buffer[at..filled]` has been read and not yet parsed.
    buffer: Vec<u8>,
    at: usize,
    filled: usize,
    /// Number of bytes of the current frame that have not arrived yet; `None` between frames.
    missing: Option<u64>,
}

impl BenchConnection {
    /// Wraps a connection on which the handshake is complete.
    pub(crate) fn new(stream: TcpStream, framing: Framing) -> Result<Self> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        Ok(Self::with_stream(stream, framing))
    }

    fn with_stream(stream: impl LineStream + 'static, framing: Framing) -> Self {
        let (stream, buffer) = (Box::new(stream), vec![0; 256 << 10]);
        Self { sender: None, stream, framing, buffer, at: 0, filled: 0, missing: None }
    }

    /// Connects as the robot to a daemon, through TLS if the daemon uses it.
    pub(crate) fn connect_robot(daemon: &BenchDaemon) -> Result<Self> {
        let Some(token) = tls::robot_token(daemon)? else {
            return Self::connect_websocket(&daemon.address, ROBOT);
        };
        let stream = tls::connect(daemon)?;
        let url = format!("wss://localhost/{ROBOT}&token={token}");
        match tungstenite::client(url, stream) {
            Ok((socket, _)) => Ok(Self::with_stream(socket.into_inner(), Framing::WebSocket)),
            Err(error) => bail!("no WebSocket through TLS: {error}"),
        }
    }

    /// Uses another connection for sending, if there is one.
    pub(crate) fn with_sender(mut self, sender: Option<TcpStream>) -> Result<Self> {
        sender.iter().try_for_each(|sender| sender.set_nodelay(true))?;
        self.sender = sender;
        Ok(self)
    }

    /// Opens a WebSocket at `ws://ADDRESS/PATH`.
    pub(crate) fn connect_websocket(address: &str, path: &str) -> Result<Self> {
        Self::upgrade(TcpStream::connect(address)?, address, path)
    }

    /// Opens a WebSocket on an established connection.
    pub(crate) fn upgrade(stream: TcpStream, address: &str, path: &str) -> Result<Self> {
        let kept = stream.try_clone()?;
        match tungstenite::client(format!("ws://{address}/{path}"), stream) {
            // The server only speaks when spoken to, so tungstenite's buffer is empty here.
            Ok(_) => Self::new(kept, Framing::WebSocket),
            Err(tungstenite::HandshakeError::Failure(error)) => Err(error).context(path.to_owned()),
            Err(tungstenite::HandshakeError::Interrupted(_)) => bail!("{path}: no answer"),
        }
    }

    /// Sends bytes that are already framed.
    pub(crate) fn send(&mut self, framed: &[u8]) -> Result<()> {
        if let Some(sender) = &mut self.sender {
            return Ok(sender.write_all(framed)?);
        }
        self.stream.write_all(framed)?;
        Ok(self.stream.flush()?)
    }

    /// Sends a text message.
    pub(crate) fn send_text(&mut self, text: &str) -> Result<()> {
        self.send(&frame(TEXT, text.as_bytes()))
    }

    /// Sends a text message and returns the next message received.
    pub(crate) fn request(&mut self, text: &str) -> Result<Vec<u8>> {
        self.send_text(text)?;
        self.read_message()
    }

    /// Waits for messages; returns how many have been received completely.
    pub(crate) fn receive_messages(&mut self) -> Result<u64> {
        loop {
            let ended = self.skip_received();
            if ended > 0 {
                return Ok(ended);
            }
            self.fill()?;
        }
    }

    /// Returns the next message.
    pub(crate) fn read_message(&mut self) -> Result<Vec<u8>> {
        ensure!(self.missing.is_none(), "inside a message");
        let length = loop {
            if let Some((header, length)) = self.parse_header() {
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

    /// Skips over the buffered bytes; returns how many messages ended in them.
    fn skip_received(&mut self) -> u64 {
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
            let Some((header, length)) = self.parse_header() else {
                return ended;
            };
            self.at += header;
            self.missing = Some(length);
        }
    }

    /// Returns the size of the next frame's header and the payload length that it states.
    fn parse_header(&self) -> Option<(usize, u64)> {
        let bytes = &self.buffer[self.at..self.filled];
        let little = |at: usize| {
            let word = bytes.get(at..at + 4)?.try_into().ok()?;
            Some(u32::from_le_bytes(word))
        };
        let big = |count: usize| {
            let digits = bytes.get(2..2 + count)?;
            Some(digits.iter().fold(0, |sum, &byte| sum << 8 | u64::from(byte)))
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
        let read = self.stream.read(&mut self.buffer[self.filled..])?;
        ensure!(read > 0, "the connection was closed");
        self.filled += read;
        Ok(())
    }
}

/// Opcode of a text frame.
pub(crate) const TEXT: u8 = 1;
/// Opcode of a binary frame.
pub(crate) const BINARY: u8 = 2;

/// Builds a frame of a WebSocket client, with a mask of zeros that the server has to remove all the same.
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

/// Frames a message for TCPROS.
pub(crate) fn tcpros_frame(message: &[u8]) -> Vec<u8> {
    [&(message.len() as u32).to_le_bytes(), message].concat()
}
