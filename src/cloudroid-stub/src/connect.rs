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
use crate::stream::{Stream, refused_certificate};

/// For TCP's own handshake.
const TCP: Duration = Duration::from_secs(2);
/// The longest answer to the handshake.
const MAX_HEAD: usize = 64 * 1024;
/// For a frame of the server to come as a whole, once it has begun.
const UNFINISHED: Duration = Duration::from_secs(300);
const GUID: &str = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
/// Unsent bytes that the kernel may hold: what waits in it cannot be replaced by something newer, and a command waits for it. At 500 kbit/s they
/// are a quarter of a second.
const UNSENT: u32 = 16 * 1024;

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Trying again may help.
    #[error("{0}")]
    Unreachable(String),
    /// Trying again may help, and the server is there: it has no room, say.
    #[error("{0}")]
    Busy(String),
    /// The portal does not want this stub; trying again changes nothing.
    #[error("{0}")]
    Refused(String),
}

/// Connects to `path` of the portal.
pub async fn open(
    config: &Config,
    path: &str,
    token: Option<&str>,
    patience: Duration,
) -> Result<WebSocket<Stream>, Error> {
    let address = config.address().map_err(Error::Refused)?;
    let trust = config
        .trust()
        .map_err(|error| Error::Refused(format!("{error:#}")))?;
    let opening = handshake(&address, &trust, path, token);
    match timeout(patience, opening).await {
        Ok(opened) => opened,
        Err(_) => Err(Error::Unreachable(format!(
            "{} did not answer within {patience:?}",
            config.server
        ))),
    }
}

async fn handshake(
    address: &Address,
    trust: &Trust,
    path: &str,
    token: Option<&str>,
) -> Result<WebSocket<Stream>, Error> {
    let authority = &address.authority;
    let unreachable = |what: &str, error: std::io::Error| match refused_certificate(&error) {
        Some(words) => Error::Refused(format!("{authority} refuses this robot: {words}")),
        None => Error::Unreachable(format!("{what} {authority}: {error}")),
    };
    let ip = resolver::resolve(&address.host)
        .await
        .map_err(|error| unreachable("cannot find", error))?;
    // A packet that was lost would be sent again ever more seldom.
    let stream = match timeout(TCP, TcpStream::connect((ip, address.port))).await {
        Ok(stream) => stream,
        Err(elapsed) => Err(elapsed.into()),
    };
    let stream = stream.map_err(|error| unreachable("cannot connect to", error))?;
    let socket = socket2::SockRef::from(&stream);
    let _ = socket.set_tcp_nodelay(true);
    let _ = socket.set_tcp_keepalive(&keepalive());
    let _ = socket.set_tcp_notsent_lowat(UNSENT);
    let mut stream = Stream::over(stream, address, trust)
        .await
        .map_err(|error| unreachable("no TLS with", error))?;
    let key = STANDARD.encode_to_string(rand::random::<[u8; 16]>());
    let mut request = format!(
        "GET {path} HTTP/1.1\r\nHost: {authority}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Protocol: {}\r\nUser-Agent: cloudroid-stub/{}\r\n",
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
        // What the server has said before it closed says more.
        let said = stream.read_buf(&mut answer).await.err();
        let said = said.filter(|said| refused_certificate(said).is_some());
        return Err(unreachable("cannot write to", said.unwrap_or(error)));
    }
    let end = loop {
        if let Some(end) = find(&answer, b"\r\n\r\n") {
            break end + 4;
        }
        if answer.len() > MAX_HEAD {
            return Err(Error::Refused(format!(
                "{authority} does not answer in HTTP"
            )));
        }
        match stream.read_buf(&mut answer).await {
            Ok(0) => {
                return Err(Error::Unreachable(format!(
                    "{authority} closed the connection"
                )));
            }
            Ok(_) => {}
            Err(error) => return Err(unreachable("cannot read from", error)),
        }
    };
    let head = String::from_utf8_lossy(&answer[..end]).into_owned();
    let status: u16 = head
        .split(' ')
        .nth(1)
        .and_then(|code| code.parse().ok())
        .unwrap_or(0);
    if status != 101 {
        let problem = body(&mut stream, &head, answer.split_off(end)).await;
        let mut text = format!("{authority} answers {status}: {problem}");
        if status == 401 && trust.identity.is_none() {
            text.push_str("; on this robot: install.sh --token TOKEN, or token_file in stub.toml");
        }
        // No room and the like pass; what this stub is does not.
        return Err(match status {
            400..=499 if status != 408 && status != 429 => Error::Refused(text),
            _ => Error::Busy(text),
        });
    }
    let expected = STANDARD.encode_to_string(Sha1::digest(format!("{key}{GUID}")));
    if header(&head, "sec-websocket-accept") != Some(&expected) {
        return Err(Error::Refused(format!(
            "{authority} is no WebSocket server"
        )));
    }
    if header(&head, "sec-websocket-protocol") != Some(link::SUBPROTOCOL) {
        return Err(Error::Refused(format!(
            "{authority} does not speak {}: its version is older than this stub; install the stub from it again",
            link::SUBPROTOCOL
        )));
    }
    let socket = WebSocket::client(
        stream,
        &answer[end..],
        link::MAX_FRAME,
        link::MAX_RECORD,
        rand::random(),
    );
    Ok(socket.within(&run::FROM_SERVER, UNFINISHED))
}

