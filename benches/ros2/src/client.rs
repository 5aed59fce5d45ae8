//! A rosbridge client in the server's network: `bench-ros2 inside client ROLE …`, the same for every server.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use rosbridge::{Format, Op, ProtocolFrame, Writer};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{self, Error, Message, WebSocket};

use crate::bus::LONG;
use crate::echoes;
use crate::exchanges::{print_json, print_ready, time_blocking};
use crate::messages::{self, Size, TEXT};
use crate::pictures::{FrameStatistics, RATE, SETTLED};
use crate::portal::ADDRESS;

/// Time after which an answer counts as missing.
pub(crate) const PATIENCE: Duration = Duration::from_secs(5);
/// Interval at which a message is repeated until it is answered.
pub(crate) const AGAIN: Duration = Duration::from_millis(20);
/// Time for a server to be discovered before another first call is sent, under another id.
const FIRST: Duration = Duration::from_secs(1);
/// Limit of a message: more than an image of 6 MB with its envelope.
const LARGEST: usize = 32 << 20;

/// Runs the role that `words` names.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    match words {
        ["trips", count] => time_trips(count.parse()?),
        ["calls", count] => time_calls(count.parse()?),
        ["goals", count] => time_goals(count.parse()?),
        ["joins"] => time_join(),
        ["echoes", rest @ ..] => echoes::run(rest),
        ["sends", width, height, frames, reliable] => {
            let (width, height) = (width.parse()?, height.parse()?);
            send_pictures(Size { width, height }, frames.parse()?, reliable)
        }
        ["takes", reliable] => receive_pictures(reliable),
        _ => bail!("no role of a client is called {words:?}"),
    }
}

/// A connection to the server.
pub(crate) struct BenchClient(WebSocket<TcpStream>);

impl BenchClient {
    /// Connects as soon as the server listens.
    pub(crate) fn connect() -> Result<Self> {
        let limit = Instant::now() + LONG;
        let stream = loop {
            match TcpStream::connect(ADDRESS) {
                Ok(stream) => break stream,
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {
                    ensure!(Instant::now() < limit, "nobody listens at {ADDRESS}");
                    std::thread::sleep(AGAIN);
                }
                Err(error) => return Err(error).context(ADDRESS),
            }
        };
        stream.set_nodelay(true)?;
        let config = WebSocketConfig::default().max_message_size(Some(LARGEST)).max_frame_size(Some(LARGEST));
        let url = format!("ws://{ADDRESS}/");
        match tungstenite::client::client_with_config(url, stream, Some(config)) {
            Ok((socket, _)) => Ok(Self(socket)),
            Err(error) => bail!("no WebSocket at {ADDRESS}: {error}"),
        }
    }

    pub(crate) fn send_op(&mut self, op: &Value) -> Result<()> {
        self.send(Message::text(op.to_string()))
    }

    pub(crate) fn send(&mut self, message: Message) -> Result<()> {
        self.0.send(message).context("the connection is gone")
    }

    /// Returns the next message, or `None` if none arrives in time.
    pub(crate) fn receive(&mut self, patience: Duration) -> Result<Option<Message>> {
        self.0.get_ref().set_read_timeout(Some(patience))?;
        loop {
            match self.0.read() {
                Ok(message @ (Message::Text(_) | Message::Binary(_))) => return Ok(Some(message)),
                Ok(Message::Close(why)) => bail!("the server closed the connection: {why:?}"),
                Ok(_) => {}
                Err(Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    return Ok(None);
                }
                Err(error) => return Err(error).context("the connection is gone"),
            }
        }
    }

    /// Waits for a text message that contains `words`.
    fn receive_text_with(&mut self, words: &str, patience: Duration) -> Result<Option<String>> {
        while let Some(message) = self.receive(patience)? {
            if let Message::Text(text) = message
                && text.contains(words)
            {
                return Ok(Some(text.to_string()));
            }
        }
        Ok(None)
    }

    /// Sends what `op` returns for each attempt until `wanted` accepts a message.
    pub(crate) fn repeat_until(
        &mut self,
        op: impl Fn(usize) -> Value,
        patience: Duration,
        wanted: impl Fn(&Value) -> bool,
    ) -> Result<()> {
        let limit = Instant::now() + LONG;
        let mut last = Value::Null;
        for attempt in 0.. {
            self.send_op(&op(attempt))?;
            let again = Instant::now() + patience;
            while let Some(message) = self.receive(patience)? {
                if let Message::Text(text) = message {
                    last = serde_json::from_str(&text)?;
                    if wanted(&last) {
                        return Ok(());
                    }
                }
                if Instant::now() > again {
                    break;
                }
            }
            if Instant::now() > limit {
                break;
            }
        }
        bail!("{} does not bring what is wanted, at last {last}", op(0))
    }
}

fn qos_json(reliable: &str) -> Value {
    let reliability = if reliable == "1" { "reliable" } else { "best_effort" };
    json!({"reliability": reliability, "history": "keep_last", "depth": 5})
}

/// Makes `count` exchanges: sends an op and waits for a text with its words, which `answer` must accept.
fn time_exchanges(
    client: &mut BenchClient,
    count: usize,
    op: impl Fn(usize) -> (Value, String),
    answer: impl Fn(&Value) -> bool,
) -> Result<()> {
    time_blocking(count, |number| {
        let (op, words) = op(number);
        let message = Message::text(op.to_string());
        let begun = Instant::now();
        client.send(message)?;
        let text = client.receive_text_with(&words, PATIENCE)?;
        let took = begun.elapsed();
        let text = text.with_context(|| format!("no answer to {op}"))?;
        // The text could also be a status that says why there is no answer.
        ensure!(answer(&serde_json::from_str(&text)?), "{op} brings {text}");
        Ok(took)
    })
}

