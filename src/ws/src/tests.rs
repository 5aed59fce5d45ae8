use futures_util::{SinkExt, StreamExt};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message as Theirs;
use tokio_tungstenite::tungstenite::protocol::Role;

use super::*;

const LIMIT: usize = 1 << 20;

/// Returns our end and one of tungstenite's.
async fn pair() -> (WebSocket<tokio::io::DuplexStream>, WebSocketStream<tokio::io::DuplexStream>) {
    let (ours, theirs) = tokio::io::duplex(4096);
    let theirs = WebSocketStream::from_raw_socket(theirs, Role::Client, None).await;
    (WebSocket::new(ours, b"", LIMIT, LIMIT), theirs)
}

async fn next(socket: &mut WebSocket<tokio::io::DuplexStream>) -> Result<WsMessage, WsError> {
    poll_fn(|cx| socket.poll_next(cx)).await
}

#[tokio::test]
async fn messages_of_all_sizes_cross_unchanged_both_ways() {
    let (mut ours, mut theirs) = pair().await;
    let sizes = [0, 1, 125, 126, 4000, 8192, 8193, 65535, 65536, 700_000];
    let there = async {
        for size in sizes {
            theirs.send(Theirs::binary(vec![7; size])).await.unwrap();
            theirs.send(Theirs::text("ü".repeat(size / 2))).await.unwrap();
        }
        for size in sizes {
            assert_eq!(theirs.next().await.unwrap().unwrap(), Theirs::binary(vec![9; size]));
        }
    };
    let here = async {
        for size in sizes {
            assert_eq!(next(&mut ours).await.unwrap(), WsMessage::Binary(vec![7; size].into()));
            assert_eq!(next(&mut ours).await.unwrap(), WsMessage::Text("ü".repeat(size / 2).into()));
        }
        for size in sizes {
            ours.queue(frame::BINARY, vec![9; size].into());
        }
        poll_fn(|cx| ours.poll_flush(cx)).await.unwrap();
        assert_eq!(ours.bytes_queued(), 0);
    };
    tokio::join!(there, here);
}

#[tokio::test]
async fn control_frames_and_close_cross() {
    let (mut ours, mut theirs) = pair().await;
    theirs.send(Theirs::Ping(Bytes::from_static(b"p"))).await.unwrap();
    assert_eq!(next(&mut ours).await.unwrap(), WsMessage::Ping(Bytes::from_static(b"p")));
    theirs.close(None).await.unwrap();
    assert_eq!(next(&mut ours).await.unwrap(), WsMessage::Close(1005, String::new()));
    ours.queue_close(1009, &"ü".repeat(100));
    poll_fn(|cx| ours.poll_flush(cx)).await.unwrap();
    let Theirs::Close(Some(close)) = theirs.next().await.unwrap().unwrap() else { panic!("not closed") };
    assert_eq!((u16::from(close.code), close.reason.chars().count()), (1009, 61));
    drop(theirs);
    assert!(matches!(next(&mut ours).await, Err(WsError::Eof)));
}

/// Returns the error with which our end refuses these bytes.
async fn refusal(bytes: &[u8]) -> (u16, String) {
    let (io, _keep) = tokio::io::duplex(64);
    let mut socket = WebSocket::new(io, bytes, 1000, 1500);
    match next(&mut socket).await {
        Err(WsError::Refused { code, reason }) => (code, reason),
        other => panic!("{other:?}"),
    }
}

fn masked_frame(first: u8, length: u16) -> Vec<u8> {
    let mut bytes = vec![first, 0x80 | 126];
    bytes.extend_from_slice(&length.to_be_bytes());
    bytes.resize(8 + usize::from(length), 0);
    bytes
}

