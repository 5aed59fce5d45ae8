//! Access to a servant's ROS topics by Foxglove's WebSocket protocol, with serialized messages.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::task::{Context, Poll, ready};

use anyhow::{Context as _, anyhow, bail};
use api::Servant;
use foxglove::ws_protocol::server::ServerMessage;
use futures_util::{SinkExt, StreamExt};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use recording::RecordingFormat;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::Instant;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;

use crate::client::{DaemonClient, percent_encode};

/// Subprotocol of the daemon, see docs/page.md.
const PROTOCOL: &str = "foxglove.sdk.v1";

/// Returns the id of the servant with this id, or of the only servant of the service with this name.
pub async fn resolve_servant(client: &DaemonClient, named: &str) -> anyhow::Result<String> {
    let servants: Vec<Servant> = client.get("/api/v1/servants").await?;
    if servants.iter().any(|servant| servant.id == named) {
        return Ok(named.to_owned());
    }
    let of_service: Vec<&Servant> = servants.iter().filter(|servant| servant.service == named).collect();
    match of_service.as_slice() {
        [only] => Ok(only.id.clone()),
        // The daemon's error lists the existing servants.
        [] => Ok(named.to_owned()),
        several => {
            let ids: Vec<&str> = several.iter().map(|servant| servant.id.as_str()).collect();
            bail!("{named} has {} servants; name one: {}", ids.len(), ids.join(", "))
        }
    }
}

/// A connection to a servant.
pub struct FoxgloveSession<S = TokioIo<Upgraded>> {
    socket: WebSocketStream<S>,
    /// Message format of the servant's ROS version.
    pub format: RecordingFormat,
    /// Messages that arrived while something was sent, and when.
    ahead: VecDeque<(Instant, Message)>,
}

