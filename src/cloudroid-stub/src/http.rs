//! Single HTTP requests, each over its own connection: the doctor's before there is a link, and those of pairing.

use std::io;
use std::net::IpAddr;
use std::time::{Duration, Instant, SystemTime};

use nix::sys::socket::{getsockopt, sockopt::IpMtu};
use tls::{Fingerprint, Trust};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::address::Address;
use crate::stream::{self, PortalStream};

/// Time allowed for a complete response.
const PATIENCE: Duration = Duration::from_secs(5);
/// Largest response in bytes, more than the doctor requests.
const LONGEST: u64 = 16 << 20;

/// An HTTP response.
pub struct HttpAnswer {
    /// HTTP status.
    pub status: u16,
    /// Body of the response.
    pub body: Vec<u8>,
    /// Time from the request to the first byte of the response.
    pub waited: Duration,
    /// Arrival of the first byte, by this machine's clock: the connection may end much later.
    pub arrived: SystemTime,
    /// MTU of the path, if the kernel knows it.
    pub mtu: Option<i32>,
}

/// A server for HTTP requests.
pub struct HttpServer {
    /// Configured address.
    pub address: Address,
    /// Resolved IP address.
    pub ip: IpAddr,
    /// Trust settings for TLS.
    pub trust: Trust,
    /// Fingerprint of the only accepted certificate, whoever has signed it.
    pub only: Option<Fingerprint>,
}

/// Sends `GET path`.
pub async fn get(server: &HttpServer, path: &str, token: Option<&str>) -> io::Result<HttpAnswer> {
    exchange_in_time(server, path, token, None).await
}

/// Sends `POST path` with JSON.
pub async fn post(server: &HttpServer, path: &str, body: &serde_json::Value) -> io::Result<HttpAnswer> {
    exchange_in_time(server, path, None, Some(body.to_string())).await
}

async fn exchange_in_time(
    server: &HttpServer,
    path: &str,
    token: Option<&str>,
    body: Option<String>,
) -> io::Result<HttpAnswer> {
    tokio::time::timeout(PATIENCE, exchange(server, path, token, body)).await.unwrap_or_else(|_| {
        let words = format!("no complete response to {path} within {PATIENCE:?}");
        Err(io::Error::new(io::ErrorKind::TimedOut, words))
    })
}

async fn exchange(
    server: &HttpServer,
    path: &str,
    token: Option<&str>,
    body: Option<String>,
) -> io::Result<HttpAnswer> {
    let authority = &server.address.authority;
    let stream = TcpStream::connect((server.ip, server.address.port)).await?;
    stream.set_nodelay(true)?;
    let mut stream = PortalStream::connect(stream, &server.address, &server.trust).await?;
    let shown = stream.fingerprint();
    if let Some(only) = server.only.filter(|only| shown != Some(*only)) {
        let shown = shown.map_or_else(|| "none".to_owned(), |shown| shown.to_string());
        return Err(io::Error::other(format!(
            "the server's certificate is {shown}, but {only} is expected: the connection may be intercepted"
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
        request.push_str(&format!("Content-Type: application/json\r\nContent-Length: {length}\r\n"));
    }
    request.push_str("\r\n");
    request.push_str(body.as_deref().unwrap_or_default());
    let began = Instant::now();
    let sent = stream.write_all(request.as_bytes()).await;
    let mut first = [0; 1];
    if let Err(error) = sent {
        // A response that the server sent before it closed explains more.
        let said = stream.read_exact(&mut first).await.err();
        let said = said.filter(|said| stream::certificate_refusal(said).is_some());
        return Err(said.unwrap_or(error));
    }
    stream.read_exact(&mut first).await?;
    let (waited, arrived) = (began.elapsed(), SystemTime::now());
    let mtu = getsockopt(stream.tcp(), IpMtu).ok();
    let mut answer = first.to_vec();
    match stream.take(LONGEST).read_to_end(&mut answer).await {
        Ok(_) => {}
        // Many TLS servers close without close_notify; the response is checked by its length.
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {}
        Err(error) => return Err(error),
    }
    let (status, body) =
        parse_answer(&answer).ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "not an HTTP response"))?;
    Ok(HttpAnswer { status, body, waited, arrived, mtu })
}

impl HttpAnswer {
    /// Returns the details of a problem document (RFC 9457), or the body as text.
    pub fn problem_text(&self) -> String {
        let document: serde_json::Value = serde_json::from_slice(&self.body).unwrap_or_default();
        let said = ["detail", "next"].iter();
        let said: Vec<&str> = said.filter_map(|key| document[key].as_str()).collect();
        if said.is_empty() { String::from_utf8_lossy(&self.body).trim().to_owned() } else { said.join("; ") }
    }
}

/// Parses status and body (RFC 9112; the portal sends bodies with a length or in chunks).
fn parse_answer(answer: &[u8]) -> Option<(u16, Vec<u8>)> {
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n")?;
    let head = std::str::from_utf8(&answer[..end]).ok()?;
    let status = head.strip_prefix("HTTP/1.")?.split(' ').nth(1)?.parse().ok()?;
    let body = &answer[end + 4..];
    let chunked = head.to_ascii_lowercase().contains("transfer-encoding: chunked");
    let body = if chunked { decode_chunked(body)? } else { body.to_vec() };
    Some((status, body))
}

fn decode_chunked(mut body: &[u8]) -> Option<Vec<u8>> {
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

    /// Serves one connection, keeps it open for a while, and returns the time at which it was closed.
    async fn closes_late(listener: TcpListener) -> SystemTime {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            head.push(stream.read_u8().await.unwrap());
        }
        let answer = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok";
        stream.write_all(answer).await.unwrap();
        // The server does not notice that its response was read.
        tokio::time::sleep(Duration::from_millis(100)).await;
        SystemTime::now()
    }

    #[tokio::test]
    async fn an_answer_arrives_before_its_connection_ends() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let settings = format!("server = 'ws://{address}'\nservice = 'any'");
        let config: crate::config::Config = toml::from_str(&settings).unwrap();
        let server = HttpServer {
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
        assert_eq!(parse_answer(plain), Some((200, b"ok".to_vec())));
        let chunked = b"HTTP/1.1 404 Not Found\r\nTransfer-Encoding: chunked\r\n\r\n2\r\nab\r\n1;x\r\nc\r\n0\r\n\r\n";
        assert_eq!(parse_answer(chunked), Some((404, b"abc".to_vec())));
        for broken in
            [&b""[..], b"SSH-2.0-x\r\n\r\n", b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nff\r\nshort"]
        {
            assert_eq!(parse_answer(broken), None);
        }
    }
}