#[tokio::test]
async fn limits_and_rules_are_kept() {
    assert_eq!(
        refusal(&masked_frame(0x81, 1001)).await,
        (1009, "a frame of 1001 bytes is over the limit of 1000".into())
    );
    assert_eq!(
        refusal(&[0x82, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0]).await,
        (1009, format!("a frame of {} bytes is over the limit of 1000", u64::MAX))
    );
    let parts = [masked_frame(0x01, 800), masked_frame(0x80, 800)].concat();
    assert_eq!(refusal(&parts).await, (1009, "a message of 1600 bytes is over the limit of 1500".into()));
    assert_eq!(refusal(&[0x81, 0x00]).await, (1002, "a client's frames must be masked".into()));
    assert_eq!(refusal(&masked_frame(0x80, 1)).await.0, 1002);
    assert_eq!(refusal(&[masked_frame(0x01, 1), masked_frame(0x01, 1)].concat()).await.0, 1002);
    assert_eq!(refusal(&[0x88, 0x81, 0, 0, 0, 0, 3]).await.0, 1002);
    assert_eq!(refusal(b"\x13\x37\xde\xad\xbe\xef").await.0, 1002);
}

#[tokio::test]
async fn parts_make_one_message_with_control_frames_between() {
    let bytes = [masked_frame(0x01, 2), masked_frame(0x89, 0), masked_frame(0x00, 2), masked_frame(0x80, 2)].concat();
    let (io, _keep) = tokio::io::duplex(64);
    let mut socket = WebSocket::new(io, &bytes, 1000, 1000);
    assert_eq!(next(&mut socket).await.unwrap(), WsMessage::Ping(Bytes::new()));
    assert_eq!(next(&mut socket).await.unwrap(), WsMessage::Text(vec![0; 6].into()));
}

#[tokio::test]
async fn a_client_s_end_is_understood_by_servers() {
    let (ours, theirs) = tokio::io::duplex(4096);
    let mut theirs = WebSocketStream::from_raw_socket(theirs, Role::Server, None).await;
    let mut ours = WebSocket::client(ours, b"", LIMIT, LIMIT, 42);
    for size in [0, 1, 125, 126, 8193, 65536, 300_000] {
        ours.queue(frame::BINARY, Bytes::from(vec![7; size]));
        let (sent, received) = tokio::join!(poll_fn(|cx| ours.poll_flush(cx)), theirs.next());
        sent.unwrap();
        assert_eq!(received.unwrap().unwrap(), Theirs::binary(vec![7; size]));
        let answered = theirs.send(Theirs::binary(vec![9; size]));
        let (sent, received) = tokio::join!(answered, next(&mut ours));
        sent.unwrap();
        assert_eq!(received.unwrap(), WsMessage::Binary(vec![9; size].into()));
    }
}

#[tokio::test]
async fn what_has_come_of_an_unfinished_message_is_counted() {
    let (ours, mut theirs) = tokio::io::duplex(4096);
    let mut ours = WebSocket::new(ours, b"", LIMIT, LIMIT);
    // Five bytes are announced, masked with zeros.
    let frame = [0x82, 0x85, 0, 0, 0, 0, 1, 2, 3, 4, 5];
    for (sent, piece) in [(3, &frame[..3]), (8, &frame[3..8]), (11, &frame[8..])] {
        tokio::io::AsyncWriteExt::write_all(&mut theirs, piece).await.unwrap();
        let polled = poll_fn(|cx| Poll::Ready(ours.poll_next(cx))).await;
        assert_eq!((ours.bytes_received(), polled.is_ready()), (sent, sent == 11));
    }
}

/// Returns the header of a client's frame with a mask of zeros.
fn frame_header(length: u64, last: bool) -> Vec<u8> {
    let mut header = vec![if last { 0x82 } else { 0x02 }, 0xff];
    header.extend(length.to_be_bytes());
    header.extend([0; 4]);
    header
}

