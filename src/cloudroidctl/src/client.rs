//! HTTP client for the daemon, over TCP, TLS or its Unix socket.

use std::fmt;
use std::io::{self, Write};
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use api::Problem;
use bytes::{Bytes, BytesMut};
use futures_util::{Stream, StreamExt};
use http_body_util::combinators::UnsyncBoxBody;
use http_body_util::{BodyExt, Full};
use hyper::body::Incoming;
use hyper::header::HeaderValue;
use hyper::upgrade::Upgraded;
use hyper::{Method, Request, Response, StatusCode, header};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tls::{KnownServers, Trust};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, UnixStream};
use tokio::time::timeout;
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::handshake::client::generate_key;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};

use crate::whole::AtomicFile;

const FALLBACK: &str = "127.0.0.1:9090";
/// Time allowed to establish a connection, and again for the TLS handshake.
const CONNECTING: Duration = Duration::from_secs(10);

/// Advice after a response of 401.
const TOKEN_ADVICE: &str = "pass a token created by an admin with --token TOKEN or CLOUDROID_TOKEN; root and members \
    of the group cloudroid need none on the server itself (--server unix:PATH)";

/// Advice when no authorities are installed.
const AUTHORITY_ADVICE: &str = "no certificate authorities are installed here, and the server's certificate is not \
    self-signed: apt install ca-certificates";

/// Name of this program in requests.
pub const NAME: &str = concat!("cloudroidctl/", env!("CARGO_PKG_VERSION"));

/// A WebSocket to the daemon.
pub type DaemonSocket = WebSocketStream<TokioIo<Upgraded>>;

/// Body of a request.
pub type RequestBody = UnsyncBoxBody<Bytes, std::io::Error>;

/// Address of the daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerAddress {
    /// `HOST:PORT`, without TLS.
    Tcp(String),
    /// `HOST:PORT`, with TLS.
    Tls(String),
    /// Unix socket of the daemon on this machine.
    Unix(PathBuf),
}

impl fmt::Display for ServerAddress {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ServerAddress::Tcp(authority) => write!(out, "http://{authority}"),
            ServerAddress::Tls(authority) => write!(out, "https://{authority}"),
            ServerAddress::Unix(path) => write!(out, "unix:{}", path.display()),
        }
    }
}

impl ServerAddress {
    /// Parses the value of `--server`.
    pub fn parse(text: &str) -> anyhow::Result<ServerAddress> {
        if let Some(path) = text.strip_prefix("unix:") {
            let path = path.strip_prefix("//").unwrap_or(path);
            return Ok(ServerAddress::Unix(path.into()));
        }
        if text.starts_with('/') {
            return Ok(ServerAddress::Unix(text.into()));
        }
        // Default ports: the daemon's own, or that of a proxy (RFC 9110, section 4.2.2) for HTTPS.
        let (secure, rest, port) = match text.split_once("://") {
            Some(("http" | "ws", rest)) => (false, rest, 9090),
            Some(("https" | "wss", rest)) => (true, rest, 443),
            Some((scheme, _)) => {
                bail!("{text}: unsupported scheme {scheme}; write https://HOST:PORT, http://HOST:PORT or unix:PATH")
            }
            None => (false, text, 9090),
        };
        let authority = rest.trim_end_matches('/');
        if authority.is_empty() || authority.contains(['/', '?', ' ']) {
            bail!("{text} names no server; write https://HOST:PORT, http://HOST:PORT or unix:PATH");
        }
        let has_port = authority
            .rsplit_once(':')
            .is_some_and(|(host, port)| (!host.contains(':') || host.ends_with(']')) && port.parse::<u16>().is_ok());
        let authority = if has_port { authority.to_owned() } else { format!("{authority}:{port}") };
        Ok(if secure { ServerAddress::Tls(authority) } else { ServerAddress::Tcp(authority) })
    }

