//! One request over a connection of its own: what the doctor asks the portal before there is a link, and pairing.

use std::io;
use std::net::IpAddr;
use std::time::{Duration, Instant, SystemTime};

use nix::sys::socket::{getsockopt, sockopt::IpMtu};
use tls::{Fingerprint, Trust};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::address::Address;
use crate::stream::{self, Stream};

/// For all of one answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// The doctor asks for nothing bigger.
const LONGEST: u64 = 16 << 20;

/// An answer.
pub struct Answer {
    /// HTTP status.
    pub status: u16,
    /// Body of the answer.
    pub body: Vec<u8>,
    /// From the request to the first byte of the answer.
    pub waited: Duration,
    /// When that came, by this machine's clock: the connection may end much later.
    pub arrived: SystemTime,
    /// The path's MTU as the kernel knows it, where it does.
    pub mtu: Option<i32>,
}

/// A server to be asked over HTTP.
pub struct Server {
    /// Address as it was configured.
    pub address: Address,
    /// The address to which its name was resolved.
    pub ip: IpAddr,
    /// Whom to trust where TLS is spoken.
    pub trust: Trust,
    /// The one certificate that the server must show, whoever has signed it.
    pub only: Option<Fingerprint>,
}

/// `GET path`.
pub async fn get(server: &Server, path: &str, token: Option<&str>) -> io::Result<Answer> {
    in_time(server, path, token, None).await
}

/// `POST path` with JSON.
pub async fn post(server: &Server, path: &str, body: &serde_json::Value) -> io::Result<Answer> {
    in_time(server, path, None, Some(body.to_string())).await
}

async fn in_time(
    server: &Server,
    path: &str,
    token: Option<&str>,
    body: Option<String>,
) -> io::Result<Answer> {
    tokio::time::timeout(PATIENCE, exchange(server, path, token, body))
        .await
        .unwrap_or_else(|_| {
            let words = format!("no whole answer to {path} within {PATIENCE:?}");
            Err(io::Error::new(io::ErrorKind::TimedOut, words))
        })
}

async fn exchange(
    server: &Server,
    path: &str,
    token: Option<&str>,
    body: Option<String>,
) -> io::Result<Answer> {
    let authority = &server.address.authority;
    let stream = TcpStream::connect((server.ip, server.address.port)).await?;
    stream.set_nodelay(true)?;
    let mut stream = Stream::over(stream, &server.address, &server.trust).await?;
    let shown = stream.fingerprint();
    if let Some(only) = server.only.filter(|only| shown != Some(*only)) {
        let shown = shown.map_or_else(|| "none".to_owned(), |shown| shown.to_string());
        return Err(io::Error::other(format!(
            "the server shows the certificate {shown}, and the one that was told is {only}: somebody may stand between"
        )));
    }
    let method = if body.is_some() { "POST" } else { "GET" };
    let mut request = format!(
        "{method} {path} HTTP/1.1\r\nHost: {authority}\r\nConnection: close\r\nUser-Agent: cloudroid-stub/{}\r\n",
        env!("CARGO_PKG_VERSION")
    );
    if let Some(token) = token {
        request.push_str(&format!("Authorization: Bearer {token}\r\n"));
    }
    if let Some(body) = &body {
        let length = body.len();
        request.push_str(&format!(
            "Content-Type: application/json\r\nContent-Length: {length}\r\n"
        ));
    }
    request.push_str("\r\n");
    request.push_str(body.as_deref().unwrap_or_default());
    let began = Instant::now();
    let sent = stream.write_all(request.as_bytes()).await;
    let mut first = [0; 1];
    if let Err(error) = sent {
        // What the server has said before it closed says more.
        let said = stream.read_exact(&mut first).await.err();
        let said = said.filter(|said| stream::refused_certificate(said).is_some());
        return Err(said.unwrap_or(error));
    }
    stream.read_exact(&mut first).await?;
    let (waited, arrived) = (began.elapsed(), SystemTime::now());
    let mtu = getsockopt(stream.tcp(), IpMtu).ok();
    let mut answer = first.to_vec();
    match stream.take(LONGEST).read_to_end(&mut answer).await {
        Ok(_) => {}
        // Many servers of TLS end without saying so; what has come is judged by its length.
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {}
        Err(error) => return Err(error),
    }
    let (status, body) = understood(&answer)
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "this is no HTTP answer"))?;
    Ok(Answer {
        status,
        body,
        waited,
        arrived,
        mtu,
    })
}

