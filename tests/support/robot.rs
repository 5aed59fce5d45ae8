//! A robot: a WebSocket client of rosbridge, written from the protocol's documentation without any of our code.

use std::collections::VecDeque;
use std::net::TcpStream;
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::http::Uri;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::{self, ClientRequestBuilder, Message, WebSocket};

use crate::patience::{Deadline, PatientStream, describe_slowness, is_slow};

/// One connection.
pub struct Robot {
    socket: WebSocket<PatientStream<TcpStream>>,
    backlog: VecDeque<Value>,
    calls: u64,
}

fn request_with_protocols(uri: Uri, protocols: &[&str]) -> ClientRequestBuilder {
    let request = ClientRequestBuilder::new(uri);
    protocols.iter().fold(request, |request, protocol| request.with_sub_protocol(*protocol))
}

impl Robot {
    /// Connects to `ws://ADDRESS/PATH`.
    pub fn connect(url: &str) -> anyhow::Result<Robot> {
        Robot::try_connect(url).map_err(|refusal| anyhow::anyhow!("{url}: {refusal}"))
    }

    /// Connects with a small receive buffer.
    pub fn connect_with_small_buffer(url: &str, protocols: &[&str]) -> anyhow::Result<Robot> {
        let address = url.strip_prefix("ws://").and_then(|rest| rest.split('/').next()).context("a ws:// address")?;
        let stream = TcpStream::connect(address)?;
        nix::sys::socket::setsockopt(&stream, nix::sys::socket::sockopt::RcvBuf, &(64 * 1024))?;
        let request = request_with_protocols(url.parse()?, protocols);
        let (socket, _) = tungstenite::client(request, PatientStream::new(stream)?)
            .map_err(|error| anyhow::anyhow!("{url}: {error}"))?;
        Ok(Robot { socket, backlog: VecDeque::new(), calls: 0 })
    }

    /// Connects, or returns the HTTP status and body of the refusal.
    pub fn try_connect(url: &str) -> Result<Robot, ConnectionRefusal> {
        Robot::try_connect_with_protocols(url, &[]).map(|(robot, _)| robot)
    }

    /// Connects with further headers, such as a browser's.
    pub fn try_connect_with_headers(url: &str, headers: &[(&str, &str)]) -> Result<Robot, ConnectionRefusal> {
        Robot::try_connect_with(url, &[], headers).map(|(robot, _)| robot)
    }

    /// Connects with an offer of WebSocket subprotocols; returns the selected one as well.
    pub fn try_connect_with_protocols(
        url: &str,
        protocols: &[&str],
    ) -> Result<(Robot, Option<String>), ConnectionRefusal> {
        Robot::try_connect_with(url, protocols, &[])
    }

