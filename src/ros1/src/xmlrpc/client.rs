//! XML-RPC client: keeps the connections of earlier calls, and opens more for concurrent calls.

use std::fmt;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use budget::{Budget, Permit};
use parking_lot::Mutex;
use ros_bus::net::{self, Sockets};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::http::{HttpError, HttpReader, SMALL};
use super::{Error, Value, parse_response, print_call, weight};
use crate::names::PeerUri;

/// Maximum number of idle connections.
const MAX_IDLE: usize = 2;
/// Maximum size of a response body in bytes.
const MAX_BODY: usize = 64 << 20;

/// A client of one XML-RPC server.
pub struct XmlRpcClient {
    sockets: Arc<dyn Sockets>,
    uri: PeerUri,
    idle: Mutex<Vec<ClientConnection>>,
    budget: Budget,
}

struct ClientConnection {
    stream: TcpStream,
    reader: HttpReader,
}

/// Error of a call on one connection.
enum Failure {
    /// The connection broke before a byte of the answer arrived.
    Unanswered(io::Error),
    Io(io::Error),
    Http(String),
}

impl XmlRpcClient {
    /// Creates a client of the server at `uri` (`http://host:port/`); connects with the first call.
    pub fn new(sockets: Arc<dyn Sockets>, uri: &str) -> Result<Self, Error> {
        let uri = PeerUri::parse(uri, "http").ok_or_else(|| Error::BadUri(uri.to_owned()))?;
        Ok(Self { sockets, uri, idle: Mutex::new(Vec::new()), budget: Budget::without_limit() })
    }

    /// Charges responses to this budget while they are read; one that does not fit fails its call.
    pub fn with_budget(self, budget: &Budget) -> Self {
        Self { budget: budget.clone(), ..self }
    }

    /// Calls `method`; the time limit covers everything.
    pub async fn call(&self, method: &str, params: &[Value], time: Duration) -> Result<Value, Error> {
        match timeout(time, self.exchange(method, params)).await {
            Ok(result) => result,
            Err(_) => Err(Error::Timeout { peer: self.peer(), method: method.to_owned(), after: time }),
        }
    }

    /// Closes the connections that no call is using.
    pub fn disconnect(&self) {
        self.idle.lock().clear();
    }

    fn peer(&self) -> String {
        format!("http://{}:{}", self.uri.host, self.uri.port)
    }

    async fn exchange(&self, method: &str, params: &[Value]) -> Result<Value, Error> {
        let body = print_call(method, params);
        let request = format!(
            "POST {} HTTP/1.1\r\nHost: {}:{}\r\nUser-Agent: cloudroid\r\nContent-Type: text/xml\r\n\
             Content-Length: {}\r\n\r\n{body}",
            self.uri.path,
            self.uri.host,
            self.uri.port,
            body.len()
        );
        let mut kept = self.idle.lock().pop();
        loop {
            let reused = kept.is_some();
            let connection = match kept.take() {
                Some(connection) => connection,
                None => self.connect().await.map_err(|error| self.io(error))?,
            };
            let response = match self.send_request(connection, &request).await {
                Ok(response) => response,
                // The server closed a kept connection meanwhile: not an error, retry on a new one.
                Err(Failure::Unanswered(_)) if reused => {
                    self.disconnect();
                    continue;
                }
                Err(Failure::Unanswered(error) | Failure::Io(error)) => return Err(self.io(error)),
                Err(Failure::Http(reason)) => {
                    return Err(Error::Http { peer: self.peer(), reason });
                }
            };
            let (response, _held) = response;
            return parse_response(&response)?.map_err(|fault| Error::Fault {
                peer: self.peer(),
                method: method.to_owned(),
                fault,
            });
        }
    }

    fn io(&self, source: io::Error) -> Error {
        Error::Io { peer: self.peer(), source }
    }

    async fn connect(&self) -> io::Result<ClientConnection> {
        let address = self.sockets.resolve(&self.uri.host, self.uri.port).await?;
        let stream = self.sockets.connect(address).await?;
        net::enable_keepalive(&stream);
        Ok(ClientConnection { stream, reader: HttpReader::new() })
    }

    /// Sends one request and returns its response, with the permit for the parsed response; keeps the connection if
    /// both sides allow.
    async fn send_request(&self, connection: ClientConnection, request: &str) -> Result<(Vec<u8>, Permit), Failure> {
        let ClientConnection { mut stream, mut reader } = connection;
        stream.write_all(request.as_bytes()).await.map_err(Failure::Unanswered)?;
        match reader.fill(&mut stream).await {
            Ok(true) => {}
            Ok(false) => {
                return Err(Failure::Unanswered(io::ErrorKind::UnexpectedEof.into()));
            }
            Err(error) => return Err(Failure::Unanswered(error)),
        }
        let read = async {
            let mut head = reader.read_head(&mut stream).await?;
            while parse_status(&head.start) == Some(100) {
                head = reader.read_head(&mut stream).await?;
            }
            if parse_status(&head.start) != Some(200) {
                let start: String = head.start.chars().take(80).collect();
                return Err(HttpError::Bad(0, format!("it answered {start:?}")));
            }
            let mut permit = self.budget.permit();
            let body = reader.read_body(&mut stream, &head, MAX_BODY, true, &mut permit).await?;
            let weight = weight(&body);
            if weight > SMALL {
                let counted = permit.grow_to(weight);
                counted.map_err(|full| HttpError::Bad(0, full.to_string()))?;
            }
            let version = head.start.split_whitespace().next().unwrap_or_default();
            let counted = head.field("content-length").is_some();
            Ok(((body, permit), counted && head.keeps_alive(version)))
        };
        match read.await {
            Ok((response, keep)) => {
                let mut idle = self.idle.lock();
                if keep && idle.len() < MAX_IDLE && reader.is_empty() {
                    idle.push(ClientConnection { stream, reader });
                }
                Ok(response)
            }
            Err(HttpError::Io(error)) => Err(Failure::Io(error)),
            Err(HttpError::Bad(_, reason)) => Err(Failure::Http(reason)),
        }
    }
}

impl fmt::Debug for XmlRpcClient {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Client").field("uri", &self.uri).finish_non_exhaustive()
    }
}

/// Parses the status code in `HTTP/1.1 200 OK`.
fn parse_status(start: &str) -> Option<u16> {
    if !start.starts_with("HTTP/1.") {
        return None;
    }
    start.split_whitespace().nth(1)?.parse().ok()
}
