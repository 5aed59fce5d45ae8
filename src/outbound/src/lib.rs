//! HTTP/1.1 client (RFC 9110, RFC 9112) for requests to third-party servers, over TLS: one connection per request,
//! limited in time and bytes. Redirects are not followed, and plain text never leaves this machine.
//!
//! ```text
//!   send ─▶ the whole response        open ─▶ head ─▶ OutboundBody::next_chunk …
//! ```

use std::net::IpAddr;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt, Full, Limited};
use hyper::body::Incoming;
use hyper::client::conn::http1;
use hyper::header::{CONNECTION, HOST, HeaderValue};
use hyper::{Request, Response, Uri};
use hyper_util::rt::TokioIo;
use tls::Trust;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio::time::timeout;

/// Default timeout of a request, from DNS lookup to the last byte of the response.
const TIME: Duration = Duration::from_secs(15);
/// Default limit on the size of a response body in bytes.
const BYTES: usize = 1 << 20;

/// Reason why a request failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The URL has no host, or another scheme.
    #[error("{0} is no address of a server; write https://HOST/PATH")]
    NoAddress(String),
    /// The URL would send plain text to another machine.
    #[error("{0} would be asked in plain text, which is done on this machine alone; write https://")]
    PlainText(String),
    /// The connection could not be established.
    #[error("{server} cannot be reached: {source}")]
    Unreachable {
        /// Host and port of the server.
        server: String,
        /// Underlying error.
        source: std::io::Error,
    },
    /// The connection ended early, or the server does not speak HTTP.
    #[error("{server} gave no answer by HTTP: {source}")]
    NoAnswer {
        /// Host and port of the server.
        server: String,
        /// Underlying error.
        source: hyper::Error,
    },
    /// The response body was cut short or exceeds the limit.
    #[error("the answer of {server} cannot be read: {reason}")]
    Unreadable {
        /// Host and port of the server.
        server: String,
        /// Underlying error.
        reason: String,
    },
    /// The request timed out.
    #[error("{server} did not answer within {} s", .time.as_secs())]
    Late {
        /// Host and port of the server.
        server: String,
        /// The timeout.
        time: Duration,
    },
    /// The response body stopped arriving.
    #[error("no data came from {server} for {} s", .time.as_secs())]
    Stalled {
        /// Host and port of the server.
        server: String,
        /// The longest pause.
        time: Duration,
    },
}

/// HTTP client for third-party servers.
#[derive(Debug, Clone)]
pub struct OutboundClient {
    trust: Trust,
    time: Duration,
    bytes: usize,
}

impl OutboundClient {
    /// Creates a client that trusts the authorities of a PEM file (default: the system's). `advice` tells the
    /// operator what to do if there are none.
    pub fn new(authorities: Option<PathBuf>, advice: &'static str) -> OutboundClient {
        let trust =
            Trust { authorities, fingerprint: None, known: None, accept: String::new(), advice, identity: None };
        OutboundClient { trust, time: TIME, bytes: BYTES }
    }

    /// Sets the timeout of each request and the size limit of each response body in bytes.
    pub fn with_limits(self, time: Duration, bytes: usize) -> OutboundClient {
        OutboundClient { time, bytes, ..self }
    }

    /// Sends a request to the server of its URL and reads the whole response.
    pub async fn send(&self, request: Request<Full<Bytes>>) -> Result<Response<Bytes>, Error> {
        let address = ServerAddress::from_uri(request.uri())?;
        let server = address.authority();
        let whole = async {
            let (answer, _connection) = self.exchange(&address, request).await?;
            let (parts, body) = answer.into_parts();
            let body = Limited::new(body, self.bytes).collect().await;
            let body = body.map_err(|error| Error::Unreadable { server: server.clone(), reason: error.to_string() })?;
            Ok(Response::from_parts(parts, body.to_bytes()))
        };
        let answer = timeout(self.time, whole).await;
        answer.unwrap_or_else(|_| Err(Error::Late { server: server.clone(), time: self.time }))
    }