    /// Returns the address of this machine's daemon.
    fn local_daemon() -> ServerAddress {
        let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        let home = variable("CLOUDROID_HOME")
            .or_else(|| variable("XDG_DATA_HOME").map(|data| data.join("cloudroid")))
            .or_else(|| variable("HOME").map(|user| user.join(".local/share/cloudroid")));
        let chosen = variable("CLOUDROID_HOME").is_some();
        let candidates = home.into_iter().chain([PathBuf::from("/var/lib/cloudroid")]);
        let sockets: Vec<PathBuf> = candidates
            .map(|home| home.join("run/daemon.sock"))
            // The admin socket, where members of a group are admins.
            .chain([PathBuf::from("/run/cloudroid/daemon.sock")])
            .collect();
        match sockets.iter().find(|socket| socket.exists()) {
            Some(socket) if !chosen || *socket == sockets[0] => ServerAddress::Unix(socket.clone()),
            // With CLOUDROID_HOME set, only the daemon of that home is meant.
            _ if chosen => ServerAddress::Unix(sockets[0].clone()),
            _ => ServerAddress::Tcp(FALLBACK.to_owned()),
        }
    }
}

/// HTTP client for one daemon.
#[derive(Debug)]
pub struct DaemonClient {
    server: ServerAddress,
    token: Option<String>,
    /// Trusts the certificate of a server that is seen for the first time, and tells its user.
    trusts_first: bool,
}

/// The daemon cannot be reached.
#[derive(Debug)]
pub struct DaemonUnreachable {
    server: ServerAddress,
    source: std::io::Error,
}

impl fmt::Display for DaemonUnreachable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "no daemon answers at {}: {}; start one (sudo cloudroidd), or name another with --server",
            self.server, self.source
        )
    }
}

impl std::error::Error for DaemonUnreachable {}

/// The connection was lost before a response, for example because the daemon was stopped.
#[derive(Debug)]
struct ConnectionLost {
    server: ServerAddress,
}

impl fmt::Display for ConnectionLost {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "the daemon at {} broke the connection", self.server)
    }
}

/// Returns whether an error means that the daemon does not answer now; one that is being restarted will answer soon.
pub fn is_unavailable(error: &anyhow::Error) -> bool {
    error.is::<DaemonUnreachable>() || error.is::<ConnectionLost>() || error.is::<TruncatedResponse>()
}

/// The connection was lost in the middle of a streamed response.
#[derive(Debug)]
struct TruncatedResponse {
    source: hyper::Error,
}

impl fmt::Display for TruncatedResponse {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "the daemon's response was cut off: {}", self.source)
    }
}

impl std::error::Error for TruncatedResponse {}

impl DaemonClient {
    /// Creates a client for the daemon at `server`, or for this machine's daemon.
    pub fn new(server: Option<&str>, token: Option<String>) -> anyhow::Result<DaemonClient> {
        let server = match server {
            Some(text) => ServerAddress::parse(text)?,
            None => ServerAddress::local_daemon(),
        };
        Ok(DaemonClient { server, token: token.filter(|token| !token.is_empty()), trusts_first: true })
    }

    /// Refuses servers whose certificate is not known yet: nobody would read what is said about it.
    pub fn without_first_trust(self) -> DaemonClient {
        DaemonClient { trusts_first: false, ..self }
    }

