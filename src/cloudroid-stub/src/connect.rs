//! Opens a WebSocket to the portal (RFC 6455, section 4.1).

use std::time::Duration;

use base64_simd::STANDARD;
use sha1::{Digest, Sha1};
use tls::Trust;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use ws::WebSocket;

use crate::address::Address;
use crate::config::Config;
use crate::resolver;
use crate::run;
use crate::stream::{PortalStream, certificate_refusal};

/// Time allowed for the TCP handshake.
const TCP: Duration = Duration::from_secs(2);
/// Largest response to the WebSocket handshake, in bytes.
const MAX_HEAD: usize = 64 * 1024;
/// Time allowed for a frame of the server from its first byte to its last.
const FRAME_TIMEOUT: Duration = Duration::from_secs(300);
const GUID: &str = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
/// Unsent bytes that the kernel may hold: data in the kernel cannot be replaced by newer data, and a command has to
/// wait for it. At 500 kbit/s this is a quarter of a second.
const UNSENT: u32 = 16 * 1024;

/// Reason why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The server cannot be reached; a retry may help.
    #[error("{0}")]
    Unreachable(String),
    /// The server is reachable but cannot accept the stub now, for example for lack of capacity; a retry may help.
    #[error("{0}")]
    Busy(String),
    /// The portal refuses this stub; a retry does not help.
    #[error("{0}")]
    Refused(String),
}

/// Connects to `path` of the portal.
pub async fn open(
    config: &Config,
    path: &str,
    token: Option<&str>,
    patience: Duration,
) -> Result<WebSocket<PortalStream>, Error> {
    let address = config.address();
    let address = address.map_err(|error| Error::Refused(error.to_string()))?;
    let trust = config.trust().map_err(|error| Error::Refused(format!("{error:#}")))?;
    let opening = handshake(&address, &trust, path, token);
    match timeout(patience, opening).await {
        Ok(opened) => opened,
        Err(_) => Err(Error::Unreachable(format!("{} did not answer within {patience:?}", config.server))),
    }
}

async fn handshake(
    address: &Address,
    trust: &Trust,
    path: &str,
    token: Option<&str>,
) -> Result<WebSocket<PortalStream>, Error> {
    let authority = &address.authority;
    let unreachable = |what: &str, error: std::io::Error| match certificate_refusal(&error) {
        Some(words) => Error::Refused(format!("{authority} refuses this robot: {words}")),
        None => Error::Unreachable(format!("{what} {authority}: {error}")),
    };
    let ip = resolver::resolve(&address.host).await.map_err(|error| unreachable("cannot find", error))?;
    // TCP would retransmit a lost packet at increasing intervals.
    let stream = match timeout(TCP, TcpStream::connect((ip, address.port))).await {
        Ok(stream) => stream,
        Err(elapsed) => Err(elapsed.into()),
    };
    let stream = stream.map_err(|error| unreachable("cannot connect to", error))?;
    let socket = socket2::SockRef::from(&stream);
    let _ = socket.set_tcp_nodelay(true);
    let _ = socket.set_tcp_keepalive(&keepalive());
    let _ = socket.set_tcp_notsent_lowat(UNSENT);
    let mut stream = PortalStream::connect(stream, address, trust)
        .await
        .map_err(|error| unreachable("TLS handshake failed with", error))?;
    let key = STANDARD.encode_to_string(rand::random::<[u8; 16]>());
    let mut request = format!(
        "GET {path} HTTP/1.1\r\nHost: {authority}\r\nConnection: Upgrade\r\nUpgrade: \
         websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Protocol: \
         {}\r\nUser-Agent: cloudroid-stub/{}\r\n",
        link::SUBPROTOCOL,
        env!("CARGO_PKG_VERSION"),
    );
    if let Some(token) = token {
        request.push_str(&format!("Authorization: Bearer {token}\r\n"));
    }
    request.push_str("\r\n");
    let sent = stream.write_all(request.as_bytes()).await;
    let mut answer = Vec::new();
    if let Err(error) = sent {
        // A response that the server sent before it closed explains more.
        let said = stream.read_buf(&mut answer).await.err();
        let said = said.filter(|said| certificate_refusal(said).is_some());
        return Err(unreachable("cannot write to", said.unwrap_or(error)));
    }
    let end = loop {
        if let Some(end) = find_bytes(&answer, b"\r\n\r\n") {
            break end + 4;
        }
        if answer.len() > MAX_HEAD {
            return Err(Error::Refused(format!("{authority} is not an HTTP server")));
        }
        match stream.read_buf(&mut answer).await {
            Ok(0) => {
                return Err(Error::Unreachable(format!("{authority} closed the connection")));
            }
            Ok(_) => {}
            Err(error) => return Err(unreachable("cannot read from", error)),
        }
    };
    let head = String::from_utf8_lossy(&answer[..end]).into_owned();
    let status: u16 = head.split(' ').nth(1).and_then(|code| code.parse().ok()).unwrap_or(0);
    if status != 101 {
        let problem = problem_text(&mut stream, &head, answer.split_off(end)).await;
        let mut text = format!("{authority} answers {status}: {problem}");
        if status == 401 && trust.identity.is_none() {
            text.push_str("; on this robot: install.sh --token TOKEN, or token_file in stub.toml");
        }
        // Lack of capacity and the like are temporary; other errors of the client are not.
        return Err(match status {
            400..=499 if status != 408 && status != 429 => Error::Refused(text),
            _ => Error::Busy(text),
        });
    }
    let expected = STANDARD.encode_to_string(Sha1::digest(format!("{key}{GUID}")));
    if header(&head, "sec-websocket-accept") != Some(&expected) {
        return Err(Error::Refused(format!("{authority} is not a WebSocket server")));
    }
    if header(&head, "sec-websocket-protocol") != Some(link::SUBPROTOCOL) {
        return Err(Error::Refused(format!(
            "{authority} does not support {}: its version is older than this stub; install the stub again from this \
                server",
            link::SUBPROTOCOL
        )));
    }
    let socket = WebSocket::client(stream, &answer[end..], link::MAX_FRAME, link::MAX_RECORD, rand::random());
    Ok(socket.with_budget(&run::FROM_SERVER, FRAME_TIMEOUT))
}

