//! The first frame in each direction: hello and welcome.

use std::future::poll_fn;

use budget::{JsonWeight, Permit};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use ws::{WebSocket, WsError, WsMessage, frame as opcode};

use super::DisconnectReason;
use crate::Error;
use crate::frame::Frame;

/// Sends an opening frame.
pub async fn send_open(
    socket: &mut WebSocket<impl AsyncRead + AsyncWrite + Unpin>,
    open: &impl Serialize,
) -> Result<(), DisconnectReason> {
    let json = serde_json::to_vec(open).unwrap_or_default();
    socket.queue(opcode::BINARY, Frame::Open(json.into()).encode());
    Ok(poll_fn(|cx| socket.poll_flush(cx)).await.map_err(WsError::Io)?)
}

/// Receives the peer's opening frame; `what` names it in errors. It is charged to `held` before it is parsed.
pub async fn receive_open<T: DeserializeOwned>(
    socket: &mut WebSocket<impl AsyncRead + AsyncWrite + Unpin>,
    what: &'static str,
    held: &mut Permit,
) -> Result<T, DisconnectReason> {
    loop {
        match poll_fn(|cx| socket.poll_next(cx)).await? {
            WsMessage::Binary(bytes) => {
                let Frame::Open(json) = Frame::decode(bytes)? else {
                    return Err(Error::Protocol("no opening frame").into());
                };
                held.resize(JsonWeight::estimate(&json).bytes).map_err(Error::from)?;
                let open = serde_json::from_slice(&json);
                return open.map_err(|error| Error::Json { what, reason: error.to_string() }.into());
            }
            WsMessage::Close(code, reason) => return Err(DisconnectReason::Closed { code, reason }),
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
