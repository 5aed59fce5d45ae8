//! The server: one task per connection, requests of a connection in order.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::io::AsyncWriteExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::http::{Head, HttpError, Reader};
use super::{Call, Fault, Value, parse_call, print_fault, print_response};

/// Answers calls.
#[async_trait]
pub trait Handler: Send + Sync + 'static {
    /// Answers one call. Dropped half-way if the caller goes away.
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault>;
}

/// What a server grants its clients.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Connections at a time; further ones wait in the backlog.
    pub connections: usize,
    /// Bytes in one request's body.
    pub body: usize,
    /// From a request's first byte to its last, and for taking a response.
    pub transfer: Duration,
    /// How long an idle connection is kept.
    pub idle: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 400,
            body: 16 << 20,
            transfer: Duration::from_secs(30),
            idle: Duration::from_secs(600),
        }
    }
}

/// Requests above [`LARGE`] that are held in memory at a time; others wait their turn.
const LARGE_AT_A_TIME: usize = 4;
const LARGE: usize = 256 << 10;

/// Serves until dropped, which also ends every connection.
pub async fn serve(listener: TcpListener, handler: Arc<dyn Handler>, limits: Limits) {
    let room = Arc::new(Semaphore::new(limits.connections));
    let server = Arc::new(Server {
        handler,
        limits,
        large: Semaphore::new(LARGE_AT_A_TIME),
    });
    let mut connections = JoinSet::new();
    loop {
        let Ok(permit) = room.clone().acquire_owned().await else {
            return;
        };
        let stream = loop {
            tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok((stream, _)) => break stream,
                    Err(error) => {
                        // Out of file descriptors, mostly: serving must go on once there are some again.
                        tracing::warn!(%error, "cannot accept an XML-RPC connection");
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                },
                Some(_) = connections.join_next() => {}
            }
        };
        let server = server.clone();
        connections.spawn(async move {
            let _permit = permit;
            let _ = stream.set_nodelay(true);
            if let Err(error) = server.connection(stream).await {
                tracing::debug!(%error, "an XML-RPC connection broke");
            }
        });
    }
}

struct Server {
    handler: Arc<dyn Handler>,
    limits: Limits,
    large: Semaphore,
}

impl Server {
    async fn connection(&self, mut stream: TcpStream) -> io::Result<()> {
        let mut reader = Reader::new();
        loop {
            if reader.is_empty() {
                match timeout(self.limits.idle, reader.fill(&mut stream)).await {
                    Ok(Ok(true)) => {}
                    Ok(Err(error)) => return Err(error),
                    Ok(Ok(false)) | Err(_) => return Ok(()),
                }
            }
            let request = timeout(self.limits.transfer, self.request(&mut reader, &mut stream));
            let (call, keep) = match request.await {
                Ok(Ok(request)) => request,
                Ok(Err(HttpError::Io(error))) => return Err(error),
                Ok(Err(HttpError::Bad(status, reason))) => {
                    return self.refuse(&mut stream, status, &reason).await;
                }
                Err(_) => {
                    return self.refuse(&mut stream, 408, "the request stalled").await;
                }
            };
            let body = {
                let answer = self.answer(call);
                tokio::select! {
                    biased;
                    body = answer => body,
                    // The caller of a long poll went away.
                    () = gone(&mut reader, &mut stream) => return Ok(()),
                }
            };
            self.respond(&mut stream, 200, "text/xml", &body, keep)
                .await?;
            if !keep {
                return stream.shutdown().await;
            }
        }
    }

    /// One request; whether the connection is kept after it.
    async fn request(
        &self,
        reader: &mut Reader,
        stream: &mut TcpStream,
    ) -> Result<(Vec<u8>, bool), HttpError> {
        let head = reader.head(stream).await?;
        let mut words = head.start.split_whitespace();
        let method = words.next().unwrap_or_default();
        let version = words.nth(1).unwrap_or_default();
        if !version.starts_with("HTTP/1.") {
            return Err(HttpError::Bad(400, "this is not HTTP/1".to_owned()));
        }
        if method != "POST" {
            let reason = format!("{method} is not used by XML-RPC; use POST");
            return Err(HttpError::Bad(405, reason));
        }
        let keep = head.keeps_alive(version);
        let _large = match head.content_length()? {
            Some(length) if length > LARGE => self.large.acquire().await.ok(),
            _ => None,
        };
        if head.expects_continue() {
            stream.write_all(b"HTTP/1.1 100 Continue\r\n\r\n").await?;
        }
        let body = self.body(reader, stream, &head).await?;
        Ok((body, keep))
    }

    async fn body(
        &self,
        reader: &mut Reader,
        stream: &mut TcpStream,
        head: &Head,
    ) -> Result<Vec<u8>, HttpError> {
        reader.body(stream, head, self.limits.body, false).await
    }

    async fn answer(&self, body: Vec<u8>) -> String {
        let parsed = parse_call(&body);
        drop(body);
        match parsed {
            Ok(Call { method, params }) => match self.handler.call(&method, params).await {
                Ok(value) => print_response(&value),
                Err(fault) => print_fault(&fault),
            },
            Err(error) => print_fault(&Fault::new(error.to_string())),
        }
    }

    async fn refuse(&self, stream: &mut TcpStream, status: u16, reason: &str) -> io::Result<()> {
        self.respond(stream, status, "text/plain", reason, false)
            .await?;
        stream.shutdown().await
    }

    async fn respond(
        &self,
        stream: &mut TcpStream,
        status: u16,
        content_type: &str,
        body: &str,
        keep: bool,
    ) -> io::Result<()> {
        let phrase = match status {
            200 => "OK",
            405 => "Method Not Allowed",
            408 => "Request Timeout",
            411 => "Length Required",
            413 => "Content Too Large",
            431 => "Request Header Fields Too Large",
            _ => "Bad Request",
        };
        let connection = if keep { "keep-alive" } else { "close" };
        // XmlRpcpp wants exactly one blank after the colon.
        let mut message = format!(
            "HTTP/1.1 {status} {phrase}\r\nServer: cloudroid\r\nContent-Type: {content_type}\r\n\
             Content-Length: {}\r\nConnection: {connection}\r\n\r\n",
            body.len()
        );
        message.push_str(body);
        match timeout(self.limits.transfer, stream.write_all(message.as_bytes())).await {
            Ok(written) => written,
            Err(_) => Err(io::ErrorKind::TimedOut.into()),
        }
    }
}

/// Returns when the peer has closed; what it sends meanwhile is kept for the next request.
async fn gone(reader: &mut Reader, stream: &mut TcpStream) {
    /// More than that is not collected while an answer is awaited.
    const AHEAD: usize = 64 << 10;
    while reader.len() < AHEAD {
        if !matches!(reader.fill(stream).await, Ok(true)) {
            return;
        }
    }
    std::future::pending().await
}

#[cfg(test)]
mod tests;
