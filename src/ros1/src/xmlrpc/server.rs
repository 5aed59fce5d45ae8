//! XML-RPC server: one task per connection; requests on a connection are processed in order.
//!
//! The memory for big requests and answers is charged to a budget: a request waits for its share before its body is
//! read, an answer before it is generated, and it is released when the last byte has been written. Processor time is
//! charged to the same budget.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::{Budget, Permit};
use bytes::Buf as _;
use ros_bus::net;
use tokio::io::AsyncWriteExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

use super::http::{HttpError, HttpHead, HttpReader, SMALL};
use super::{Fault, MethodCall, Value, parse_call, print_fault, print_response, weight};

/// Handles calls.
#[async_trait]
pub trait XmlRpcHandler: Send + Sync + 'static {
    /// Handles one call. Cancelled half-way if the caller goes away.
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault>;

    /// Returns the approximate memory size in bytes of the answer's value, as far as it is known in advance.
    fn weight(&self, _method: &str, _params: &[Value]) -> usize {
        0
    }
}

/// Limits of a server.
#[derive(Debug, Clone)]
pub struct ServerLimits {
    /// Maximum number of connections; further ones wait in the backlog.
    pub connections: usize,
    /// Maximum size of a request body in bytes.
    pub body: usize,
    /// Time limit from a request's first byte to its last, and for sending a response.
    pub transfer: Duration,
    /// Time for which an idle connection is kept.
    pub idle: Duration,
    /// Budget for the memory of big requests and answers.
    pub budget: Budget,
}

/// Default budget in bytes for big requests and answers of one server.
pub const MAX_HELD: usize = 96 << 20;

impl Default for ServerLimits {
    fn default() -> Self {
        Self {
            connections: 400,
            body: 16 << 20,
            transfer: Duration::from_secs(30),
            idle: Duration::from_secs(600),
            budget: Budget::new("XML-RPC", MAX_HELD),
        }
    }
}

/// Copies in memory: a request as text and as values, an answer as values and as growing text.
const FORMS: usize = 3;

/// Serves until dropped, which also ends every connection.
pub async fn serve(listener: TcpListener, handler: Arc<dyn XmlRpcHandler>, limits: ServerLimits) {
    let most = limits.connections;
    let server = Arc::new(XmlRpcServer { handler, limits });
    let connected = |stream| {
        let (server, budget) = (server.clone(), server.limits.budget.clone());
        budget.meter(async move { server.serve_connection(stream).await })
    };
    net::serve_connections(listener, most, "XML-RPC", connected).await;
}

struct XmlRpcServer {
    handler: Arc<dyn XmlRpcHandler>,
    limits: ServerLimits,
}

impl XmlRpcServer {
    async fn serve_connection(&self, mut stream: TcpStream) -> io::Result<()> {
        let mut reader = HttpReader::new();
        loop {
            if reader.is_empty() {
                match timeout(self.limits.idle, reader.fill(&mut stream)).await {
                    Ok(Ok(true)) => {}
                    Ok(Err(error)) => return Err(error),
                    Ok(Ok(false)) | Err(_) => return Ok(()),
                }
            }
            let (call, permit, keep) = match self.read_request(&mut reader, &mut stream).await {
                Ok(request) => request,
                Err(HttpError::Io(error)) => return Err(error),
                Err(HttpError::Bad(status, reason)) => {
                    return self.refuse(&mut stream, status, &reason).await;
                }
            };
            let (body, _permit) = {
                let answer = self.answer(call, permit);
                tokio::select! {
                    biased;
                    answer = answer => answer,
                    // The caller of a long poll went away.
                    () = wait_until_closed(&mut reader, &mut stream) => return Ok(()),
                }
            };
            self.respond(&mut stream, 200, "text/xml", &body, keep).await?;
            if !keep {
                return stream.shutdown().await;
            }
        }
    }

