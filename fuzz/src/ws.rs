//! What comes over a WebSocket.

use std::future::poll_fn;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use ::ws::{Message, WebSocket};

/// The longest message and the longest frame here.
pub const MOST: usize = 1 << 16;

/// Frames of a client.
pub fn frames(data: &[u8]) {
    let mut socket = WebSocket::new(tokio::io::empty(), data, MOST, MOST);
    let mut come = 0;
    loop {
        let next = poll_fn(|cx| socket.poll_next(cx));
        let next = pin!(next).poll(&mut Context::from_waker(Waker::noop()));
        match next {
            // Whether a text is one is looked at by whoever reads it.
            Poll::Ready(Ok(
                Message::Text(bytes)
                | Message::Binary(bytes)
                | Message::Ping(bytes)
                | Message::Pong(bytes),
            )) => {
                assert!(bytes.len() <= MOST);
                come += bytes.len();
            }
            Poll::Ready(Ok(Message::Close(..)) | Err(_)) | Poll::Pending => break,
        }
    }
    assert!(come <= data.len(), "more than was sent");
}