    /// Sends `GET path`.
    pub async fn get<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        read_json(self.send(Method::GET, path, empty_body()).await?).await
    }

    /// Sends `PATCH path` with `body` as JSON.
    pub async fn patch<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        read_json(self.send(Method::PATCH, path, json_body(body)?).await?).await
    }

    /// Sends `DELETE path`.
    pub async fn delete<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        read_json(self.send(Method::DELETE, path, empty_body()).await?).await
    }

    /// Sends `PUT path` with `body` as JSON.
    pub async fn put<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        read_json(self.send(Method::PUT, path, json_body(body)?).await?).await
    }

    /// Sends `POST path` with `body` as JSON.
    pub async fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        read_json(self.send(Method::POST, path, json_body(body)?).await?).await
    }

    /// Sends `GET path` and returns the response as a stream of JSON lines.
    pub async fn get_lines<T: DeserializeOwned>(
        &self,
        path: &str,
    ) -> anyhow::Result<impl Stream<Item = anyhow::Result<T>>> {
        Ok(json_lines(self.send(Method::GET, path, empty_body()).await?))
    }

    /// Sends a request and returns the response if its status is a success; otherwise returns its [`Problem`] as the
    /// error.
    pub async fn send(&self, method: Method, path: &str, body: RequestBody) -> anyhow::Result<Response<Incoming>> {
        let request = Request::builder().method(method).uri(path);
        self.dispatch(request.body(body)?).await
    }

    /// Sends `GET path` and writes the response to a file, which is replaced when the new one is complete; returns its
    /// size in bytes.
    pub async fn download(&self, path: &str, target: &Path) -> anyhow::Result<u64> {
        let answer = self.send(Method::GET, path, empty_body()).await?;
        let half = AtomicFile::create_beside(target)?;
        let mut bytes = 0;
        let mut parts = answer.into_body().into_data_stream();
        while let Some(part) = parts.next().await {
            let part = part.context("the daemon's response was cut off")?;
            bytes += part.len() as u64;
            (&half.file).write_all(&part).with_context(|| half.error_context())?;
        }
        half.persist()?;
        Ok(bytes)
    }

    /// Opens a WebSocket with this subprotocol (RFC 6455, section 4.1).
    pub async fn connect_websocket(&self, path: &str, protocol: &str) -> anyhow::Result<DaemonSocket> {
        let key = generate_key();
        let request = Request::builder()
            .uri(path)
            .header(header::CONNECTION, "Upgrade")
            .header(header::UPGRADE, "websocket")
            .header(header::SEC_WEBSOCKET_VERSION, "13")
            .header(header::SEC_WEBSOCKET_KEY, &key)
            .header(header::SEC_WEBSOCKET_PROTOCOL, protocol);
        let response = self.dispatch(request.body(empty_body())?).await?;
        let accepted = response.headers().get(header::SEC_WEBSOCKET_ACCEPT);
        let accepted = accepted.is_some_and(|accept| *accept == derive_accept_key(key.as_bytes()));
        if response.status() != StatusCode::SWITCHING_PROTOCOLS || !accepted {
            bail!("the server at {} does not support WebSocket", self.server);
        }
        let upgraded =
            hyper::upgrade::on(response).await.with_context(|| ConnectionLost { server: self.server.clone() })?;
        let config = WebSocketConfig::default().max_message_size(None).max_frame_size(None);
        let io = TokioIo::new(upgraded);
        Ok(WebSocketStream::from_raw_socket(io, Role::Client, Some(config)).await)
    }

    async fn dispatch(&self, request: Request<RequestBody>) -> anyhow::Result<Response<Incoming>> {
        let unreachable = |source| DaemonUnreachable { server: self.server.clone(), source };
        match &self.server {
            ServerAddress::Tcp(authority) => {
                let stream = connect_tcp(authority).await.map_err(unreachable)?;
                self.exchange(stream, authority, request).await
            }
            ServerAddress::Tls(authority) => {
                let stream = connect_tcp(authority).await.map_err(unreachable)?;
                let stream = self.connect_tls(stream, authority).await?;
                self.exchange(stream, authority, request).await
            }
            ServerAddress::Unix(socket) => {
                let stream = connect_unix(socket).await.map_err(unreachable)?;
                self.exchange(stream, "localhost", request).await
            }
        }
    }

    async fn connect_tls(&self, stream: TcpStream, authority: &str) -> anyhow::Result<TlsStream<TcpStream>> {
        let known = KnownServers::for_user();
        let is_known = || known.as_ref().and_then(|known| known.find(authority).ok().flatten()).is_some();
        if !self.trusts_first && !is_known() {
            bail!("{} is not known yet; see its certificate with: cloudroidctl status", self.server);
        }
        let (host, _) = authority.rsplit_once(':').unwrap_or((authority, ""));
        let trust = Trust {
            authorities: None,
            fingerprint: None,
            known,
            accept: format!("cloudroidctl trust {}", self.server),
            advice: AUTHORITY_ADVICE,
            identity: None,
        };
        let connecting = trust.connect(stream, host.trim_matches(['[', ']']), authority);
        let connected = timeout(CONNECTING, connecting)
            .await
            .unwrap_or_else(|_| Err(timeout_error()))
            .with_context(|| format!("TLS handshake with {} failed", self.server))?;
        if let (Some(first), Some(known)) = (connected.first, &trust.known) {
            eprintln!(
                "note: first connection to {}; its certificate's fingerprint {first} is stored in {}: compare it with \
                    the one that the daemon printed at start",
                self.server,
                known.path().display()
            );
        }
        Ok(connected.stream)
    }

    async fn exchange(
        &self,
        stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
        host: &str,
        mut request: Request<RequestBody>,
    ) -> anyhow::Result<Response<Incoming>> {
        let lost = || ConnectionLost { server: self.server.clone() };
        let (mut sender, connection) =
            hyper::client::conn::http1::handshake(TokioIo::new(stream)).await.with_context(lost)?;
        tokio::spawn(connection.with_upgrades());
        let headers = request.headers_mut();
        headers.insert(header::HOST, HeaderValue::from_str(host)?);
        headers.insert(header::USER_AGENT, HeaderValue::from_static(NAME));
        if let Some(token) = &self.token {
            let token = HeaderValue::from_str(&format!("Bearer {token}"))?;
            headers.insert(header::AUTHORIZATION, token);
        }
        let response = sender.send_request(request).await.with_context(lost)?;
        let status = response.status();
        if status.is_success() || status == StatusCode::SWITCHING_PROTOCOLS {
            return Ok(response);
        }
        Err(error_from_response(response).await)
    }
}

