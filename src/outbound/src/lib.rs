//! HTTP/1.1 client (RFC 9110, RFC 9112) for the daemon's requests to third-party servers, over TLS: one connection
//! per request, limited in time and bytes. Redirects are not followed, and plain text never leaves this machine.

use std::net::IpAddr;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt, Full, Limited};
use hyper::client::conn::http1;
use hyper::header::{CONNECTION, HOST, HeaderValue};
use hyper::{Request, Response, Uri};
use hyper_util::rt::TokioIo;
use tls::Trust;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;

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
        match tokio::time::timeout(self.time, self.exchange(&address, request)).await {
            Ok(answer) => answer,
            Err(_) => Err(Error::Late { server, time: self.time }),
        }
    }

    async fn exchange(&self, address: &ServerAddress, request: Request<Full<Bytes>>) -> Result<Response<Bytes>, Error> {
        let unreachable = |source| Error::Unreachable { server: address.authority(), source };
        let stream = TcpStream::connect((address.host.as_str(), address.port)).await.map_err(unreachable)?;
        if !address.secure {
            return self.send_over(stream, address, request).await;
        }
        let connected = self.trust.connect(stream, &address.host, &address.authority()).await.map_err(unreachable)?;
        self.send_over(connected.stream, address, request).await
    }

    async fn send_over<S: AsyncRead + AsyncWrite + Send + Unpin + 'static>(
        &self,
        stream: S,
        address: &ServerAddress,
        mut request: Request<Full<Bytes>>,
    ) -> Result<Response<Bytes>, Error> {
        let no_answer = |source| Error::NoAnswer { server: address.authority(), source };
        let unreadable = |reason: String| Error::Unreadable { server: address.authority(), reason };
        let named = HeaderValue::from_str(&address.named).map_err(|_| address.invalid_address())?;
        request.headers_mut().insert(HOST, named);
        let close = HeaderValue::from_static("close");
        request.headers_mut().insert(CONNECTION, close);
        // Origin form of the request target (RFC 9112, section 3.2.1).
        let path = request.uri().path_and_query().cloned();
        *request.uri_mut() = path.map_or(Uri::from_static("/"), Uri::from);
        let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await.map_err(no_answer)?;
        let answer = async {
            let answer = sender.send_request(request).await.map_err(no_answer)?;
            let (parts, body) = answer.into_parts();
            let body = Limited::new(body, self.bytes).collect().await.map_err(|error| unreadable(error.to_string()))?;
            Ok(Response::from_parts(parts, body.to_bytes()))
        };
        // The connection ends after its only response, or when the request is dropped.
        tokio::pin!(answer);
        tokio::select! {
            answer = &mut answer => answer,
            _ = connection => answer.await,
        }
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
