//! A robot: a WebSocket client that speaks rosbridge as its protocol document says, with nothing of ours in it.

use std::collections::VecDeque;
use std::net::TcpStream;
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::http::Uri;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::{self, ClientRequestBuilder, Message, WebSocket};

use crate::patience::{Deadline, Patient, describe_slowness, is_slow};

/// One connection.
pub struct Robot {
    socket: WebSocket<Patient<TcpStream>>,
    backlog: VecDeque<Value>,
    calls: u64,
}

fn offering(uri: Uri, protocols: &[&str]) -> ClientRequestBuilder {
    let request = ClientRequestBuilder::new(uri);
    protocols.iter().fold(request, |request, protocol| {
        request.with_sub_protocol(*protocol)
    })
}

impl Robot {
    /// Connects to `ws://ADDRESS/PATH`.
    pub fn connect(url: &str) -> anyhow::Result<Robot> {
        Robot::try_connect(url).map_err(|refusal| anyhow::anyhow!("{url}: {refusal}"))
    }

    /// Connects with a socket of its own side that takes little before it is read.
    pub fn on_a_short_line(url: &str, protocols: &[&str]) -> anyhow::Result<Robot> {
        let address = url
            .strip_prefix("ws://")
            .and_then(|rest| rest.split('/').next())
            .context("a ws:// address")?;
        let stream = TcpStream::connect(address)?;
        nix::sys::socket::setsockopt(&stream, nix::sys::socket::sockopt::RcvBuf, &(64 * 1024))?;
        let request = offering(url.parse()?, protocols);
        let (socket, _) = tungstenite::client(request, Patient::new(stream)?)
            .map_err(|error| anyhow::anyhow!("{url}: {error}"))?;
        Ok(Robot {
            socket,
            backlog: VecDeque::new(),
            calls: 0,
        })
    }

    /// Connects, or says with which HTTP status and body it was refused.
    pub fn try_connect(url: &str) -> Result<Robot, Refusal> {
        Robot::try_connect_offering(url, &[]).map(|(robot, _)| robot)
    }

    /// The same with these headers, such as a browser's.
    pub fn try_connect_showing(url: &str, headers: &[(&str, &str)]) -> Result<Robot, Refusal> {
        Robot::try_connect_with(url, &[], headers).map(|(robot, _)| robot)
    }

    /// The same with WebSocket subprotocols on offer; gives also the one that was chosen.
    pub fn try_connect_offering(
        url: &str,
        protocols: &[&str],
    ) -> Result<(Robot, Option<String>), Refusal> {
        Robot::try_connect_with(url, protocols, &[])
    }

