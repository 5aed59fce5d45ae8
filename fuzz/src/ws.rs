//! Bytes received on a WebSocket.

use std::future::poll_fn;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use ::ws::{WebSocket, WsMessage};

/// Maximum length of a message and of a frame here.
pub const MOST: usize = 1 << 16;

/// Frames of a client.
pub fn frames(data: &[u8]) {
    let mut socket = WebSocket::new(tokio::io::empty(), data, MOST, MOST);
    let mut come = 0;
    loop {
        let next = poll_fn(|cx| socket.poll_next(cx));
        let next = pin!(next).poll(&mut Context::from_waker(Waker::noop()));
        match next {
            // UTF-8 is checked by the reader of a text message.
            Poll::Ready(Ok(
                WsMessage::Text(bytes) | WsMessage::Binary(bytes) | WsMessage::Ping(bytes) | WsMessage::Pong(bytes),
            )) => {
                assert!(bytes.len() <= MOST);
                come += bytes.len();
            }
            Poll::Ready(Ok(WsMessage::Close(..)) | Err(_)) | Poll::Pending => break,
        }
    }
    assert!(come <= data.len(), "more than was sent");
}
