//! A servant's ROS from inside, by Foxglove's WebSocket protocol: its messages as the bytes that they are.

use anyhow::{Context, anyhow, bail};
use api::Servant;
use foxglove::ws_protocol::server::ServerMessage;
use futures_util::{SinkExt, StreamExt};
use tokio_tungstenite::tungstenite::Message;

use crate::client::{Client, Socket, escaped};

/// Of the daemon's, see docs/page.md.
const PROTOCOL: &str = "foxglove.sdk.v1";

/// How messages are written, and how their definitions are.
pub const ENCODING: &str = "ros1";

/// The id of the servant that is named by its id, or by a service that has no other.
pub async fn servant(client: &Client, named: &str) -> anyhow::Result<String> {
    let servants: Vec<Servant> = client.get("/api/v1/servants").await?;
    if servants.iter().any(|servant| servant.id == named) {
        return Ok(named.to_owned());
    }
    let of_service: Vec<&Servant> = servants
        .iter()
        .filter(|servant| servant.service == named)
        .collect();
    match of_service.as_slice() {
        [only] => Ok(only.id.clone()),
        // The daemon says what exists.
        [] => Ok(named.to_owned()),
        several => {
            let ids: Vec<&str> = several.iter().map(|servant| servant.id.as_str()).collect();
            bail!(
                "{named} has {} servants; name one: {}",
                ids.len(),
                ids.join(", ")
            )
        }
    }
}

/// One connection.
pub struct Inside {
    socket: Socket,
}

impl Inside {
    /// Attaches to a servant; `depth` messages of each topic wait in the daemon.
    pub async fn attach(client: &Client, servant: &str, depth: usize) -> anyhow::Result<Self> {
        let path = format!("/foxglove/{}?depth={depth}", escaped(servant));
        let socket = client.socket(&path, PROTOCOL).await?;
        Ok(Self { socket })
    }

    /// Sends one message.
    pub async fn send(&mut self, message: impl Into<Message>) -> anyhow::Result<()> {
        let sent = self.socket.send(message.into()).await;
        sent.context("the daemon broke the connection")
    }

    /// The next that is told, as it came; none where the servant has ended.
    ///
    /// # Errors
    /// The connection was lost, or closed for another reason.
    pub async fn next(&mut self) -> anyhow::Result<Option<Message>> {
        loop {
            match self.socket.next().await {
                Some(Ok(message @ (Message::Text(_) | Message::Binary(_)))) => {
                    return Ok(Some(message));
                }
                Some(Ok(Message::Close(Some(close)))) if u16::from(close.code) == 1012 => {
                    return Ok(None);
                }
                Some(Ok(Message::Close(Some(close)))) => {
                    return Err(anyhow!("the daemon ended it: {}", close.reason));
                }
                Some(Ok(Message::Close(None))) | None => {
                    bail!("the daemon broke the connection")
                }
                Some(Ok(_)) => {}
                Some(Err(error)) => {
                    return Err(error).context("the daemon broke the connection");
                }
            }
        }
    }

    /// Leaves once the daemon has taken all that was sent; what it says of that.
    pub async fn leave(mut self) -> Vec<Message> {
        let _ = self.socket.close(None).await;
        let mut last = Vec::new();
        while let Some(Ok(message)) = self.socket.next().await {
            last.push(message);
        }
        last
    }
}

/// What a message says; none where it is nothing that is known here.
pub fn read(message: &Message) -> Option<ServerMessage<'_>> {
    ServerMessage::try_from(message).ok()
}
