//! Requests that are parsed differently by different parties: this server, a proxy in front of it, the author of the
//! access check. Each requests something that only an admin may do, and none is executed.

use anyhow::{Context, ensure};
use support::Verdict;
use support::wire::{exchange_with, statuses};
use support::world::world;

use super::scene::server_state;
use crate::access::create_token;

const TOKEN: &str = "open sesame";

/// Bytes to send, and the acceptable statuses of all responses.
#[derive(Clone)]
struct RawRequest {
    bytes: Vec<u8>,
    status: &'static [u16],
}

fn raw_request(text: impl Into<Vec<u8>>, status: &'static [u16]) -> RawRequest {
    RawRequest { bytes: text.into(), status }
}

/// A request that would revoke a token.
const REVOKE: &str = "DELETE /api/v1/tokens/chief HTTP/1.1\r\nHost: localhost\r\n";
const CLOSE: &str = "Connection: close\r\n\r\n";

/// Requests whose first line refers to something other than it seems to.
fn target_requests() -> Vec<RawRequest> {
    const NO: &[u16] = &[400, 401, 404, 405, 414, 431, 505];
    let line = |line: &str| raw_request(format!("{line}\r\nHost: localhost\r\n{CLOSE}"), NO);
    let mut all: Vec<RawRequest> = [
        "GET http://localhost/api/v1/tokens HTTP/1.1",
        "GET http://evil.example/api/v1/tokens HTTP/1.1",
        "GET http://open%20sesame@localhost/api/v1/tokens HTTP/1.1",
        "GET https://localhost/api/v1/tokens HTTP/1.1",
        "GET file:///etc/passwd HTTP/1.1",
        "GET unix:/run/cloudroid/daemon.sock HTTP/1.1",
        "CONNECT localhost:22 HTTP/1.1",
        "CONNECT /api/v1/tokens HTTP/1.1",
        "OPTIONS * HTTP/1.1",
        "GET * HTTP/1.1",
        "DELETE * HTTP/1.1",
        "GET api/v1/tokens HTTP/1.1",
        "GET ?token HTTP/1.1",
        "GET /api/v1/tokens HTTP/1.0",
        "GET /api/v1/tokens HTTP/0.9",
        "GET /api/v1/tokens HTTP/2.0",
        "GET /api/v1/tokens HTTP/1.1 HTTP/1.1",
        "GET  /api/v1/tokens HTTP/1.1",
        "GET\t/api/v1/tokens HTTP/1.1",
        "GET /api/v1/tokens\tHTTP/1.1",
        "GET /api/v1/tokens\u{0} HTTP/1.1",
        "GET /api/v1/tok\u{e9}ns HTTP/1.1",
        "G\u{0}ET /api/v1/tokens HTTP/1.1",
        "/api/v1/tokens",
        "GET /healthz#/api/v1/tokens HTTP/1.1",
        "GET /healthz/%2e%2e/api/v1/tokens HTTP/1.1",
        "GET /assets/../api/v1/tokens HTTP/1.1",
        "GET /assets/..%2fapi%2fv1%2ftokens HTTP/1.1",
        "GET /%2e/api/v1/tokens HTTP/1.1",
        "GET //api/v1/tokens HTTP/1.1",
        "GET /api/v1/tokens/ HTTP/1.1",
        "POST /healthz HTTP/1.1",
        "POST / HTTP/1.1",
        "PUT /api/v1/session HTTP/1.1",
        "GET /api/v1/session/../tokens HTTP/1.1",
        "HEAD /api/v1/tokens HTTP/1.1",
        "TRACE / HTTP/1.1",
        "PRI * HTTP/2.0",
    ]
    .into_iter()
    .map(line)
    .collect();
    // A fragment is not part of a request; the path before it is open to everyone.
    all.retain(|sent| !sent.bytes.starts_with(b"GET /healthz#"));
    for length in [9_000, 70_000, 400_000] {
        let long = "x".repeat(length);
        all.push(line(&format!("GET /api/v1/tokens/{long} HTTP/1.1")));
        all.push(line(&format!("GET /api/v1/tokens?token={long} HTTP/1.1")));
    }
    all
}