impl Answer {
    /// What a problem document says (RFC 9457), or the text as it is.
    pub fn words(&self) -> String {
        let document: serde_json::Value = serde_json::from_slice(&self.body).unwrap_or_default();
        let said = ["detail", "next"].iter();
        let said: Vec<&str> = said.filter_map(|key| document[key].as_str()).collect();
        match said.is_empty() {
            true => String::from_utf8_lossy(&self.body).trim().to_owned(),
            false => said.join("; "),
        }
    }
}

/// Status and body. (RFC 9112; the portal sends bodies with a length or in chunks.)
fn understood(answer: &[u8]) -> Option<(u16, Vec<u8>)> {
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n")?;
    let head = std::str::from_utf8(&answer[..end]).ok()?;
    let status = head
        .strip_prefix("HTTP/1.")?
        .split(' ')
        .nth(1)?
        .parse()
        .ok()?;
    let body = &answer[end + 4..];
    let chunked = head
        .to_ascii_lowercase()
        .contains("transfer-encoding: chunked");
    let body = if chunked {
        without_chunks(body)?
    } else {
        body.to_vec()
    };
    Some((status, body))
}

fn without_chunks(mut body: &[u8]) -> Option<Vec<u8>> {
    let mut whole = Vec::new();
    loop {
        let end = body.windows(2).position(|two| two == b"\r\n")?;
        let size = std::str::from_utf8(&body[..end]).ok()?;
        let size = usize::from_str_radix(size.split(';').next()?.trim(), 16).ok()?;
        body = &body[end + 2..];
        if size == 0 {
            return Some(whole);
        }
        whole.extend_from_slice(body.get(..size)?);
        body = body.get(size + 2..)?;
    }
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;

    /// Answers one connection, keeps it open for a while, and says when it closed it.
    async fn closes_late(listener: TcpListener) -> SystemTime {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            head.push(stream.read_u8().await.unwrap());
        }
        let answer = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok";
        stream.write_all(answer).await.unwrap();
        // Nothing tells the server that its answer was read.
        tokio::time::sleep(Duration::from_millis(100)).await;
        SystemTime::now()
    }

    #[tokio::test]
    async fn an_answer_arrives_before_its_connection_ends() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let settings = format!("server = 'ws://{address}'\nservice = 'any'");
        let config: crate::config::Config = toml::from_str(&settings).unwrap();
        let server = Server {
            address: config.address().unwrap(),
            ip: address.ip(),
            trust: config.trust().unwrap(),
            only: None,
        };
        let (answer, closed) = tokio::join!(get(&server, "/", None), closes_late(listener));
        let answer = answer.unwrap();
        assert_eq!(answer.body, b"ok");
        assert!(answer.arrived < closed);
    }

    #[test]
    fn answers_are_understood_whole_or_in_chunks() {
        let plain = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok";
        assert_eq!(understood(plain), Some((200, b"ok".to_vec())));
        let chunked =
            b"HTTP/1.1 404 Not Found\r\nTransfer-Encoding: chunked\r\n\r\n2\r\nab\r\n1;x\r\nc\r\n0\r\n\r\n";
        assert_eq!(understood(chunked), Some((404, b"abc".to_vec())));
        for broken in [
            &b""[..],
            b"SSH-2.0-x\r\n\r\n",
            b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nff\r\nshort",
        ] {
            assert_eq!(understood(broken), None);
        }
    }
}