impl FoxgloveSession {
    /// Attaches to a servant; the daemon queues up to `depth` messages of each topic.
    pub async fn attach(client: &DaemonClient, servant: &str, depth: usize) -> anyhow::Result<Self> {
        let path = format!("/foxglove/{}?depth={depth}", percent_encode(servant));
        let socket = client.connect_websocket(&path, PROTOCOL).await?;
        let mut inside = Self::from_socket(socket);
        inside.read_greeting().await?;
        Ok(inside)
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> FoxgloveSession<S> {
    fn from_socket(socket: WebSocketStream<S>) -> Self {
        Self { socket, format: RecordingFormat::default(), ahead: VecDeque::new() }
    }

    /// Reads the daemon's first message, which announces the message encoding.
    async fn read_greeting(&mut self) -> anyhow::Result<()> {
        let Some(message) = self.next().await? else {
            bail!("the servant has ended");
        };
        match parse_message(&message) {
            Some(ServerMessage::ServerInfo(told)) => {
                let mut encodings = told.supported_encodings.iter();
                let known = encodings.find_map(|encoding| RecordingFormat::from_encoding(encoding));
                self.format = known.unwrap_or_default();
                Ok(())
            }
            _ => bail!("the daemon's first message is not that of the protocol {PROTOCOL}"),
        }
    }

    /// Sends one message. Incoming messages are received meanwhile and returned by [`next`](Self::next): the daemon
    /// stops reading from a client that does not read, so two large messages in opposite directions would block each
    /// other.
    pub async fn send(&mut self, message: impl Into<Message>) -> anyhow::Result<()> {
        let mut waiting = Some(message.into());
        poll_fn(|cx| self.poll_send(cx, &mut waiting)).await
    }

    fn poll_send(&mut self, cx: &mut Context<'_>, waiting: &mut Option<Message>) -> Poll<anyhow::Result<()>> {
        const CONNECTION_BROKEN: &str = "the daemon broke the connection";
        while let Poll::Ready(came) = self.socket.poll_next_unpin(cx) {
            match came {
                Some(Ok(Message::Close(close))) => {
                    let over = close_outcome(close).map(|()| anyhow!("the servant has ended"));
                    return Poll::Ready(over.and_then(Err));
                }
                Some(Ok(message)) => self.ahead.push_back((Instant::now(), message)),
                Some(Err(error)) => return Poll::Ready(Err(error).context(CONNECTION_BROKEN)),
                None => return Poll::Ready(Err(anyhow!(CONNECTION_BROKEN))),
            }
        }
        if waiting.is_some() {
            ready!(self.socket.poll_ready_unpin(cx)).context(CONNECTION_BROKEN)?;
        }
        if let Some(message) = waiting.take() {
            self.socket.start_send_unpin(message).context(CONNECTION_BROKEN)?;
        }
        self.socket.poll_flush_unpin(cx).map_err(|error| anyhow::Error::new(error).context(CONNECTION_BROKEN))
    }

    /// Returns the next message; `None` if the servant has ended.
    ///
    /// # Errors
    /// The connection was lost, or closed for another reason.
    pub async fn next(&mut self) -> anyhow::Result<Option<Message>> {
        Ok(self.next_timed().await?.map(|(_, message)| message))
    }

    /// Returns the next message and the time of its arrival.
    pub async fn next_timed(&mut self) -> anyhow::Result<Option<(Instant, Message)>> {
        loop {
            let came = match self.ahead.pop_front() {
                Some((at, message)) => Some((at, Ok(message))),
                None => {
                    let came = self.socket.next().await;
                    came.map(|came| (Instant::now(), came))
                }
            };
            match came {
                Some((at, Ok(message @ (Message::Text(_) | Message::Binary(_))))) => {
                    return Ok(Some((at, message)));
                }
                Some((_, Ok(Message::Close(close)))) => return close_outcome(close).map(|()| None),
                Some((_, Ok(_))) => {}
                Some((_, Err(error))) => {
                    return Err(error).context("the daemon broke the connection");
                }
                None => bail!("the daemon broke the connection"),
            }
        }
    }

    /// Closes the connection after the daemon has received everything; returns its last messages.
    pub async fn close(mut self) -> Vec<Message> {
        let _ = self.socket.close(None).await;
        let ahead = self.ahead.drain(..);
        let mut last: Vec<Message> = ahead.map(|(_, message)| message).collect();
        while let Some(Ok(message)) = self.socket.next().await {
            last.push(message);
        }
        last
    }
}

/// Converts a close frame of the daemon: `Ok` if the servant has ended.
fn close_outcome(close: Option<CloseFrame>) -> anyhow::Result<()> {
    match close {
        Some(close) if u16::from(close.code) == 1012 => Ok(()),
        Some(close) => Err(anyhow!("the daemon closed the connection: {}", close.reason)),
        None => bail!("the daemon broke the connection"),
    }
}

/// Parses a message of the daemon; `None` if its type is unknown here.
pub fn parse_message(message: &Message) -> Option<ServerMessage<'_>> {
    ServerMessage::try_from(message).ok()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::time::timeout;
    use tokio_tungstenite::tungstenite::protocol::Role;

    use super::*;

    #[tokio::test]
    async fn two_big_messages_that_meet_do_not_wait_for_each_other() {
        const BIG: usize = 1 << 20;
        let (ours, theirs) = tokio::io::duplex(4096);
        let socket = WebSocketStream::from_raw_socket(ours, Role::Client, None).await;
        let mut inside = FoxgloveSession::from_socket(socket);
        let mut daemon = WebSocketStream::from_raw_socket(theirs, Role::Server, None).await;
        // It reads nothing until everything it sends has been received.
        let daemon = async move {
            let sent = daemon.send(Message::Binary(vec![7; BIG].into())).await;
            sent.expect("taken");
            daemon.next().await.expect("a message").expect("whole")
        };
        let us = async {
            let request = Message::Binary(vec![9; BIG].into());
            inside.send(request).await.expect("sent");
            inside.next().await.expect("a message")
        };
        let met = timeout(Duration::from_secs(20), async { tokio::join!(daemon, us) });
        let (came, told) = met.await.expect("neither waits for the other");
        assert_eq!(came.len(), BIG);
        assert_eq!(told.map(|told| told.len()), Some(BIG));
    }

    #[tokio::test]
    async fn a_servant_that_ends_while_it_is_written_to_is_told() {
        let (ours, theirs) = tokio::io::duplex(64);
        let socket = WebSocketStream::from_raw_socket(ours, Role::Client, None).await;
        let mut inside = FoxgloveSession::from_socket(socket);
        let mut daemon = WebSocketStream::from_raw_socket(theirs, Role::Server, None).await;
        let over = CloseFrame { code: 1012.into(), reason: "it was ended".into() };
        daemon.send(Message::Close(Some(over))).await.expect("sent");
        let request = Message::Binary(vec![9; 1 << 20].into());
        let told = inside.send(request).await.expect_err("ended");
        assert!(told.to_string().contains("the servant has ended"), "{told}");
    }
}
