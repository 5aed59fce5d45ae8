//! Service calls over TCPROS, client and server.
//!
//! After the headers: a request is a length and bytes; a response is one byte (1 success, 0 failure), a length and
//! bytes (of the answer or the reason). Persistent connections carry one call after the other.

use std::io;
use std::net::SocketAddr;

use bytes::{Bytes, BytesMut};
use ros_bus::net::{self, Sockets};
use ros_bus::{FailureReason, ServiceHandler};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use tokio::sync::watch;

use super::{Error, FrameBounds, FrameReader, Header, write_messages};

/// A connection to a service's server, ready for calls.
#[derive(Debug)]
pub struct ServiceConnection {
    stream: TcpStream,
    frames: FrameReader,
    header: Header,
}

/// Error of a call without a response.
#[derive(Debug, thiserror::Error)]
pub enum CallError {
    /// The server had closed the connection before it took the request: calling again elsewhere is safe.
    #[error("the server had closed the connection")]
    NotTaken,
    /// The server closed the connection after it may have taken the request.
    #[error("the server closed the connection during the call")]
    Abandoned,
    /// The connection failed, or the server violated the protocol.
    #[error(transparent)]
    Broken(#[from] Error),
}

impl ServiceConnection {
    /// Connects and exchanges headers.
    pub async fn open(
        sockets: &dyn Sockets,
        address: SocketAddr,
        header: &Header,
        bounds: impl Into<FrameBounds>,
    ) -> Result<Self, Error> {
        let mut stream = sockets.connect(address).await?;
        net::enable_keepalive(&stream);
        let mut buffer = BytesMut::new();
        let header = header.exchange(&mut stream, &mut buffer).await?;
        Ok(Self { stream, frames: FrameReader::new(buffer, bounds), header })
    }

    /// Returns the server's header.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Returns true if the server has closed the idle connection (or sent unsolicited data).
    pub fn is_stale(&self) -> bool {
        let mut byte = [0];
        !self.frames.is_empty()
            || !matches!(self.stream.try_read(&mut byte),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock)
    }

    /// Makes one call; returns the answer, or the server's reason for failing. After an error, or when the call is
    /// dropped half-way, the connection must be dropped too.
    pub async fn call(&mut self, request: Bytes) -> Result<Result<Bytes, FailureReason>, CallError> {
        if let Err(error) = write_messages(&mut self.stream, &[request]).await {
            return Err(if was_reset(&error) { CallError::NotTaken } else { CallError::Broken(error.into()) });
        }
        let done = match self.frames.byte(&mut self.stream).await {
            Ok(Some(byte)) => byte,
            Ok(None) => return Err(self.closed_error()),
            // Reset: the server had not read request bytes when it closed.
            Err(Error::Io(error)) if was_reset(&error) => return Err(CallError::NotTaken),
            Err(error) => return Err(error.into()),
        };
        let payload = match self.frames.next(&mut self.stream).await? {
            Some(payload) => payload,
            None => return Err(Error::from(io::Error::from(io::ErrorKind::UnexpectedEof)).into()),
        };
        Ok(match done {
            0 => Err(FailureReason::new(String::from_utf8_lossy(&payload))),
            _ => Ok(payload),
        })
    }

    /// Returns the error for a stream that ended instead of a response. If the server had closed before the request,
    /// the kernel has received a reset meanwhile and keeps it as the socket's error.
    fn closed_error(&self) -> CallError {
        match self.stream.take_error() {
            Ok(Some(error)) if was_reset(&error) => CallError::NotTaken,
            _ => CallError::Abandoned,
        }
    }
}

fn was_reset(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe)
}

/// Serves the calls of one connection after the exchange of headers, until `ended` is set between two calls.
pub async fn serve_calls(
    mut stream: TcpStream,
    buffer: BytesMut,
    (caller, persistent): (&str, bool),
    handler: &dyn ServiceHandler,
    bounds: impl Into<FrameBounds>,
    mut ended: watch::Receiver<bool>,
) -> Result<(), Error> {
    let mut frames = FrameReader::new(buffer, bounds);
    loop {
        let request = tokio::select! {
            request = frames.next(&mut stream) => request?,
            _ = ended.wait_for(|ended| *ended) => None,
        };
        let Some(request) = request else {
            return Ok(());
        };
        let (done, payload) = match handler.call(request, caller).await {
            Ok(response) => (1, response),
            Err(reason) => (0, Bytes::from(reason.into_string())),
        };
        // The flag is sent with the rest: a segment of its own would cost the peer a wake-up.
        let mut small = Vec::with_capacity(5 + payload.len().min(super::BIG));
        small.push(done);
        small.extend_from_slice(&(payload.len() as u32).to_le_bytes());
        if payload.len() <= super::BIG {
            small.extend_from_slice(&payload);
            stream.write_all(&small).await?;
        } else {
            stream.write_all(&small).await?;
            stream.write_all(&payload).await?;
        }
        if !persistent {
            stream.shutdown().await?;
            return Ok(());
        }
    }
}
