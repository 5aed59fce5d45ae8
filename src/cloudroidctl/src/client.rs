//! HTTP to the daemon, over TCP or its Unix socket.

use std::fmt;
use std::io;
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

const FALLBACK: &str = "127.0.0.1:9090";
/// How long a server may take to accept a connection, and then to show its certificate.
const CONNECTING: Duration = Duration::from_secs(10);

/// What to do about a 401.
const TOKEN_WANTED: &str = "give a token that an admin made for you with --token TOKEN or CLOUDROID_TOKEN; root and the group \
                            cloudroid need none over the daemon's sockets (--server unix:PATH)";

/// Where no authority is known.
const NOBODY_TRUSTED: &str = "no authority is trusted here, and the server's certificate does not sign itself: apt install ca-certificates";

const NAME: &str = concat!("cloudroidctl/", env!("CARGO_PKG_VERSION"));

/// A WebSocket to the daemon.
pub type Socket = WebSocketStream<TokioIo<Upgraded>>;

/// What is sent.
pub type Body = UnsyncBoxBody<Bytes, std::io::Error>;

/// Where the daemon is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Server {
    /// `HOST:PORT`.
    Tcp(String),
    /// The same through TLS.
    Tls(String),
    /// Unix socket of the daemon on this machine.
    Unix(PathBuf),
}

impl fmt::Display for Server {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Server::Tcp(authority) => write!(out, "http://{authority}"),
            Server::Tls(authority) => write!(out, "https://{authority}"),
            Server::Unix(path) => write!(out, "unix:{}", path.display()),
        }
    }
}

impl Server {
    /// Reads `--server`.
    pub fn parse(text: &str) -> anyhow::Result<Server> {
        if let Some(path) = text.strip_prefix("unix:") {
            let path = path.strip_prefix("//").unwrap_or(path);
            return Ok(Server::Unix(path.into()));
        }
        if text.starts_with('/') {
            return Ok(Server::Unix(text.into()));
        }
        // Without a port: the daemon's own, and that of a proxy (RFC 9110, section 4.2.2).
        let (secure, rest, port) = match text.split_once("://") {
            Some(("http" | "ws", rest)) => (false, rest, 9090),
            Some(("https" | "wss", rest)) => (true, rest, 443),
            Some((scheme, _)) => {
                bail!(
                    "{text}: {scheme} is not spoken here; write https://HOST:PORT, http://HOST:PORT or unix:PATH"
                )
            }
            None => (false, text, 9090),
        };
        let authority = rest.trim_end_matches('/');
        if authority.is_empty() || authority.contains(['/', '?', ' ']) {
            bail!("{text} names no server; write https://HOST:PORT, http://HOST:PORT or unix:PATH");
        }
        let has_port = authority.rsplit_once(':').is_some_and(|(host, port)| {
            (!host.contains(':') || host.ends_with(']')) && port.parse::<u16>().is_ok()
        });
        let authority = match has_port {
            true => authority.to_owned(),
            false => format!("{authority}:{port}"),
        };
        Ok(match secure {
            true => Server::Tls(authority),
            false => Server::Tcp(authority),
        })
    }

    /// The daemon of this machine.
    fn default() -> Server {
        let variable = |name| {
            std::env::var_os(name)
                .filter(|value| !value.is_empty())
                .map(PathBuf::from)
        };
        let home = variable("CLOUDROID_HOME")
            .or_else(|| variable("XDG_DATA_HOME").map(|data| data.join("cloudroid")))
            .or_else(|| variable("HOME").map(|user| user.join(".local/share/cloudroid")));
        let chosen = variable("CLOUDROID_HOME").is_some();
        let candidates = home
            .into_iter()
            .chain([PathBuf::from("/var/lib/cloudroid")]);
        let sockets: Vec<PathBuf> = candidates
            .map(|home| home.join("run/daemon.sock"))
            // At which members of a group are admins.
            .chain([PathBuf::from("/run/cloudroid/daemon.sock")])
            .collect();
        match sockets.iter().find(|socket| socket.exists()) {
            Some(socket) if !chosen || *socket == sockets[0] => Server::Unix(socket.clone()),
            // Who names a home means its daemon and no other.
            _ if chosen => Server::Unix(sockets[0].clone()),
            _ => Server::Tcp(FALLBACK.to_owned()),
        }
    }
}