/// Measures round trips of Strings, one at a time.
fn time_trips(count: usize) -> Result<()> {
    let mut client = BenchClient::connect()?;
    client.send_op(&json!({"op": "subscribe", "topic": "/pong", "type": messages::STRING}))?;
    client.send_op(&json!({"op": "advertise", "topic": "/ping", "type": messages::STRING}))?;
    let publish = |text: &str| json!({"op": "publish", "topic": "/ping", "msg": {"data": text}});
    client.repeat_until(|_| publish("first"), AGAIN, |heard| heard["msg"]["data"] == "first")?;
    let op = |number| {
        let text = format!("{TEXT}, {number}");
        (publish(&text), format!("{text}\""))
    };
    time_exchanges(&mut client, count, op, |heard| heard["topic"] == "/pong")
}

/// Measures requests with an id, one at a time.
fn time_requests(count: usize, request: impl Fn(&str) -> Value, answer: impl Fn(&Value) -> bool) -> Result<()> {
    let mut client = BenchClient::connect()?;
    client.repeat_until(|attempt| request(&format!("first-{attempt}")), FIRST, &answer)?;
    let op = |number| {
        let id = format!("request-{number}");
        (request(&id), format!("\"{id}\""))
    };
    time_exchanges(&mut client, count, op, answer)
}

fn time_calls(count: usize) -> Result<()> {
    let call = |id: &str| {
        json!({"op": "call_service", "id": id, "service": "/setbool", "type": messages::CALL,
            "args": {"data": true}})
    };
    time_requests(count, call, |heard| heard["values"]["success"] == true)
}

/// Measures goals from sending to result.
fn time_goals(count: usize) -> Result<()> {
    let goal = |id: &str| {
        json!({"op": "send_action_goal", "id": id, "action": "/fibonacci", "action_type": messages::GOAL,
            "args": {"order": 2}, "feedback": false})
    };
    time_requests(count, goal, |heard| heard["values"]["sequence"] == json!([0, 1]))
}

/// Measures from connecting to the first message of a running node.
fn time_join() -> Result<()> {
    print_ready();
    let begun = Instant::now();
    let mut client = BenchClient::connect()?;
    client.send_op(&json!({"op": "subscribe", "topic": "/beat", "type": messages::STRING}))?;
    let beat = client.receive_text_with("/beat", LONG)?;
    let took = begun.elapsed().as_secs_f64() * 1e3;
    beat.context("no beat")?;
    print_json(&json!({"beat": took}));
    Ok(())
}

/// Sends images as soon as there is a subscriber, and counts how many were late.
fn send_pictures(size: Size, frames: u32, reliable: &str) -> Result<()> {
    let mut client = BenchClient::connect()?;
    client.send_op(
        &json!({"op": "advertise", "topic": "/pictures", "type": messages::IMAGE, "qos": qos_json(reliable)}),
    )?;
    print_ready();
    let asks = json!({"op": "call_service", "service": "/rosapi/subscribers", "args": {"topic": "/pictures"}});
    client.repeat_until(|_| asks.clone(), AGAIN, |heard| heard["values"]["subscribers"][0].is_string())?;
    std::thread::sleep(SETTLED);
    let (mut due, mut late) = (Instant::now(), 0);
    for number in 0..frames {
        client.send(Message::binary(encode_picture(&messages::picture(number, size))))?;
        due += Duration::from_secs_f64(1.0 / RATE);
        let now = Instant::now();
        late += u32::from(now > due);
        std::thread::sleep(due.saturating_duration_since(now));
    }
    // Time for frames in flight and retransmissions.
    std::thread::sleep(Duration::from_secs(2));
    print_json(&json!({"late": late}));
    // The session stays open until the receiver has been asked for its results.
    std::io::copy(&mut std::io::stdin(), &mut std::io::sink())?;
    Ok(())
}

/// Encodes a publication of an image as `cbor-raw`.
fn encode_picture(picture: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(picture.len() + 128);
    let mut writer = Writer::op(&mut out, Format::Cbor, "publish", None);
    writer.text("topic", "/pictures");
    writer.text("compression", "cbor-raw");
    writer.raw("msg", None, picture);
    writer.end();
    out
}

/// Receives images; prints what was received when asked.
fn receive_pictures(reliable: &str) -> Result<()> {
    let mut client = BenchClient::connect()?;
    client.send_op(&json!({"op": "subscribe", "topic": "/pictures", "type": messages::IMAGE,
        "compression": "cbor-raw", "qos": qos_json(reliable)}))?;
    // Once the server answers this call, it has processed the subscription.
    let asks = json!({"op": "call_service", "service": "/rosapi/get_time"});
    client.repeat_until(|_| asks.clone(), AGAIN, |heard| heard["result"] == true)?;
    print_ready();
    let seen = Arc::new(Mutex::new(FrameStatistics::default()));
    let watched = seen.clone();
    std::thread::spawn(move || {
        if let Err(error) = count_pictures(&mut client, &watched) {
            eprintln!("a client that takes pictures: {error:#}");
        }
    });
    std::io::Read::read(&mut std::io::stdin(), &mut [0])?;
    let seen = seen.lock().ok().context("the other thread panicked")?;
    print_json(&seen.to_json());
    Ok(())
}

fn count_pictures(client: &mut BenchClient, seen: &Mutex<FrameStatistics>) -> Result<()> {
    loop {
        let Some(Message::Binary(frame)) = client.receive(LONG)? else {
            continue;
        };
        let Op::Publish(publish) = Op::parse(ProtocolFrame::Binary(&frame))? else {
            continue;
        };
        let raw = publish.msg.raw()?;
        let mut seen = seen.lock().ok().context("the other thread panicked")?;
        seen.record(&raw.bytes).context("it is no picture")?;
    }
}