/// While a servant is made ready nothing comes, and yet the network may be lost.
fn keepalive() -> socket2::TcpKeepalive {
    socket2::TcpKeepalive::new()
        .with_time(Duration::from_secs(5))
        .with_interval(Duration::from_secs(2))
        .with_retries(3)
}

/// What a problem document says, or the text as it is.
async fn body(stream: &mut Stream, head: &str, mut begun: Vec<u8>) -> String {
    let length = header(head, "content-length")
        .and_then(|text| text.parse().ok())
        .unwrap_or(0_usize);
    while begun.len() < length.min(MAX_HEAD)
        && stream.read_buf(&mut begun).await.is_ok_and(|read| read > 0)
    {}
    let document: serde_json::Value = serde_json::from_slice(&begun).unwrap_or_default();
    let said = ["detail", "next", "title"]
        .iter()
        .filter_map(|key| document[key].as_str());
    let said: Vec<&str> = said.take(2).collect();
    if said.is_empty() {
        String::from_utf8_lossy(&begun).trim().to_owned()
    } else {
        said.join("; ")
    }
}

fn header<'a>(head: &'a str, name: &str) -> Option<&'a str> {
    head.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        key.eq_ignore_ascii_case(name).then(|| value.trim())
    })
}

fn find(bytes: &[u8], wanted: &[u8]) -> Option<usize> {
    bytes
        .windows(wanted.len())
        .position(|window| window == wanted)
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;

    /// What a server that `serves` one connection is taken for.
    async fn met<F: Future<Output = ()> + Send + 'static>(
        serves: impl FnOnce(TcpStream) -> F,
    ) -> Error {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server = format!("ws://{}", listener.local_addr().unwrap());
        let settings = format!("server = {server:?}\nservice = 'any'");
        let config: Config = toml::from_str(&settings).unwrap();
        let opened = tokio::spawn(async move {
            open(&config, "/any", None, Duration::from_secs(20))
                .await
                .err()
        });
        let served = tokio::spawn(serves(listener.accept().await.unwrap().0));
        let error = opened.await.unwrap().expect("no link");
        served.await.unwrap();
        error
    }

    #[tokio::test]
    async fn a_server_that_speaks_no_version_of_the_link_is_named() {
        let error = met(|stream| async {
            // An honest WebSocket server, which knows nothing of links.
            let _ = tokio_tungstenite::accept_async(stream).await;
        })
        .await;
        let Error::Refused(text) = error else {
            panic!("trying again changes nothing, but: {error}");
        };
        assert!(text.contains("does not speak cloudroid-link.v2"), "{text}");
        assert!(text.contains("install the stub from it again"), "{text}");
    }

    #[tokio::test]
    async fn what_is_no_server_of_the_web_is_named() {
        let error = met(|mut stream| async move {
            let noise = vec![b'x'; MAX_HEAD * 2];
            let _ = stream.write_all(&noise).await;
        })
        .await;
        assert!(
            error.to_string().contains("does not answer in HTTP"),
            "{error}"
        );
        let error = met(|stream| async move { drop(stream) }).await;
        assert!(matches!(error, Error::Unreachable(_)), "{error}");
    }
}
