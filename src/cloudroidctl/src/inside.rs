//! A servant's ROS from inside, by Foxglove's WebSocket protocol: its messages as the bytes that they are.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::task::{Context, Poll, ready};

use anyhow::{Context as _, anyhow, bail};
use api::Servant;
use foxglove::ws_protocol::server::ServerMessage;
use futures_util::{SinkExt, StreamExt};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use recording::Format;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::Instant;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;

use crate::client::{Client, escaped};

/// Of the daemon's, see docs/page.md.
const PROTOCOL: &str = "foxglove.sdk.v1";

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
pub struct Inside<S = TokioIo<Upgraded>> {
    socket: WebSocketStream<S>,
    /// Which ROS the servant's messages are of.
    pub format: Format,
    /// What has come while something was sent, and when.
    ahead: VecDeque<(Instant, Message)>,
}

impl Inside {
    /// Attaches to a servant; `depth` messages of each topic wait in the daemon.
    pub async fn attach(client: &Client, servant: &str, depth: usize) -> anyhow::Result<Self> {
        let path = format!("/foxglove/{}?depth={depth}", escaped(servant));
        let socket = client.socket(&path, PROTOCOL).await?;
        let mut inside = Self::of(socket);
        inside.greeted().await?;
        Ok(inside)
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Inside<S> {
    fn of(socket: WebSocketStream<S>) -> Self {
        Self {
            socket,
            format: Format::default(),
            ahead: VecDeque::new(),
        }
    }

    /// Takes the daemon's first message, which says how messages are written.
    async fn greeted(&mut self) -> anyhow::Result<()> {
        let Some(message) = self.next().await? else {
            bail!("the servant has ended");
        };
        match read(&message) {
            Some(ServerMessage::ServerInfo(told)) => {
                let mut encodings = told.supported_encodings.iter();
                let known = encodings.find_map(|encoding| Format::of_encoding(encoding));
                self.format = known.unwrap_or_default();
                Ok(())
            }
            _ => bail!("the daemon does not greet as the protocol {PROTOCOL} has it"),
        }
    }

    /// Sends one message. What comes meanwhile is taken, and given by [`next`](Self::next): the daemon takes nothing more of who
    /// takes nothing, so that two big messages that meet would wait for each other.
    pub async fn send(&mut self, message: impl Into<Message>) -> anyhow::Result<()> {
        let mut waiting = Some(message.into());
        poll_fn(|cx| self.poll_send(cx, &mut waiting)).await
    }

    fn poll_send(
        &mut self,
        cx: &mut Context<'_>,
        waiting: &mut Option<Message>,
    ) -> Poll<anyhow::Result<()>> {
        const BROKEN: &str = "the daemon broke the connection";
        while let Poll::Ready(came) = self.socket.poll_next_unpin(cx) {
            match came {
                Some(Ok(Message::Close(close))) => {
                    let over = ended(close).map(|()| anyhow!("the servant has ended"));
                    return Poll::Ready(over.and_then(Err));
                }
                Some(Ok(message)) => self.ahead.push_back((Instant::now(), message)),
                Some(Err(error)) => return Poll::Ready(Err(error).context(BROKEN)),
                None => return Poll::Ready(Err(anyhow!(BROKEN))),
            }
        }
        if waiting.is_some() {
            ready!(self.socket.poll_ready_unpin(cx)).context(BROKEN)?;
        }
        if let Some(message) = waiting.take() {
            self.socket.start_send_unpin(message).context(BROKEN)?;
        }
        self.socket
            .poll_flush_unpin(cx)
            .map_err(|error| anyhow::Error::new(error).context(BROKEN))
    }

    /// The next that is told, as it came; none where the servant has ended.
    ///
    /// # Errors
    /// The connection was lost, or closed for another reason.
    pub async fn next(&mut self) -> anyhow::Result<Option<Message>> {
        Ok(self.next_at().await?.map(|(_, message)| message))
    }

    /// The same, and when it came.
    pub async fn next_at(&mut self) -> anyhow::Result<Option<(Instant, Message)>> {
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
                Some((_, Ok(Message::Close(close)))) => return ended(close).map(|()| None),
                Some((_, Ok(_))) => {}
                Some((_, Err(error))) => {
                    return Err(error).context("the daemon broke the connection");
                }
                None => bail!("the daemon broke the connection"),
            }
        }
    }

    /// Leaves once the daemon has taken all that was sent; what it says of that.
    pub async fn leave(mut self) -> Vec<Message> {
        let _ = self.socket.close(None).await;
        let ahead = self.ahead.drain(..);
        let mut last: Vec<Message> = ahead.map(|(_, message)| message).collect();
        while let Some(Ok(message)) = self.socket.next().await {
            last.push(message);
        }
        last
    }
}

/// What a goodbye of the daemon says: nothing where the servant has ended.
fn ended(close: Option<CloseFrame>) -> anyhow::Result<()> {
    match close {
        Some(close) if u16::from(close.code) == 1012 => Ok(()),
        Some(close) => Err(anyhow!("the daemon ended it: {}", close.reason)),
        None => bail!("the daemon broke the connection"),
    }
}

/// What a message says; none where it is nothing that is known here.
pub fn read(message: &Message) -> Option<ServerMessage<'_>> {
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
        let mut inside = Inside::of(socket);
        let mut daemon = WebSocketStream::from_raw_socket(theirs, Role::Server, None).await;
        // It reads nothing before all that it sends is taken.
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
        let mut inside = Inside::of(socket);
        let mut daemon = WebSocketStream::from_raw_socket(theirs, Role::Server, None).await;
        let over = CloseFrame {
            code: 1012.into(),
            reason: "it was ended".into(),
        };
        daemon.send(Message::Close(Some(over))).await.expect("sent");
        let request = Message::Binary(vec![9; 1 << 20].into());
        let told = inside.send(request).await.expect_err("ended");
        assert!(told.to_string().contains("the servant has ended"), "{told}");
    }
}