    /// Sends a request to the server of its URL and returns the response when its head has arrived, within the
    /// client's time. The body is limited by who reads it, and each pause in it by the client's time.
    pub async fn open(&self, request: Request<Full<Bytes>>) -> Result<Response<OutboundBody>, Error> {
        let address = ServerAddress::from_uri(request.uri())?;
        let (server, pause) = (address.authority(), self.time);
        let answer = timeout(self.time, self.exchange(&address, request)).await;
        let (answer, connection) = answer.map_err(|_| Error::Late { server: server.clone(), time: self.time })??;
        Ok(answer.map(|incoming| OutboundBody { server, incoming, pause, _connection: connection }))
    }

    /// Sends a request over a connection of its own.
    async fn exchange(
        &self,
        address: &ServerAddress,
        request: Request<Full<Bytes>>,
    ) -> Result<(Response<Incoming>, ConnectionTask), Error> {
        let unreachable = |source| Error::Unreachable { server: address.authority(), source };
        let stream = TcpStream::connect((address.host.as_str(), address.port)).await.map_err(unreachable)?;
        if !address.secure {
            return send_over(stream, address, request).await;
        }
        let connected = self.trust.connect(stream, &address.host, &address.authority()).await.map_err(unreachable)?;
        send_over(connected.stream, address, request).await
    }
}

async fn send_over<S: AsyncRead + AsyncWrite + Send + Unpin + 'static>(
    stream: S,
    address: &ServerAddress,
    mut request: Request<Full<Bytes>>,
) -> Result<(Response<Incoming>, ConnectionTask), Error> {
    let no_answer = |source| Error::NoAnswer { server: address.authority(), source };
    let named = HeaderValue::from_str(&address.named).map_err(|_| address.invalid_address())?;
    request.headers_mut().insert(HOST, named);
    let close = HeaderValue::from_static("close");
    request.headers_mut().insert(CONNECTION, close);
    // Origin form of the request target (RFC 9112, section 3.2.1).
    let path = request.uri().path_and_query().cloned();
    *request.uri_mut() = path.map_or(Uri::from_static("/"), Uri::from);
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await.map_err(no_answer)?;
    let connection = ConnectionTask(tokio::spawn(async move {
        // Its error is that of the response or of its body.
        let _ = connection.await;
    }));
    let answer = sender.send_request(request).await.map_err(no_answer)?;
    Ok((answer, connection))
}

/// Task of a connection, which ends after its only response, or when the response is dropped.
#[derive(Debug)]
struct ConnectionTask(JoinHandle<()>);

impl Drop for ConnectionTask {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Body of a response, which arrives while it is read.
#[derive(Debug)]
pub struct OutboundBody {
    server: String,
    incoming: Incoming,
    pause: Duration,
    _connection: ConnectionTask,
}

impl OutboundBody {
    /// Returns the next bytes; `None` at the end.
    ///
    /// # Errors
    /// [`Error::Unreadable`] if the body is cut short, [`Error::Stalled`] if nothing arrives for the client's time.
    pub async fn next_chunk(&mut self) -> Result<Option<Bytes>, Error> {
        loop {
            let frame = timeout(self.pause, self.incoming.frame()).await;
            let frame = frame.map_err(|_| Error::Stalled { server: self.server.clone(), time: self.pause })?;
            let Some(frame) = frame.transpose().map_err(|error| self.to_unreadable(&error))? else {
                return Ok(None);
            };
            // Trailers say nothing that is used.
            if let Ok(data) = frame.into_data() {
                return Ok(Some(data));
            }
        }
    }

