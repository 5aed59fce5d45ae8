//! The first frame in each direction: hello and welcome.

use std::future::poll_fn;

use budget::{JsonWeight, Permit};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use ws::{WebSocket, WsMessage, frame as opcode};

use super::DisconnectReason;
use super::carry::disconnect_reason;
use crate::Error;
use crate::frame::Frame;

/// Sends an opening frame.
pub async fn send_open<S, T>(socket: &mut WebSocket<S>, open: &T) -> Result<(), DisconnectReason>
where
    S: AsyncRead + AsyncWrite + Unpin,
    T: Serialize,
{
    let json = serde_json::to_vec(open).unwrap_or_default();
    socket.queue(opcode::BINARY, Frame::Open(json.into()).encode());
    poll_fn(|cx| socket.poll_flush(cx)).await.map_err(|error| DisconnectReason::Socket(error.to_string()))
}

/// Receives the peer's opening frame; `what` names it in errors. It is charged to `held` before it is parsed.
pub async fn receive_open<S, T>(
    socket: &mut WebSocket<S>,
    what: &'static str,
    held: &mut Permit,
) -> Result<T, DisconnectReason>
where
    S: AsyncRead + AsyncWrite + Unpin,
    T: DeserializeOwned,
{
    loop {
        match poll_fn(|cx| socket.poll_next(cx)).await.map_err(disconnect_reason)? {
            WsMessage::Binary(bytes) => {
                let Frame::Open(json) = Frame::decode(bytes)? else {
                    return Err(Error::Protocol("no opening frame").into());
                };
                let weight = JsonWeight::estimate(&json);
                held.resize(weight.bytes).map_err(Error::from)?;
                return serde_json::from_slice(&json).map_err(|error| {
                    let reason = error.to_string();
                    Error::Json { what, reason }.into()
                });
            }
            WsMessage::Close(code, reason) => {
                return Err(DisconnectReason::Closed { code, reason });
            }
            // A portal that does not support links gives the reason in a rosbridge status message.
            WsMessage::Text(text) => {
                let reason = String::from_utf8_lossy(&text).into_owned();
                return Err(DisconnectReason::Closed { code: 1002, reason });
            }
            WsMessage::Ping(payload) => socket.queue(opcode::PONG, payload),
            WsMessage::Pong(_) => {}
        }
    }
}