    /// Reads one request; returns the body, its permit, and whether the connection is kept afterwards. The peer's time
    /// for its head and for its body does not run while this side waits for memory.
    async fn read_request(
        &self,
        reader: &mut HttpReader,
        stream: &mut TcpStream,
    ) -> Result<(Vec<u8>, Permit, bool), HttpError> {
        let stalled = |_| HttpError::Bad(408, "the request stalled".to_owned());
        let head = timeout(self.limits.transfer, reader.read_head(stream));
        let head = head.await.map_err(stalled)??;
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
        let mut permit = self.limits.budget.permit();
        let counts = |length: &usize| *length > SMALL && *length <= self.limits.body;
        if let Some(length) = head.content_length()?.filter(counts) {
            let room = permit.wait(length * FORMS, self.limits.transfer).await;
            room.map_err(|full| HttpError::Bad(503, full.to_string()))?;
        }
        if head.expects_continue() {
            stream.write_all(b"HTTP/1.1 100 Continue\r\n\r\n").await?;
        }
        let body = self.read_body(reader, stream, &head, &mut permit);
        let body = timeout(self.limits.transfer, body).await.map_err(stalled)??;
        if body.len() > SMALL {
            // The size of a body without a length, or of one with many small values, was not known in advance.
            let counted = permit.grow_to(weight(&body).max(body.len() * FORMS));
            counted.map_err(|full| HttpError::Bad(503, full.to_string()))?;
        }
        Ok((body, permit, keep))
    }

    async fn read_body(
        &self,
        reader: &mut HttpReader,
        stream: &mut TcpStream,
        head: &HttpHead,
        permit: &mut Permit,
    ) -> Result<Vec<u8>, HttpError> {
        let max = self.limits.body;
        reader.read_body(stream, head, max, false, permit).await
    }

    /// Returns the answer and its permit.
    async fn answer(&self, body: Vec<u8>, request: Permit) -> (String, Permit) {
        let parsed = parse_call(&body);
        drop(body);
        let mut permit = self.limits.budget.permit();
        let MethodCall { method, params } = match parsed {
            Ok(call) => call,
            Err(error) => return (print_fault(&Fault::new(error.to_string())), permit),
        };
        if let Err(full) = self.reserve(&method, &params, &mut permit).await {
            tracing::warn!(method, %full, "a call is not answered");
            let reason = format!("{full}; ask for less, or read answers faster");
            return (print_fault(&Fault::new(reason)), permit);
        }
        let answer = match self.handler.call(&method, params).await {
            Ok(value) => print_response(&value),
            Err(fault) => print_fault(&fault),
        };
        drop(request);
        // The actual size from now on, including the capacity of the buffer.
        if answer.capacity() > SMALL {
            let _ = permit.resize(answer.capacity());
        }
        (answer, permit)
    }

    /// Waits until there is room for the answer.
    async fn reserve(&self, method: &str, params: &[Value], permit: &mut Permit) -> Result<(), budget::Exceeded> {
        loop {
            let weight = self.handler.weight(method, params).saturating_mul(FORMS);
            if weight <= permit.bytes().max(SMALL) {
                return Ok(());
            }
            // The answer may have grown by the time there is room.
            permit.wait(weight, self.limits.transfer).await?;
        }
    }

    async fn refuse(&self, stream: &mut TcpStream, status: u16, reason: &str) -> io::Result<()> {
        self.respond(stream, status, "text/plain", reason, false).await?;
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
            503 => "Service Unavailable",
            _ => "Bad Request",
        };
        let connection = if keep { "keep-alive" } else { "close" };
        // XmlRpcpp wants exactly one blank after the colon.
        let head = format!(
            "HTTP/1.1 {status} {phrase}\r\nServer: cloudroid\r\nContent-Type: {content_type}\r\n\
             Content-Length: {}\r\nConnection: {connection}\r\n\r\n",
            body.len()
        );
        let mut message = head.as_bytes().chain(body.as_bytes());
        let written = timeout(self.limits.transfer, stream.write_all_buf(&mut message));
        match written.await {
            Ok(written) => written,
            Err(_) => Err(io::ErrorKind::TimedOut.into()),
        }
    }
}

/// Returns when the peer has closed the connection; data that arrives meanwhile is kept for the next request.
async fn wait_until_closed(reader: &mut HttpReader, stream: &mut TcpStream) {
    /// Maximum number of bytes buffered while an answer is awaited.
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