    fn to_unreadable(&self, error: &hyper::Error) -> Error {
        Error::Unreadable { server: self.server.clone(), reason: error.to_string() }
    }
}

/// Server that a request goes to.
struct ServerAddress {
    /// Host name, without the brackets of an IPv6 address.
    host: String,
    port: u16,
    /// Authority as written in the URL.
    named: String,
    secure: bool,
}

impl ServerAddress {
    fn from_uri(uri: &Uri) -> Result<ServerAddress, Error> {
        let none = || Error::NoAddress(uri.to_string());
        let authority = uri.authority().ok_or_else(none)?;
        let host = authority.host();
        let host = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
        let secure = match uri.scheme_str() {
            Some("https") => true,
            Some("http") if is_loopback_host(host) => false,
            Some("http") => return Err(Error::PlainText(uri.to_string())),
            _ => return Err(none()),
        };
        // User names and passwords are never sent.
        if authority.as_str().contains('@') {
            return Err(none());
        }
        Ok(ServerAddress {
            host: host.to_owned(),
            port: authority.port_u16().unwrap_or(if secure { 443 } else { 80 }),
            named: authority.as_str().to_owned(),
            secure,
        })
    }

    fn authority(&self) -> String {
        if self.host.contains(':') {
            format!("[{}]:{}", self.host, self.port)
        } else {
            format!("{}:{}", self.host, self.port)
        }
    }

    fn invalid_address(&self) -> Error {
        Error::NoAddress(self.named.clone())
    }
}

/// Returns host and port of the server that a request to this URL goes to. Fails if [`OutboundClient::send`] would
/// refuse the URL.
pub fn find_server(uri: &Uri) -> Result<(String, u16), Error> {
    ServerAddress::from_uri(uri).map(|address| (address.host, address.port))
}

/// Returns true if the host is this machine, so that nobody on the network can intercept.
pub fn is_loopback_host(host: &str) -> bool {
    host.eq_ignore_ascii_case("localhost") || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;

    use super::*;

    fn client() -> OutboundClient {
        OutboundClient::new(None, "no authorities")
    }

    fn get(address: &str) -> Request<Full<Bytes>> {
        Request::get(address).body(Full::default()).expect("a request")
    }

    /// Starts a server that answers its first connection with `answer` and returns the request it received.
    async fn server(answer: Vec<u8>) -> (String, tokio::task::JoinHandle<String>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("bound"));
        let asked = tokio::spawn(async move {
            let (mut stream, _) = listener.accept().await.expect("a connection");
            let mut asked = Vec::new();
            while !asked.ends_with(b"\r\n\r\n") {
                assert!(stream.read_buf(&mut asked).await.expect("a request") > 0);
            }
            // The client closes the connection once it has read enough.
            let _ = stream.write_all(&answer).await;
            String::from_utf8(asked).expect("text")
        });
        (address, asked)
    }

    #[tokio::test]
    async fn an_answer_is_read_whole() {
        let (address, asked) = server(b"HTTP/1.1 200 OK\r\ncontent-length: 5\r\n\r\nhello".to_vec()).await;
        let answer = client().send(get(&format!("{address}/a?b=c"))).await;
        assert_eq!(answer.expect("an answer").body().as_ref(), b"hello");
        let asked = asked.await.expect("asked");
        assert!(asked.starts_with("GET /a?b=c HTTP/1.1\r\n"), "{asked}");
        let host = address.trim_start_matches("http://");
        assert!(asked.contains(&format!("host: {host}\r\n")), "{asked}");
    }

    #[tokio::test]
    async fn a_redirect_is_an_answer_like_another() {
        let (address, _) =
            server(b"HTTP/1.1 302 Found\r\nlocation: http://192.0.2.1/\r\ncontent-length: 0\r\n\r\n".to_vec()).await;
        let answer = client().send(get(&address)).await.expect("an answer");
        assert_eq!(answer.status(), 302);
    }

    #[tokio::test]
    async fn an_answer_that_is_too_long_is_not_read() {
        let mut long = b"HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n".to_vec();
        long.extend(vec![b'x'; 2000]);
        let (address, _) = server(long).await;
        let refused = client().with_limits(TIME, 1000).send(get(&address)).await.expect_err("too long");
        assert!(matches!(refused, Error::Unreadable { .. }), "{refused}");
    }