/// Speaks to one daemon.
#[derive(Debug)]
pub struct Client {
    server: Server,
    token: Option<String>,
}

/// The daemon does not answer at all.
#[derive(Debug)]
pub struct Unreachable {
    server: Server,
    source: std::io::Error,
}

impl fmt::Display for Unreachable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "no daemon answers at {}: {}; start one (sudo cloudroidd), or name another with --server",
            self.server, self.source
        )
    }
}

impl std::error::Error for Unreachable {}

/// The connection was lost before there was an answer: the daemon was ended in between, perhaps.
#[derive(Debug)]
struct Lost {
    server: Server,
}

impl fmt::Display for Lost {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "the daemon at {} broke the connection", self.server)
    }
}

/// Whether there is no daemon to answer now; one that is being started again is there soon.
pub fn is_away(error: &anyhow::Error) -> bool {
    error.is::<Unreachable>() || error.is::<Lost>() || error.is::<BrokenOff>()
}

/// The connection was lost within an answer that comes in parts.
#[derive(Debug)]
struct BrokenOff {
    source: hyper::Error,
}

impl fmt::Display for BrokenOff {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "the daemon broke off its answer: {}", self.source)
    }
}

impl std::error::Error for BrokenOff {}

impl Client {
    /// For the daemon that `--server` names.
    pub fn new(server: Option<&str>, token: Option<String>) -> anyhow::Result<Client> {
        let server = match server {
            Some(text) => Server::parse(text)?,
            None => Server::default(),
        };
        Ok(Client {
            server,
            token: token.filter(|token| !token.is_empty()),
        })
    }

