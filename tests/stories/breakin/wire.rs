//! Requests that are read in one way here and in another there: by this server, by a proxy in front of it, by who wrote the
//! guard. Each asks for what only an admin may, and none is answered.

use anyhow::{Context, ensure};
use support::Verdict;
use support::wire::{answers, statuses};
use support::world::world;

use super::scene::state;
use crate::access::token;

const TOKEN: &str = "open sesame";

/// What is sent, and the statuses with which it may be answered: each answer has one of them.
#[derive(Clone)]
struct Sent {
    bytes: Vec<u8>,
    status: &'static [u16],
}

fn sent(text: impl Into<Vec<u8>>, status: &'static [u16]) -> Sent {
    Sent {
        bytes: text.into(),
        status,
    }
}

/// Would revoke a token if it were answered.
const REVOKE: &str = "DELETE /api/v1/tokens/chief HTTP/1.1\r\nHost: localhost\r\n";
const CLOSE: &str = "Connection: close\r\n\r\n";

/// Whose first line leads elsewhere than it looks.
fn targets() -> Vec<Sent> {
    const NO: &[u16] = &[400, 401, 404, 405, 414, 431, 505];
    let line = |line: &str| sent(format!("{line}\r\nHost: localhost\r\n{CLOSE}"), NO);
    let mut all: Vec<Sent> = [
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
    // A fragment is no part of a request; what stands before it is answered to everybody.
    all.retain(|sent| !sent.bytes.starts_with(b"GET /healthz#"));
    for length in [9_000, 70_000, 400_000] {
        let long = "x".repeat(length);
        all.push(line(&format!("GET /api/v1/tokens/{long} HTTP/1.1")));
        all.push(line(&format!("GET /api/v1/tokens?token={long} HTTP/1.1")));
    }
    all
}

/// Whose header is malformed, or says something twice.
fn headers() -> Vec<Sent> {
    const NO: &[u16] = &[400, 401, 429, 431];
    let header = |text: String| sent(format!("{REVOKE}{text}\r\n{CLOSE}"), NO);
    let mut all: Vec<Sent> = [
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
    all.push(header(format!(
        "Authorization: Bearer {}",
        "x".repeat(60_000)
    )));
    all.push(header(format!("Cookie: {}", "cloudroid=x; ".repeat(2_000))));
    all.push(sent(
        [&b"DELETE /api/v1/tokens/chief HTTP/1.1\r\nHost: localhost\r\nX: \xff\xfe\r\nAuthorization: Bearer \xff\r\n"[..], CLOSE.as_bytes()].concat(),
        NO,
    ));
    // Lines that end otherwise.
    all.push(sent(
        "DELETE /api/v1/tokens/chief HTTP/1.1\nHost: localhost\nConnection: close\n\n",
        NO,
    ));
    all
}

/// A second request in the body of the first, where the two lengths of that differ; and behind one that became something else.
fn smuggled() -> Vec<Sent> {
    // Each answer is one of those to a request without a token.
    const NO: &[u16] = &[200, 400, 401, 405, 411, 413, 501];
    let hidden = format!("{REVOKE}{CLOSE}");
    let length = hidden.len();
    let mut all = Vec::new();
    for first in [
        "POST /healthz",
        "GET /healthz",
        "GET /",
        "POST /api/v1/session",
    ] {
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
            all.push(sent(format!("{line}{framing}\r\n0\r\n\r\n{hidden}"), NO));
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
            all.push(sent(format!("{line}{lengths}\r\n{hidden}"), NO));
        }
        for chunk in [
            "0;x=\"\r\n\r\n",
            "00000000000000000000\r\n\r\n",
            "-1\r\n\r\n",
            "fffffffffffffffff\r\n",
            "1\r\nxx",
        ] {
            all.push(sent(
                format!("{line}Transfer-Encoding: chunked\r\n\r\n{chunk}{hidden}"),
                NO,
            ));
        }
        // The next on the same connection is asked who it is, too.
        all.push(sent(format!("{line}Content-Length: 0\r\n\r\n{hidden}"), NO));
    }
    all
}

pub fn nothing_is_smuggled_past_who_asks() -> Verdict {
    let daemon = world()
        .own("breakin-wire")
        .config(&format!(
            "tokens = [{TOKEN:?}]\n[portal]\nhandshake = \"2s\"\n"
        ))
        .start()?;
    let chief = token(&daemon, &["chief", "--role", "admin"])?;
    let before = state(&daemon)?;
    let all = [targets(), headers(), smuggled()].concat();
    let mut tried = 0;
    for sent in all {
        let shown = String::from_utf8_lossy(&sent.bytes);
        let shown: String = shown.chars().take(200).collect();
        let heard = answers(&daemon.address, &sent.bytes).with_context(|| format!("{shown:?}"))?;
        for status in statuses(&heard) {
            ensure!(
                sent.status.contains(&status),
                "{shown:?} was answered with {status}: {heard}"
            );
        }
        ensure!(!heard.contains("chief"), "{shown:?}: {heard}");
        tried += 1;
    }
    ensure!(state(&daemon)? == before, "something was changed");
    // The same with the token would have been done.
    let good = format!("{REVOKE}Authorization: Bearer {chief}\r\n{CLOSE}");
    let heard = answers(&daemon.address, good.as_bytes())?;
    ensure!(statuses(&heard) == [200], "{heard}");
    ensure!(state(&daemon)? != before);
    println!("{tried} attempts");
    ensure!(tried > 150, "{tried}");
    Ok(())
}