    #[tokio::test]
    async fn an_answer_that_ends_too_soon_is_none() {
        let (address, _) = server(b"HTTP/1.1 200 OK\r\ncontent-length: 50\r\n\r\nhello".to_vec()).await;
        let refused = client().send(get(&address)).await.expect_err("cut");
        assert!(matches!(refused, Error::Unreadable { .. }), "{refused}");
    }

    #[tokio::test]
    async fn a_long_answer_is_read_while_it_arrives() {
        let mut long = b"HTTP/1.1 200 OK\r\ncontent-length: 2000000\r\n\r\n".to_vec();
        long.extend(vec![b'x'; 2_000_000]);
        let (address, _) = server(long.clone()).await;
        // The limit is for answers that are kept as a whole.
        let mut answer = client().with_limits(TIME, 10).open(get(&address)).await.expect("a head");
        let mut read = 0;
        while let Some(chunk) = answer.body_mut().next_chunk().await.expect("data") {
            read += chunk.len();
        }
        assert_eq!((answer.status().as_u16(), read), (200, 2_000_000));
        long.truncate(1_000_000);
        let (address, _) = server(long).await;
        let mut answer = client().open(get(&address)).await.expect("a head");
        let cut = loop {
            match answer.body_mut().next_chunk().await {
                Ok(chunk) => assert!(chunk.is_some(), "half of it is no whole answer"),
                Err(error) => break error,
            }
        };
        assert!(matches!(cut, Error::Unreadable { .. }), "{cut}");
    }

    #[tokio::test]
    async fn an_answer_that_stops_arriving_is_given_up() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("bound"));
        let (read, waited) = tokio::sync::oneshot::channel::<()>();
        tokio::spawn(async move {
            let (mut stream, _) = listener.accept().await.expect("a connection");
            stream.write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 9\r\n\r\nhalf").await.expect("sent");
            let _ = waited.await;
        });
        let patient = client().with_limits(Duration::from_secs(1), 10);
        let mut answer = patient.open(get(&address)).await.expect("a head");
        assert_eq!(answer.body_mut().next_chunk().await.expect("data").as_deref(), Some(&b"half"[..]));
        let stalled = answer.body_mut().next_chunk().await.expect_err("no more comes");
        assert!(matches!(stalled, Error::Stalled { .. }), "{stalled}");
        drop(read);
    }

    #[tokio::test]
    async fn what_is_no_http_is_said() {
        let (address, _) = server(b"SSH-2.0-server\r\n".to_vec()).await;
        let refused = client().send(get(&address)).await.expect_err("no HTTP");
        assert!(matches!(refused, Error::NoAnswer { .. }), "{refused}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_silent_server_is_given_up() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("bound"));
        let refused = client().send(get(&address)).await.expect_err("silent");
        assert!(matches!(refused, Error::Late { .. }) && refused.to_string().contains("15 s"), "{refused}");
    }

    #[tokio::test]
    async fn where_nobody_listens_is_named() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        drop(listener);
        let refused = client().send(get(&format!("http://{address}/"))).await.expect_err("nobody").to_string();
        assert!(refused.contains(&address.to_string()), "{refused}");
    }

    #[test]
    fn the_server_of_an_address_is_found() {
        for (address, host, port) in [
            ("http://localhost:4318/v1/traces", "localhost", 4318),
            ("https://otel.lab.example", "otel.lab.example", 443),
            ("http://[::1]", "::1", 80),
        ] {
            let found = find_server(&Uri::from_static(address)).expect(address);
            assert_eq!(found, (host.to_owned(), port));
        }
        find_server(&Uri::from_static("http://otel.lab.example:4318")).expect_err("plain text");
    }

    #[tokio::test]
    async fn addresses_that_are_none_are_refused() {
        for address in
            ["http://192.0.2.1/", "http://lab.example/", "ftp://localhost/", "/path", "https://user:word@localhost/"]
        {
            let refused = client().send(get(address)).await.expect_err(address);
            assert!(matches!(refused, Error::NoAddress(_) | Error::PlainText(_)), "{refused}");
            assert!(refused.to_string().contains("https://"), "{refused}");
        }
    }
}