#[tokio::test]
async fn unfinished_messages_take_no_more_than_their_budget() {
    use tokio::io::AsyncWriteExt as _;
    let budget = Budget::new("client x", 24 << 20);
    let mut sockets = tokio::task::JoinSet::new();
    // Twenty connections begin a message of 63 MB each, in frames of 3 MB.
    for _ in 0..20 {
        let (ours, mut theirs) = tokio::io::duplex(64 << 10);
        let limit = 64 << 20;
        let mut socket = WebSocket::new(ours, b"", limit, limit).with_budget(&budget, Duration::from_secs(3600));
        sockets.spawn(async move {
            let sending = async {
                theirs.write_all(&frame_header(3 << 20, false)).await?;
                theirs.write_all(&vec![7; 3 << 20]).await?;
                std::future::pending::<io::Result<()>>().await
            };
            tokio::select! {
                message = next(&mut socket) => message,
                _ = sending => unreachable!("the socket is asked first"),
            }
        });
    }
    // At most eight of them fit.
    for _ in 0..12 {
        let refused = sockets.join_next().await.unwrap().unwrap().unwrap_err();
        let WsError::Refused { code: 1013, reason } = refused else {
            panic!("{refused}");
        };
        assert!(reason.contains("the memory for client x"), "{reason}");
        assert!(budget.used_bytes() <= budget.limit());
    }
    sockets.shutdown().await;
    assert_eq!(budget.used_bytes(), 0);
}

#[tokio::test]
async fn a_message_counts_until_the_next_is_asked_for() {
    let budget = Budget::new("client x", 2 << 20);
    let (ours, theirs) = tokio::io::duplex(4096);
    let mut theirs = WebSocketStream::from_raw_socket(theirs, Role::Client, None).await;
    let mut ours = WebSocket::new(ours, b"", LIMIT, LIMIT).with_budget(&budget, Duration::from_secs(60));
    tokio::spawn(async move {
        for size in [1 << 20, 10, 1 << 20] {
            theirs.send(Theirs::binary(vec![7; size])).await.unwrap();
        }
        std::future::pending::<()>().await
    });
    assert!(matches!(next(&mut ours).await, Ok(WsMessage::Binary(big)) if big.len() == 1 << 20));
    assert!(budget.used_bytes() >= 1 << 20, "it is being handled");
    assert!(matches!(next(&mut ours).await, Ok(WsMessage::Binary(small)) if small.len() == 10));
    assert_eq!(budget.used_bytes(), 0, "small ones do not count");
    assert!(matches!(next(&mut ours).await, Ok(WsMessage::Binary(big)) if big.len() == 1 << 20));
    drop(ours);
    assert_eq!(budget.used_bytes(), 0);
}

#[tokio::test]
async fn a_message_that_stays_unfinished_ends_the_connection() {
    use tokio::io::AsyncWriteExt as _;
    let (ours, mut theirs) = tokio::io::duplex(4096);
    let patience = Duration::from_millis(30);
    let mut ours = WebSocket::new(ours, b"", LIMIT, LIMIT).with_budget(&Budget::without_limit(), patience);
    // A whole message, and then idleness for longer than the time limit.
    let mut whole = frame_header(2, true);
    whole.extend(b"ab");
    theirs.write_all(&whole).await.unwrap();
    assert!(matches!(next(&mut ours).await, Ok(WsMessage::Binary(_))));
    let idle = tokio::time::timeout(patience * 3, next(&mut ours)).await;
    assert!(idle.is_err(), "{idle:?}");
    // An unfinished message, one byte at a time.
    let dripping = tokio::spawn(async move {
        theirs.write_all(&frame_header(100_000, true)).await.unwrap();
        while theirs.write_all(b"x").await.is_ok() {
            tokio::time::sleep(patience / 3).await;
        }
    });
    let error = next(&mut ours).await.unwrap_err();
    assert!(matches!(&error, WsError::Refused { code: 1008, reason } if reason.contains("not complete")), "{error}");
    drop(ours);
    dripping.await.unwrap();
}
