use base64_simd::STANDARD;
use budget::Budget;
use link::{MAX_FRAME, MAX_RECORD};
use ros::bus::RosVersion;
use sha1::{Digest, Sha1};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use super::*;
use crate::testing::{SOON, World};

/// The defaults, with a short interval after refusals.
const QUICK: RetryPauses = RetryPauses { refused: Duration::from_millis(20), ..PAUSES };

/// Returns the robot's next request and its connection.
async fn next_request(listener: &TcpListener) -> (String, TcpStream) {
    let (mut stream, _) = listener.accept().await.unwrap();
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        head.push(stream.read_u8().await.unwrap());
    }
    (String::from_utf8(head).unwrap(), stream)
}

/// Accepts the next connection and its link; returns the session that the robot wants to resume, and the connection.
async fn accept_link(listener: &TcpListener) -> (Option<String>, WebSocket<TcpStream>) {
    let (head, mut stream) = next_request(listener).await;
    let key = head.split("Sec-WebSocket-Key: ").nth(1).unwrap();
    let key = key.lines().next().unwrap();
    let guid = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
    let accept = STANDARD.encode_to_string(Sha1::digest(format!("{key}{guid}")));
    let answer = format!(
        "HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Accept: \
         {accept}\r\n\
         Sec-WebSocket-Protocol: {}\r\n\r\n",
        link::SUBPROTOCOL
    );
    stream.write_all(answer.as_bytes()).await.unwrap();
    let mut socket = WebSocket::new(stream, &[], MAX_FRAME, MAX_RECORD);
    let mut held = Budget::without_limit().permit();
    let hello: Hello = receive_open(&mut socket, "hello", &mut held).await.unwrap();
    let welcome = Welcome::Accepted {
        session: "session".to_owned(),
        resumed: hello.resume.is_some(),
        received: 0,
        ahead: Vec::new(),
        next: 1,
        codecs: Vec::new(),
        servant: "servant".to_owned(),
        limits: link::LinkLimits::default(),
    };
    send_open(&mut socket, &welcome).await.unwrap();
    (hello.resume.map(|resume| resume.session), socket)
}

async fn refuse_link(listener: &TcpListener) {
    let (_, mut stream) = next_request(listener).await;
    let answer = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 5\r\n\r\nnever";
    stream.write_all(answer).await.unwrap();
}

/// Keeps a link to a server with this behaviour; returns why the link ended, unless the server is done before.
async fn run_against(serves: impl AsyncFnOnce(&TcpListener)) -> Option<String> {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let server = format!("ws://{}", listener.local_addr().unwrap());
    let settings = format!("server = {server:?}\nservice = 'any'\nrobot = 'r'");
    let config: Config = toml::from_str(&settings).unwrap();
    let world = World::new(RosVersion::One).await;
    let node = world.node("/node").await;
    let mirror = Mirror::start(node, "label".to_owned(), run::new_session(&config), SOON);
    let mut hello = Hello::default();
    let keeping = run_link_with(&config, &mirror, &mut hello, &QUICK);
    let ended = async {
        tokio::select! {
            reason = keeping => Some(reason),
            () = serves(&listener) => None,
        }
    };
    timeout(SOON, ended).await.expect("one of both ends")
}

#[tokio::test]
async fn what_was_accepted_once_is_asked_for_again_when_it_is_refused() {
    let reason = run_against(async |listener| {
        drop(accept_link(listener).await);
        refuse_link(listener).await;
        refuse_link(listener).await;
        let (resumed, _socket) = accept_link(listener).await;
        assert_eq!(resumed.as_deref(), Some("session"));
    });
    assert_eq!(reason.await, None);
}

#[tokio::test]
async fn what_is_refused_at_first_is_not_asked_for_again() {
    let reason = run_against(async |listener| {
        refuse_link(listener).await;
        std::future::pending().await
    });
    let reason = reason.await.unwrap();
    assert!(reason.contains("answers 403: never"), "{reason}");
}

#[tokio::test(start_paused = true)]
async fn a_link_that_is_lost_as_soon_as_it_is_accepted_is_tried_ever_more_seldom() {
    let mut pace = RetryPace::default();
    let mut waited = async |accepted: Instant| {
        let lost = Instant::now();
        pace.on_link_lost(Some(accepted), &PAUSES);
        pace.wait(PAUSES.away).await;
        pace.start_attempt();
        lost.elapsed()
    };
    for _ in 0..8 {
        waited(Instant::now()).await;
    }
    assert!(waited(Instant::now()).await >= PAUSES.away / 2);
    let accepted = Instant::now();
    sleep(PAUSES.stood).await;
    assert!(waited(accepted).await <= PAUSE);
}

#[tokio::test(start_paused = true)]
async fn a_server_that_refuses_is_tried_soon_and_then_ever_more_seldom() {
    let mut pace = RetryPace::default();
    let mut waited = async || {
        let refused = Instant::now();
        pace.on_refused(&PAUSES);
        pace.wait(PAUSES.refused).await;
        pace.start_attempt();
        refused.elapsed()
    };
    let first = waited().await;
    assert!(PAUSES.busy / 2 <= first && first <= PAUSES.busy, "{first:?}");
    for _ in 0..4 {
        waited().await;
    }
    assert!(waited().await >= PAUSES.refused / 2);
}