/// Returns keepalive settings: while a servant is started no data arrives, and a lost network must still be noticed.
fn keepalive() -> socket2::TcpKeepalive {
    socket2::TcpKeepalive::new().with_time(Duration::from_secs(5)).with_interval(Duration::from_secs(2)).with_retries(3)
}

/// Reads the details of a problem document, or the body as text.
async fn problem_text(stream: &mut PortalStream, head: &str, mut begun: Vec<u8>) -> String {
    let length = header(head, "content-length").and_then(|text| text.parse().ok()).unwrap_or(0_usize);
    while begun.len() < length.min(MAX_HEAD) && stream.read_buf(&mut begun).await.is_ok_and(|read| read > 0) {}
    let document: serde_json::Value = serde_json::from_slice(&begun).unwrap_or_default();
    let said = ["detail", "next", "title"].iter().filter_map(|key| document[key].as_str());
    let said: Vec<&str> = said.take(2).collect();
    if said.is_empty() { String::from_utf8_lossy(&begun).trim().to_owned() } else { said.join("; ") }
}

fn header<'a>(head: &'a str, name: &str) -> Option<&'a str> {
    head.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        key.eq_ignore_ascii_case(name).then(|| value.trim())
    })
}

fn find_bytes(bytes: &[u8], wanted: &[u8]) -> Option<usize> {
    bytes.windows(wanted.len()).position(|window| window == wanted)
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;

    /// Returns the error of connecting to a server that `serves` one connection.
    async fn error_from<F: Future<Output = ()> + Send + 'static>(serves: impl FnOnce(TcpStream) -> F) -> Error {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server = format!("ws://{}", listener.local_addr().unwrap());
        let settings = format!("server = {server:?}\nservice = 'any'");
        let config: Config = toml::from_str(&settings).unwrap();
        let opened = tokio::spawn(async move { open(&config, "/any", None, Duration::from_secs(20)).await.err() });
        let served = tokio::spawn(serves(listener.accept().await.unwrap().0));
        let error = opened.await.unwrap().expect("no link");
        served.await.unwrap();
        error
    }

    #[tokio::test]
    async fn a_server_that_speaks_no_version_of_the_link_is_named() {
        let error = error_from(|stream| async {
            // A regular WebSocket server that does not know the link's subprotocol.
            let _ = tokio_tungstenite::accept_async(stream).await;
        })
        .await;
        let Error::Refused(text) = error else {
            panic!("trying again changes nothing, but: {error}");
        };
        assert!(text.contains("does not support cloudroid-link.v2"), "{text}");
        assert!(text.contains("install the stub again from this server"), "{text}");
    }

    #[tokio::test]
    async fn what_is_no_server_of_the_web_is_named() {
        let error = error_from(|mut stream| async move {
            let noise = vec![b'x'; MAX_HEAD * 2];
            let _ = stream.write_all(&noise).await;
        })
        .await;
        assert!(error.to_string().contains("is not an HTTP server"), "{error}");
        let error = error_from(|stream| async move { drop(stream) }).await;
        assert!(matches!(error, Error::Unreachable(_)), "{error}");
    }
}