    fn try_connect_with(
        url: &str,
        protocols: &[&str],
        headers: &[(&str, &str)],
    ) -> Result<(Robot, Option<String>), ConnectionRefusal> {
        let address = url
            .strip_prefix("ws://")
            .and_then(|rest| rest.split('/').next())
            .ok_or_else(|| ConnectionRefusal::without_status("not a ws:// address"))?;
        let stream =
            TcpStream::connect(address).map_err(|error| ConnectionRefusal::without_status(&error.to_string()))?;
        let _ = stream.set_nodelay(true);
        let stream =
            PatientStream::new(stream).map_err(|error| ConnectionRefusal::without_status(&error.to_string()))?;
        let uri = url.parse().map_err(|error| ConnectionRefusal::without_status(&format!("{error}")))?;
        let request = request_with_protocols(uri, protocols);
        let request = headers.iter().fold(request, |request, (name, value)| request.with_header(*name, *value));
        match tungstenite::client(request, stream) {
            Ok((socket, response)) => {
                let chosen = response.headers().get("sec-websocket-protocol");
                let chosen = chosen.and_then(|chosen| Some(chosen.to_str().ok()?.to_owned()));
                let robot = Robot { socket, backlog: VecDeque::new(), calls: 0 };
                Ok((robot, chosen))
            }
            Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(response))) => Err(ConnectionRefusal {
                status: response.status().as_u16(),
                body: String::from_utf8_lossy(response.body().as_deref().unwrap_or_default()).into_owned(),
            }),
            Err(error) => Err(ConnectionRefusal::without_status(&error.to_string())),
        }
    }

    /// Sends an operation.
    pub fn send(&mut self, operation: Value) -> anyhow::Result<()> {
        self.send_frame(Message::text(operation.to_string()))
    }

    /// Sends a frame unchanged.
    pub fn send_frame(&mut self, frame: Message) -> anyhow::Result<()> {
        self.socket.send(frame).context("the connection is gone")
    }

    /// Returns the next frame of any kind.
    pub fn next_frame(&mut self) -> anyhow::Result<Message> {
        Ok(self.socket.read()?)
    }

    /// Returns the next frame if it arrives in time; for measurements.
    pub fn next_frame_within(&mut self, time: Duration) -> anyhow::Result<Message> {
        self.socket.get_mut().limit(Some(time))?;
        let frame = self.socket.read();
        self.socket.get_mut().limit(None)?;
        Ok(frame?)
    }

    /// Counts the bytes that are waiting to be read, up to some thousand.
    pub fn count_waiting_bytes(&self) -> anyhow::Result<usize> {
        let mut bytes = vec![0; 64 << 10];
        match self.socket.get_ref().get().peek(&mut bytes) {
            Err(error) if is_slow(&error) => Ok(0),
            peeked => Ok(peeked?),
        }
    }

    /// Returns the first message that `wanted` accepts; other messages are kept for later.
    pub fn wait_for(&mut self, what: &str, wanted: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
        if let Some(index) = self.backlog.iter().position(&wanted) {
            return Ok(self.backlog.remove(index).expect("just found"));
        }
        let deadline = Deadline::begin();
        loop {
            deadline.check(|| {
                let heard = &self.backlog;
                format!("{what} did not come; {}; heard instead: {heard:?}", describe_slowness())
            })?;
            let frame =
                self.next_frame().with_context(|| format!("waiting for {what}; heard so far: {:?}", self.backlog))?;
            let value = match frame {
                Message::Text(text) => serde_json::from_str(text.as_str())?,
                Message::Binary(bytes) => ciborium::from_reader::<Value, _>(bytes.as_ref())?,
                Message::Close(frame) => bail!("closed while waiting for {what}: {frame:?}; heard {:?}", self.backlog),
                _ => continue,
            };
            if wanted(&value) {
                return Ok(value);
            }
            self.backlog.push_back(value);
        }
    }

    /// Returns whether no message that `unwanted` accepts arrives before the answer to a call made now: as messages are
    /// ordered, anything sent earlier would have arrived by then.
    pub fn has_not_heard(&mut self, unwanted: impl Fn(&Value) -> bool) -> anyhow::Result<bool> {
        self.call("/rosapi/get_time", json!({}))?;
        Ok(!self.backlog.iter().any(unwanted))
    }

    /// Returns the message of the next publication on a topic.
    pub fn next_message_on(&mut self, topic: &str) -> anyhow::Result<Value> {
        let heard = self
            .wait_for(&format!("a message on {topic}"), |value| value["op"] == "publish" && value["topic"] == topic)?;
        Ok(heard["msg"].clone())
    }

    /// Returns the next status message that contains `word`.
    pub fn wait_for_status(&mut self, word: &str) -> anyhow::Result<Value> {
        self.wait_for(&format!("a status that mentions {word:?}"), |value| {
            value["op"] == "status" && value["msg"].as_str().is_some_and(|text| text.contains(word))
        })
    }

    /// Calls a service and returns the whole response.
    pub fn call(&mut self, service: &str, arguments: Value) -> anyhow::Result<Value> {
        self.calls += 1;
        let id = format!("call:{}", self.calls);
        self.send(json!({"op": "call_service", "id": id, "service": service, "args": arguments}))?;
        self.wait_for(&format!("the answer of {service}"), |value| {
            value["op"] == "service_response" && value["id"] == id.as_str()
        })
    }

    /// Polls rosapi until a node subscribes to `topic`.
    pub fn wait_for_subscriber(&mut self, topic: &str) -> anyhow::Result<()> {
        crate::wait_until(&format!("a subscriber of {topic}"), || {
            let answer = self.call("/rosapi/subscribers", json!({"topic": topic}))?;
            let nodes = answer["values"]["subscribers"].as_array();
            let is_heard = nodes.is_some_and(|nodes| !nodes.is_empty());
            Ok(is_heard.then_some(()).ok_or_else(|| answer.to_string()))
        })
    }

    /// Repeats a message until the wanted one arrives: as in every ROS, messages are lost until both sides are
    /// connected. Further answers to the repetitions may arrive later.
    pub fn send_until(
        &mut self,
        message: &Value,
        what: &str,
        wanted: impl Fn(&Value) -> bool,
    ) -> anyhow::Result<Value> {
        crate::wait_until(what, || {
            self.send(message.clone())?;
            if self.has_not_heard(&wanted)? {
                return Ok(Err("it hears nothing yet".to_owned()));
            }
            self.wait_for(what, &wanted).map(Ok)
        })
    }

    /// Subscribes to a topic; the protocol has no confirmation.
    pub fn subscribe(&mut self, topic: &str) -> anyhow::Result<()> {
        self.send(json!({"op": "subscribe", "topic": topic}))
    }

    /// Waits for a close frame of the other side and returns it.
    pub fn wait_for_close(&mut self) -> anyhow::Result<CloseFrame> {
        loop {
            match self.next_frame() {
                Ok(Message::Close(Some(frame))) => return Ok(frame),
                Ok(Message::Close(None)) => bail!("closed without a reason"),
                Ok(_) => {}
                Err(error) => {
                    return Err(error.context("the connection ended without a close frame"));
                }
            }
        }
    }

    /// Closes the connection and waits for the close frame.
    pub fn leave(mut self) -> anyhow::Result<()> {
        self.socket.close(None)?;
        while self.next_frame().is_ok() {}
        Ok(())
    }
}

/// The refusal of a connection.
#[derive(Debug)]
pub struct ConnectionRefusal {
    /// HTTP status; 0 without an HTTP response.
    pub status: u16,
    /// Body of the response.
    pub body: String,
}

impl ConnectionRefusal {
    fn without_status(text: &str) -> ConnectionRefusal {
        ConnectionRefusal { status: 0, body: text.to_owned() }
    }
}

impl std::error::Error for ConnectionRefusal {}

impl std::fmt::Display for ConnectionRefusal {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "refused with {}: {}", self.status, self.body)
    }
}