    fn try_connect_with(
        url: &str,
        protocols: &[&str],
        headers: &[(&str, &str)],
    ) -> Result<(Robot, Option<String>), Refusal> {
        let address = url
            .strip_prefix("ws://")
            .and_then(|rest| rest.split('/').next())
            .ok_or_else(|| Refusal::other("not a ws:// address"))?;
        let stream =
            TcpStream::connect(address).map_err(|error| Refusal::other(&error.to_string()))?;
        let _ = stream.set_nodelay(true);
        let stream = Patient::new(stream).map_err(|error| Refusal::other(&error.to_string()))?;
        let uri = url
            .parse()
            .map_err(|error| Refusal::other(&format!("{error}")))?;
        let request = offering(uri, protocols);
        let request = headers.iter().fold(request, |request, (name, value)| {
            request.with_header(*name, *value)
        });
        match tungstenite::client(request, stream) {
            Ok((socket, response)) => {
                let chosen = response.headers().get("sec-websocket-protocol");
                let chosen = chosen.and_then(|chosen| Some(chosen.to_str().ok()?.to_owned()));
                let robot = Robot {
                    socket,
                    backlog: VecDeque::new(),
                    calls: 0,
                };
                Ok((robot, chosen))
            }
            Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(response))) => {
                Err(Refusal {
                    status: response.status().as_u16(),
                    body: String::from_utf8_lossy(response.body().as_deref().unwrap_or_default())
                        .into_owned(),
                })
            }
            Err(error) => Err(Refusal::other(&error.to_string())),
        }
    }

    /// Sends one operation.
    pub fn says(&mut self, operation: Value) -> anyhow::Result<()> {
        self.sends(Message::text(operation.to_string()))
    }

    /// Sends a frame as it is.
    pub fn sends(&mut self, frame: Message) -> anyhow::Result<()> {
        self.socket.send(frame).context("the connection is gone")
    }

    /// The next frame, whatever it is.
    pub fn frame(&mut self) -> anyhow::Result<Message> {
        Ok(self.socket.read()?)
    }

    /// The same, if it comes in this time; for measurements.
    pub fn frame_within(&mut self, time: Duration) -> anyhow::Result<Message> {
        self.socket.get_mut().limit(Some(time))?;
        let frame = self.socket.read();
        self.socket.get_mut().limit(None)?;
        Ok(frame?)
    }

    /// Counts bytes that wait to be read, up to some thousand.
    pub fn counts_waiting(&self) -> anyhow::Result<usize> {
        let mut bytes = vec![0; 64 << 10];
        match self.socket.get_ref().get().peek(&mut bytes) {
            Err(error) if is_slow(&error) => Ok(0),
            peeked => Ok(peeked?),
        }
    }

    /// The first message that `wanted` accepts; others are kept for later.
    pub fn hears(&mut self, what: &str, wanted: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
        if let Some(index) = self.backlog.iter().position(&wanted) {
            return Ok(self.backlog.remove(index).expect("just found"));
        }
        let deadline = Deadline::begin();
        loop {
            deadline.check(|| {
                let heard = &self.backlog;
                format!(
                    "{what} did not come; {}; heard instead: {heard:?}",
                    describe_slowness()
                )
            })?;
            let frame = self
                .frame()
                .with_context(|| format!("waiting for {what}; heard so far: {:?}", self.backlog))?;
            let value = match frame {
                Message::Text(text) => serde_json::from_str(text.as_str())?,
                Message::Binary(bytes) => ciborium::from_reader::<Value, _>(bytes.as_ref())?,
                Message::Close(frame) => bail!(
                    "closed while waiting for {what}: {frame:?}; heard {:?}",
                    self.backlog
                ),
                _ => continue,
            };
            if wanted(&value) {
                return Ok(value);
            }
            self.backlog.push_back(value);
        }
    }

    /// Whether nothing that `unwanted` accepts comes before the answer to a call made now: messages keep their
    /// order, so what has not come before that answer was not under way.
    pub fn has_not_heard(&mut self, unwanted: impl Fn(&Value) -> bool) -> anyhow::Result<bool> {
        self.calls("/rosapi/get_time", json!({}))?;
        Ok(!self.backlog.iter().any(unwanted))
    }

    /// The message of the next publication on a topic.
    pub fn hears_on(&mut self, topic: &str) -> anyhow::Result<Value> {
        let heard = self.hears(&format!("a message on {topic}"), |value| {
            value["op"] == "publish" && value["topic"] == topic
        })?;
        Ok(heard["msg"].clone())
    }

    /// The next status message that mentions `word`.
    pub fn hears_status(&mut self, word: &str) -> anyhow::Result<Value> {
        self.hears(&format!("a status that mentions {word:?}"), |value| {
            value["op"] == "status"
                && value["msg"]
                    .as_str()
                    .is_some_and(|text| text.contains(word))
        })
    }

    /// Calls a service and gives the whole response.
    pub fn calls(&mut self, service: &str, arguments: Value) -> anyhow::Result<Value> {
        self.calls += 1;
        let id = format!("call:{}", self.calls);
        self.says(json!({"op": "call_service", "id": id, "service": service, "args": arguments}))?;
        self.hears(&format!("the answer of {service}"), |value| {
            value["op"] == "service_response" && value["id"] == id.as_str()
        })
    }

    /// Waits until a node listens to `topic`, by asking rosapi again and again.
    pub fn awaits_subscriber(&mut self, topic: &str) -> anyhow::Result<()> {
        crate::until(&format!("a subscriber of {topic}"), || {
            let answer = self.calls("/rosapi/subscribers", json!({"topic": topic}))?;
            let nodes = answer["values"]["subscribers"].as_array();
            let is_heard = nodes.is_some_and(|nodes| !nodes.is_empty());
            Ok(is_heard.then_some(()).ok_or_else(|| answer.to_string()))
        })
    }

    /// Says something again and again until it hears what comes of it: what is said, or answered, before both sides are
    /// connected is lost, as in every ROS. More of what was asked for more than once may come later.
    pub fn says_until(
        &mut self,
        message: &Value,
        what: &str,
        wanted: impl Fn(&Value) -> bool,
    ) -> anyhow::Result<Value> {
        crate::until(what, || {
            self.says(message.clone())?;
            if self.has_not_heard(&wanted)? {
                return Ok(Err("it hears nothing yet".to_owned()));
            }
            self.hears(what, &wanted).map(Ok)
        })
    }

    /// Subscribes and says so by nothing, as the protocol has it.
    pub fn subscribes(&mut self, topic: &str) -> anyhow::Result<()> {
        self.says(json!({"op": "subscribe", "topic": topic}))
    }

    /// Waits for the other side to close, and gives code and reason.
    pub fn hears_close(&mut self) -> anyhow::Result<CloseFrame> {
        loop {
            match self.frame() {
                Ok(Message::Close(Some(frame))) => return Ok(frame),
                Ok(Message::Close(None)) => bail!("closed without a reason"),
                Ok(_) => {}
                Err(error) => {
                    return Err(error.context("the connection ended without a close frame"));
                }
            }
        }
    }

    /// Says goodbye and waits for the answer.
    pub fn leaves(mut self) -> anyhow::Result<()> {
        self.socket.close(None)?;
        while self.frame().is_ok() {}
        Ok(())
    }
}

/// Why a connection was refused.
#[derive(Debug)]
pub struct Refusal {
    /// HTTP status; 0 when it did not come to HTTP.
    pub status: u16,
    /// The body.
    pub body: String,
}

impl Refusal {
    fn other(text: &str) -> Refusal {
        Refusal {
            status: 0,
            body: text.to_owned(),
        }
    }
}

impl std::error::Error for Refusal {}

impl std::fmt::Display for Refusal {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "refused with {}: {}", self.status, self.body)
    }
}