/// Connects with a timeout: a server that is switched off does not answer at all.
async fn connect_tcp(authority: &str) -> io::Result<TcpStream> {
    let dialled = timeout(CONNECTING, TcpStream::connect(authority)).await;
    let stream = dialled.unwrap_or_else(|_| Err(timeout_error()))?;
    let _ = stream.set_nodelay(true);
    Ok(stream)
}

fn timeout_error() -> io::Error {
    let words = format!("no response within {} s", CONNECTING.as_secs());
    io::Error::new(io::ErrorKind::TimedOut, words)
}

/// Connects through a descriptor of the socket's directory, because the path may be longer than a socket address
/// allows.
async fn connect_unix(socket: &Path) -> io::Result<UnixStream> {
    let (Some(directory), Some(name)) = (socket.parent(), socket.file_name()) else {
        return UnixStream::connect(socket).await;
    };
    match std::fs::File::open(directory) {
        Ok(opened) => {
            let descriptors = PathBuf::from(format!("/proc/self/fd/{}", opened.as_raw_fd()));
            UnixStream::connect(descriptors.join(name)).await
        }
        Err(_) => UnixStream::connect(socket).await,
    }
}

/// Returns an empty body.
pub fn empty_body() -> RequestBody {
    Full::default().map_err(|never| match never {}).boxed_unsync()
}

/// Returns a body of JSON.
pub fn json_body(body: &impl Serialize) -> serde_json::Result<RequestBody> {
    Ok(Full::new(Bytes::from(serde_json::to_vec(body)?)).map_err(|never| match never {}).boxed_unsync())
}

async fn error_from_response(response: Response<Incoming>) -> anyhow::Error {
    let status = response.status();
    let body = match response.into_body().collect().await {
        Ok(collected) => collected.to_bytes(),
        Err(error) => {
            return anyhow!("the daemon answered {status}, and the response was cut off: {error}");
        }
    };
    match serde_json::from_slice::<Problem>(&body) {
        Ok(mut problem) => {
            if status == StatusCode::UNAUTHORIZED {
                // The daemon's advice is for HTTP clients; here the token is an option.
                problem.next = Some(TOKEN_ADVICE.to_owned());
            }
            problem.into()
        }
        Err(_) => anyhow!("the daemon answered {status}: {}", String::from_utf8_lossy(&body).trim()),
    }
}