/// Requests with malformed or contradictory headers.
fn header_requests() -> Vec<RawRequest> {
    const NO: &[u16] = &[400, 401, 429, 431];
    let header = |text: String| raw_request(format!("{REVOKE}{text}\r\n{CLOSE}"), NO);
    let mut all: Vec<RawRequest> = [
        "Host: 127.0.0.1",
        "Host: evil.example\r\nHost: localhost",
        "Host : localhost",
        "Authorization: Basic b3BlbiBzZXNhbWU=",
        "Authorization: bearer",
        "Authorization: Bearer ",
        "Authorization : Bearer open sesame",
        " Authorization: Bearer open sesame",
        "X-A: b\r\n Authorization: Bearer open sesame",
        "X-A: b\r\n\tAuthorization: Bearer open sesame",
        "X-A: b\rAuthorization: Bearer open sesame",
        "X-A: b\u{0}\r\nX: c",
        "X-A\u{0}: b",
        "X A: b",
        ": b",
        "X-A",
        "Cookie: cloudroid=open sesame",
        "Authorization: Bearer guess\r\nAuthorization: Bearer open sesame",
        "Sec-WebSocket-Protocol: open sesame",
        "Upgrade: websocket\r\nConnection: Upgrade",
        "Upgrade: h2c\r\nHTTP2-Settings: AAMAAABkAARAAAAAAAIAAAAA",
        "Expect: 100-continue",
        "X-Forwarded-For: 127.0.0.1\r\nX-Forwarded-Proto: https",
    ]
    .into_iter()
    .map(|text| header(text.to_owned()))
    .collect();
    all.push(header(format!("X-Long: {}", "x".repeat(500_000))));
    all.push(header("X-Many: x\r\n".repeat(5_000).trim_end().to_owned()));
    all.push(header(format!("Authorization: Bearer {}", "x".repeat(60_000))));
    all.push(header(format!("Cookie: {}", "cloudroid=x; ".repeat(2_000))));
    all.push(raw_request(
        [
            &b"DELETE /api/v1/tokens/chief HTTP/1.1\r\nHost: localhost\r\nX: \xff\xfe\r\nAuthorization: \
            Bearer \xff\r\n"[..],
            CLOSE.as_bytes(),
        ]
        .concat(),
        NO,
    ));
    // Unusual line endings.
    all.push(raw_request("DELETE /api/v1/tokens/chief HTTP/1.1\nHost: localhost\nConnection: close\n\n", NO));
    all
}

/// A second request in the body of the first, with contradictory lengths of the body; and one after an upgrade.
fn smuggling_requests() -> Vec<RawRequest> {
    // Each response is one to a request without a token.
    const NO: &[u16] = &[200, 400, 401, 405, 411, 413, 501];
    let hidden = format!("{REVOKE}{CLOSE}");
    let length = hidden.len();
    let mut all = Vec::new();
    for first in ["POST /healthz", "GET /healthz", "GET /", "POST /api/v1/session"] {
        let line = format!("{first} HTTP/1.1\r\nHost: localhost\r\n");
        for framing in [
            "Transfer-Encoding: chunked\r\nContent-Length: 5\r\n",
            "Content-Length: 5\r\nTransfer-Encoding: chunked\r\n",
            "Transfer-Encoding: chunked\r\nTransfer-Encoding: identity\r\n",
            "Transfer-Encoding: identity, chunked\r\n",
            "Transfer-Encoding: xchunked\r\n",
            "Transfer-Encoding : chunked\r\n",
            "Transfer-Encoding:\u{b}chunked\r\n",
        ] {
            all.push(raw_request(format!("{line}{framing}\r\n0\r\n\r\n{hidden}"), NO));
        }
        for lengths in [
            format!("Content-Length: 0\r\nContent-Length: {length}\r\n"),
            format!("Content-Length: {length}\r\nContent-Length: 0\r\n"),
            format!("Content-Length: 0, {length}\r\n"),
            format!("Content-Length: +{length}\r\n"),
            "Content-Length: -1\r\n".to_owned(),
            "Content-Length: 0x0\r\n".to_owned(),
            "Content-Length: 99999999999999999999\r\n".to_owned(),
        ] {
            all.push(raw_request(format!("{line}{lengths}\r\n{hidden}"), NO));
        }
        for chunk in
            ["0;x=\"\r\n\r\n", "00000000000000000000\r\n\r\n", "-1\r\n\r\n", "fffffffffffffffff\r\n", "1\r\nxx"]
        {
            all.push(raw_request(format!("{line}Transfer-Encoding: chunked\r\n\r\n{chunk}{hidden}"), NO));
        }
        // The next request on the same connection is authenticated as well.
        all.push(raw_request(format!("{line}Content-Length: 0\r\n\r\n{hidden}"), NO));
    }
    all
}

pub fn nothing_is_smuggled_past_who_asks() -> Verdict {
    let daemon = world()
        .setup("breakin-wire")
        .config(&format!("tokens = [{TOKEN:?}]\n[portal]\nhandshake = \"2s\"\n"))
        .start()?;
    let chief = create_token(&daemon, &["chief", "--role", "admin"])?;
    let before = server_state(&daemon)?;
    let all = [target_requests(), header_requests(), smuggling_requests()].concat();
    let mut tried = 0;
    for sent in all {
        let shown = String::from_utf8_lossy(&sent.bytes);
        let shown: String = shown.chars().take(200).collect();
        let heard = exchange_with(&daemon.address, &sent.bytes).with_context(|| format!("{shown:?}"))?;
        for status in statuses(&heard) {
            ensure!(sent.status.contains(&status), "{shown:?} was answered with {status}: {heard}");
        }
        ensure!(!heard.contains("chief"), "{shown:?}: {heard}");
        tried += 1;
    }
    ensure!(server_state(&daemon)? == before, "something was changed");
    // The same request with a token is executed.
    let good = format!("{REVOKE}Authorization: Bearer {chief}\r\n{CLOSE}");
    let heard = exchange_with(&daemon.address, good.as_bytes())?;
    ensure!(statuses(&heard) == [200], "{heard}");
    ensure!(server_state(&daemon)? != before);
    println!("{tried} attempts");
    ensure!(tried > 150, "{tried}");
    Ok(())
}
