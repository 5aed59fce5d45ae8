//! The first frame each way: hello and welcome.

use std::future::poll_fn;

use budget::{JsonWeight, Permit};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use ws::{Message, WebSocket, frame as opcode};

use super::Lost;
use super::carry::socket_lost;
use crate::Error;
use crate::frame::Frame;

/// Sends an opening frame.
pub async fn send_open<S, T>(socket: &mut WebSocket<S>, open: &T) -> Result<(), Lost>
where
    S: AsyncRead + AsyncWrite + Unpin,
    T: Serialize,
{
    let json = serde_json::to_vec(open).unwrap_or_default();
    socket.queue(opcode::BINARY, Frame::Open(json.into()).encode());
    poll_fn(|cx| socket.poll_flush(cx))
        .await
        .map_err(|error| Lost::Socket(error.to_string()))
}

/// Reads the peer's opening frame; `what` it should be is for messages. It counts in `held`, from before it is read.
pub async fn receive_open<S, T>(
    socket: &mut WebSocket<S>,
    what: &'static str,
    held: &mut Permit,
) -> Result<T, Lost>
where
    S: AsyncRead + AsyncWrite + Unpin,
    T: DeserializeOwned,
{
    loop {
        match poll_fn(|cx| socket.poll_next(cx))
            .await
            .map_err(socket_lost)?
        {
            Message::Binary(bytes) => {
                let Frame::Open(json) = Frame::decode(bytes)? else {
                    return Err(Error::Protocol("no opening frame").into());
                };
                let weight = JsonWeight::of(&json);
                held.resize(weight.bytes).map_err(Error::from)?;
                return serde_json::from_slice(&json).map_err(|error| {
                    let reason = error.to_string();
                    Error::Json { what, reason }.into()
                });
            }
            Message::Close(code, reason) => return Err(Lost::Closed { code, reason }),
            // A portal that speaks no link says why in a rosbridge status message.
            Message::Text(text) => {
                let reason = String::from_utf8_lossy(&text).into_owned();
                return Err(Lost::Closed { code: 1002, reason });
            }
            Message::Ping(payload) => socket.queue(opcode::PONG, payload),
            Message::Pong(_) => {}
        }
    }
}