/// Reads a response as JSON.
pub async fn read_json<T: DeserializeOwned>(response: Response<Incoming>) -> anyhow::Result<T> {
    let body = response.into_body().collect().await.context("the daemon's response was cut off")?.to_bytes();
    serde_json::from_slice(&body).context("this version of cloudroidctl does not understand the daemon's response")
}

/// Reads a response as a stream of JSON lines.
pub fn json_lines<T: DeserializeOwned>(response: Response<Incoming>) -> impl Stream<Item = anyhow::Result<T>> {
    let state = (response.into_body(), BytesMut::new());
    futures_util::stream::try_unfold(state, |(mut body, mut pending)| async move {
        loop {
            if let Some(end) = line_end(&pending) {
                let line = pending.split_to(end + 1);
                if line.iter().all(u8::is_ascii_whitespace) {
                    continue;
                }
                let value = serde_json::from_slice(&line)
                    .context("this version of cloudroidctl does not understand the daemon's response")?;
                return Ok(Some((value, (body, pending))));
            }
            match body.frame().await {
                Some(frame) => {
                    if let Ok(data) = frame.map_err(|source| TruncatedResponse { source })?.into_data() {
                        pending.extend_from_slice(&data);
                    }
                }
                None => return Ok(None),
            }
        }
    })
    .boxed()
}

fn line_end(bytes: &[u8]) -> Option<usize> {
    bytes.iter().position(|byte| *byte == b'\n')
}

/// Percent-encodes a text as a path segment or a query value.
pub fn percent_encode(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for byte in text.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => escaped.push(char::from(byte)),
            _ => escaped.push_str(&format!("%{byte:02X}")),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn servers_are_named_in_several_ways() {
        let tcp = |text: &str| ServerAddress::Tcp(text.to_owned());
        let tls = |text: &str| ServerAddress::Tls(text.to_owned());
        for (text, server) in [
            ("http://10.0.0.1:9091", tcp("10.0.0.1:9091")),
            ("http://robot-server/", tcp("robot-server:9090")),
            ("robot-server:80", tcp("robot-server:80")),
            ("http://[::1]", tcp("[::1]:9090")),
            ("http://[::1]:80", tcp("[::1]:80")),
            ("https://10.0.0.1:9091/", tls("10.0.0.1:9091")),
            ("wss://robot-server", tls("robot-server:443")),
            ("https://[::1]", tls("[::1]:443")),
            ("unix:/run/x.sock", ServerAddress::Unix("/run/x.sock".into())),
            ("unix:///run/x.sock", ServerAddress::Unix("/run/x.sock".into())),
        ] {
            assert_eq!(ServerAddress::parse(text).expect(text), server);
        }
        for text in ["ftp://x", "https://", "http://", "http://x/api", ""] {
            ServerAddress::parse(text).expect_err(text);
        }
    }

    #[tokio::test]
    async fn a_daemon_that_ends_before_it_answers_is_away() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("its address");
        let ends = tokio::spawn(async move { drop(listener.accept().await) });
        let client = DaemonClient::new(Some(&format!("http://{address}")), None).expect("an address");
        let asked = || client.get::<api::Clock>("/api/v1/clock");
        let lost = asked().await.expect_err("nothing answers");
        assert!(is_unavailable(&lost), "{lost:#}");
        ends.await.expect("it ended");
        let unreachable = asked().await.expect_err("nothing is there");
        assert!(is_unavailable(&unreachable), "{unreachable:#}");
        assert!(!is_unavailable(&anyhow::anyhow!("anything else")));
    }

    #[test]
    fn names_are_escaped() {
        assert_eq!(percent_encode("a/b c?ä"), "a%2Fb%20c%3F%C3%A4");
    }
}