    /// `GET path`.
    pub async fn get<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        read(self.send(Method::GET, path, empty()).await?).await
    }

    /// `PATCH path` with `body` as JSON.
    pub async fn patch<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> anyhow::Result<T> {
        read(self.send(Method::PATCH, path, json(body)?).await?).await
    }

    /// `DELETE path`.
    pub async fn delete<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        read(self.send(Method::DELETE, path, empty()).await?).await
    }

    /// `PUT path` with `body` as JSON.
    pub async fn put<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> anyhow::Result<T> {
        read(self.send(Method::PUT, path, json(body)?).await?).await
    }

    /// `POST path` with a JSON body.
    pub async fn post<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> anyhow::Result<T> {
        read(self.send(Method::POST, path, json(body)?).await?).await
    }

    /// `GET path` of JSON lines.
    pub async fn lines<T: DeserializeOwned>(
        &self,
        path: &str,
    ) -> anyhow::Result<impl Stream<Item = anyhow::Result<T>>> {
        Ok(lines(self.send(Method::GET, path, empty()).await?))
    }

    /// Sends a request and gives the answer if it is a good one, else its [`Problem`].
    pub async fn send(
        &self,
        method: Method,
        path: &str,
        body: Body,
    ) -> anyhow::Result<Response<Incoming>> {
        let request = Request::builder().method(method).uri(path);
        self.ask(request.body(body)?).await
    }

    /// Becomes a WebSocket of this subprotocol (RFC 6455, section 4.1).
    pub async fn socket(&self, path: &str, protocol: &str) -> anyhow::Result<Socket> {
        let key = generate_key();
        let request = Request::builder()
            .uri(path)
            .header(header::CONNECTION, "Upgrade")
            .header(header::UPGRADE, "websocket")
            .header(header::SEC_WEBSOCKET_VERSION, "13")
            .header(header::SEC_WEBSOCKET_KEY, &key)
            .header(header::SEC_WEBSOCKET_PROTOCOL, protocol);
        let response = self.ask(request.body(empty())?).await?;
        let accepted = response.headers().get(header::SEC_WEBSOCKET_ACCEPT);
        let accepted = accepted.is_some_and(|accept| *accept == derive_accept_key(key.as_bytes()));
        if response.status() != StatusCode::SWITCHING_PROTOCOLS || !accepted {
            bail!("what answers at {} speaks no WebSocket", self.server);
        }
        let upgraded = hyper::upgrade::on(response).await.with_context(|| Lost {
            server: self.server.clone(),
        })?;
        let config = WebSocketConfig::default()
            .max_message_size(None)
            .max_frame_size(None);
        let io = TokioIo::new(upgraded);
        Ok(WebSocketStream::from_raw_socket(io, Role::Client, Some(config)).await)
    }

    async fn ask(&self, request: Request<Body>) -> anyhow::Result<Response<Incoming>> {
        let unreachable = |source| Unreachable {
            server: self.server.clone(),
            source,
        };
        match &self.server {
            Server::Tcp(authority) => {
                let stream = dial(authority).await.map_err(unreachable)?;
                self.exchange(stream, authority, request).await
            }
            Server::Tls(authority) => {
                let stream = dial(authority).await.map_err(unreachable)?;
                let stream = self.secured(stream, authority).await?;
                self.exchange(stream, authority, request).await
            }
            Server::Unix(socket) => {
                let stream = connect(socket).await.map_err(unreachable)?;
                self.exchange(stream, "localhost", request).await
            }
        }
    }

    async fn secured(
        &self,
        stream: TcpStream,
        authority: &str,
    ) -> anyhow::Result<TlsStream<TcpStream>> {
        let (host, _) = authority.rsplit_once(':').unwrap_or((authority, ""));
        let trust = Trust {
            authorities: None,
            fingerprint: None,
            known: KnownServers::of_user(),
            accept: format!("cloudroidctl trust {}", self.server),
            advice: NOBODY_TRUSTED,
            identity: None,
        };
        let connecting = trust.connect(stream, host.trim_matches(['[', ']']), authority);
        let connected = timeout(CONNECTING, connecting)
            .await
            .unwrap_or_else(|_| Err(silent()))
            .with_context(|| format!("no TLS with {}", self.server))?;
        if let (Some(first), Some(known)) = (connected.first, &trust.known) {
            eprintln!(
                "note: {} is new here; its certificate {first} is remembered in {}: compare it with what the daemon said at its start",
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
        mut request: Request<Body>,
    ) -> anyhow::Result<Response<Incoming>> {
        let lost = || Lost {
            server: self.server.clone(),
        };
        let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
            .await
            .with_context(lost)?;
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
        Err(refusal(response).await)
    }
}

/// A server that is switched off answers nothing at all.
async fn dial(authority: &str) -> io::Result<TcpStream> {
    let dialled = timeout(CONNECTING, TcpStream::connect(authority)).await;
    let stream = dialled.unwrap_or_else(|_| Err(silent()))?;
    let _ = stream.set_nodelay(true);
    Ok(stream)
}

fn silent() -> io::Error {
    let words = format!("nothing answered within {} s", CONNECTING.as_secs());
    io::Error::new(io::ErrorKind::TimedOut, words)
}

/// Through a descriptor of its directory, because the path itself may be longer than an address can be.
async fn connect(socket: &Path) -> io::Result<UnixStream> {
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

/// No body.
pub fn empty() -> Body {
    Full::default()
        .map_err(|never| match never {})
        .boxed_unsync()
}

/// A body as JSON.
pub fn json(body: &impl Serialize) -> serde_json::Result<Body> {
    Ok(Full::new(Bytes::from(serde_json::to_vec(body)?))
        .map_err(|never| match never {})
        .boxed_unsync())
}

async fn refusal(response: Response<Incoming>) -> anyhow::Error {
    let status = response.status();
    let body = match response.into_body().collect().await {
        Ok(collected) => collected.to_bytes(),
        Err(error) => return anyhow!("the daemon answered {status} and broke off: {error}"),
    };
    match serde_json::from_slice::<Problem>(&body) {
        Ok(mut problem) => {
            if status == StatusCode::UNAUTHORIZED {
                // The daemon tells whoever speaks HTTP what to send; here it is an option.
                problem.next = Some(TOKEN_WANTED.to_owned());
            }
            problem.into()
        }
        Err(_) => anyhow!(
            "the daemon answered {status}: {}",
            String::from_utf8_lossy(&body).trim()
        ),
    }
}

/// The JSON of an answer.
pub async fn read<T: DeserializeOwned>(response: Response<Incoming>) -> anyhow::Result<T> {
    let body = response
        .into_body()
        .collect()
        .await
        .context("the daemon broke off its answer")?
        .to_bytes();
    serde_json::from_slice(&body)
        .context("the daemon's answer is not what this version of cloudroidctl understands")
}

/// The JSON lines of an answer, as they come.
pub fn lines<T: DeserializeOwned>(
    response: Response<Incoming>,
) -> impl Stream<Item = anyhow::Result<T>> {
    let state = (response.into_body(), BytesMut::new());
    futures_util::stream::try_unfold(state, |(mut body, mut pending)| async move {
        loop {
            if let Some(end) = line_end(&pending) {
                let line = pending.split_to(end + 1);
                if line.iter().all(u8::is_ascii_whitespace) {
                    continue;
                }
                let value = serde_json::from_slice(&line).context(
                    "the daemon's answer is not what this version of cloudroidctl understands",
                )?;
                return Ok(Some((value, (body, pending))));
            }
            match body.frame().await {
                Some(frame) => {
                    if let Ok(data) = frame.map_err(|source| BrokenOff { source })?.into_data() {
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

/// A text as one segment of a path or one value of a query.
pub fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for byte in text.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => {
                escaped.push(char::from(byte))
            }
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
        let tcp = |text: &str| Server::Tcp(text.to_owned());
        let tls = |text: &str| Server::Tls(text.to_owned());
        for (text, server) in [
            ("http://10.0.0.1:9091", tcp("10.0.0.1:9091")),
            ("http://robot-server/", tcp("robot-server:9090")),
            ("robot-server:80", tcp("robot-server:80")),
            ("http://[::1]", tcp("[::1]:9090")),
            ("http://[::1]:80", tcp("[::1]:80")),
            ("https://10.0.0.1:9091/", tls("10.0.0.1:9091")),
            ("wss://robot-server", tls("robot-server:443")),
            ("https://[::1]", tls("[::1]:443")),
            ("unix:/run/x.sock", Server::Unix("/run/x.sock".into())),
            ("unix:///run/x.sock", Server::Unix("/run/x.sock".into())),
        ] {
            assert_eq!(Server::parse(text).expect(text), server);
        }
        for text in ["ftp://x", "https://", "http://", "http://x/api", ""] {
            Server::parse(text).expect_err(text);
        }
    }

    #[tokio::test]
    async fn a_daemon_that_ends_before_it_answers_is_away() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0")
            .await
            .expect("a port");
        let address = listener.local_addr().expect("its address");
        let ends = tokio::spawn(async move { drop(listener.accept().await) });
        let client = Client::new(Some(&format!("http://{address}")), None).expect("an address");
        let asked = || client.get::<api::Clock>("/api/v1/clock");
        let lost = asked().await.expect_err("nothing answers");
        assert!(is_away(&lost), "{lost:#}");
        ends.await.expect("it ended");
        let unreachable = asked().await.expect_err("nothing is there");
        assert!(is_away(&unreachable), "{unreachable:#}");
        assert!(!is_away(&anyhow::anyhow!("anything else")));
    }

    #[test]
    fn names_are_escaped() {
        assert_eq!(escaped("a/b c?ä"), "a%2Fb%20c%3F%C3%A4");
    }
}
