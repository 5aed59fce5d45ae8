//! A client of rosbridge in the same network as the server, whoever's that is: `bench-ros2 inside client ROLE …`. It does little
//! besides waiting, and the same for every server.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use rosbridge::{Format, Frame, Op, Writer};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{self, Error, Message, WebSocket};

use crate::camera::{self, RATE, Seen};
use crate::message::{self, Size, TEXT};
use crate::portal::ADDRESS;
use crate::roles::{WARM, quantiles, say};
use crate::types;

/// A server starts and discovers nodes within this.
const LONG: Duration = Duration::from_secs(15);
/// What takes longer does not come.
const PATIENCE: Duration = Duration::from_secs(5);
/// What is said again until it is answered, so often.
const AGAIN: Duration = Duration::from_millis(20);
/// The first call or goal waits so long for its server to be discovered before another one is sent, under another name: servers refuse a
/// goal whose name is under way.
const FIRST: Duration = Duration::from_secs(1);
/// A picture of 6 MB and what is around it.
const LARGEST: usize = 32 << 20;

/// Plays the role.
pub(crate) fn play(words: &[&str]) -> Result<()> {
    match words {
        ["trips", count] => trips(count.parse()?),
        ["calls", count] => calls(count.parse()?),
        ["goals", count] => goals(count.parse()?),
        ["joins"] => joins(),
        ["sends", width, height, frames, reliable] => {
            let (width, height) = (width.parse()?, height.parse()?);
            sends(Size { width, height }, frames.parse()?, reliable)
        }
        ["takes", reliable] => takes(reliable),
        _ => bail!("no role of a client is called {words:?}"),
    }
}

/// One connection.
struct Client(WebSocket<TcpStream>);

impl Client {
    /// Connects, once the server listens.
    fn connect() -> Result<Self> {
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
        let config = WebSocketConfig::default()
            .max_message_size(Some(LARGEST))
            .max_frame_size(Some(LARGEST));
        let url = format!("ws://{ADDRESS}/");
        match tungstenite::client::client_with_config(url, stream, Some(config)) {
            Ok((socket, _)) => Ok(Self(socket)),
            Err(error) => bail!("no WebSocket at {ADDRESS}: {error}"),
        }
    }

    fn say(&mut self, op: &Value) -> Result<()> {
        self.send(Message::text(op.to_string()))
    }

    fn send(&mut self, message: Message) -> Result<()> {
        self.0.send(message).context("the connection is gone")
    }

    /// The next message, if one comes.
    fn hear(&mut self, patience: Duration) -> Result<Option<Message>> {
        self.0.get_ref().set_read_timeout(Some(patience))?;
        loop {
            match self.0.read() {
                Ok(message @ (Message::Text(_) | Message::Binary(_))) => return Ok(Some(message)),
                Ok(Message::Close(why)) => bail!("the server closed the connection: {why:?}"),
                Ok(_) => {}
                Err(Error::Io(error))
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) =>
                {
                    return Ok(None);
                }
                Err(error) => return Err(error).context("the connection is gone"),
            }
        }
    }

    /// Waits for a text with these words.
    fn text_with(&mut self, words: &str, patience: Duration) -> Result<Option<String>> {
        while let Some(message) = self.hear(patience)? {
            if let Message::Text(text) = message
                && text.contains(words)
            {
                return Ok(Some(text.to_string()));
            }
        }
        Ok(None)
    }

    /// Says what `op` gives for each attempt until what is wanted comes.
    fn until(
        &mut self,
        op: impl Fn(usize) -> Value,
        patience: Duration,
        wanted: impl Fn(&Value) -> bool,
    ) -> Result<()> {
        let limit = Instant::now() + LONG;
        let mut last = Value::Null;
        for attempt in 0.. {
            self.say(&op(attempt))?;
            let again = Instant::now() + patience;
            while let Some(message) = self.hear(patience)? {
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

fn quality(reliable: &str) -> Value {
    let reliability = match reliable {
        "1" => "reliable",
        _ => "best_effort",
    };
    json!({"reliability": reliability, "history": "keep_last", "depth": 5})
}

/// `count` times what `op` gives for a number, until the text with the words that it gives has come, which must be an `answer`; one at a
/// time.
fn timed(
    client: &mut Client,
    count: usize,
    op: impl Fn(usize) -> (Value, String),
    answer: impl Fn(&Value) -> bool,
) -> Result<Vec<Duration>> {
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let (op, words) = op(number);
        let message = Message::text(op.to_string());
        let begun = Instant::now();
        client.send(message)?;
        let text = client.text_with(&words, PATIENCE)?;
        let took = begun.elapsed();
        let text = text.with_context(|| format!("no answer to {op}"))?;
        // Not a status that tells why there is none.
        ensure!(answer(&serde_json::from_str(&text)?), "{op} brings {text}");
        if number >= WARM {
            times.push(took);
        }
    }
    Ok(times)
}

/// Strings there and back, one at a time.
fn trips(count: usize) -> Result<()> {
    let mut client = Client::connect()?;
    client.say(&json!({"op": "subscribe", "topic": "/pong", "type": types::STRING}))?;
    client.say(&json!({"op": "advertise", "topic": "/ping", "type": types::STRING}))?;
    let publish = |text: &str| json!({"op": "publish", "topic": "/ping", "msg": {"data": text}});
    client.until(
        |_| publish("first"),
        AGAIN,
        |heard| heard["msg"]["data"] == "first",
    )?;
    say(&json!({}));
    let op = |number| {
        let text = format!("{TEXT}, {number}");
        (publish(&text), format!("{text}\""))
    };
    let times = timed(&mut client, count, op, |heard| heard["topic"] == "/pong")?;
    say(&quantiles(&times));
    Ok(())
}

/// Calls, one at a time.
fn calls(count: usize) -> Result<()> {
    let mut client = Client::connect()?;
    let call = |id: &str| json!({"op": "call_service", "id": id, "service": "/setbool", "type": types::CALL, "args": {"data": true}});
    let answer = |heard: &Value| heard["values"]["success"] == true;
    client.until(|attempt| call(&format!("first-{attempt}")), FIRST, answer)?;
    say(&json!({}));
    let op = |number| {
        let id = format!("call-{number}");
        (call(&id), format!("\"{id}\""))
    };
    say(&quantiles(&timed(&mut client, count, op, answer)?));
    Ok(())
}

/// Goals from their sending to their result, one at a time.
fn goals(count: usize) -> Result<()> {
    let mut client = Client::connect()?;
    let goal = |id: &str| {
        json!({"op": "send_action_goal", "id": id, "action": "/fibonacci", "action_type": types::GOAL,
            "args": {"order": 2}, "feedback": false})
    };
    let answer = |heard: &Value| heard["values"]["sequence"] == json!([0, 1]);
    client.until(|attempt| goal(&format!("first-{attempt}")), FIRST, answer)?;
    say(&json!({}));
    let op = |number| {
        let id = format!("goal-{number}");
        (goal(&id), format!("\"{id}\""))
    };
    say(&quantiles(&timed(&mut client, count, op, answer)?));
    Ok(())
}

/// From connecting to the first message of a node that runs.
fn joins() -> Result<()> {
    say(&json!({}));
    let begun = Instant::now();
    let mut client = Client::connect()?;
    client.say(&json!({"op": "subscribe", "topic": "/beat", "type": types::STRING}))?;
    let beat = client.text_with("/beat", LONG)?;
    let took = begun.elapsed().as_secs_f64() * 1e3;
    beat.context("no beat")?;
    say(&json!({"beat": took}));
    Ok(())
}

/// Sends pictures once somebody takes them: how many were late. What it takes itself is not told, because a robot is no part of
/// the server.
fn sends(size: Size, frames: u32, reliable: &str) -> Result<()> {
    let mut client = Client::connect()?;
    client.say(&json!({"op": "advertise", "topic": "/pictures", "type": types::IMAGE, "qos": quality(reliable)}))?;
    say(&json!({}));
    let asks = json!({"op": "call_service", "service": "/rosapi/subscribers", "args": {"topic": "/pictures"}});
    client.until(
        |_| asks.clone(),
        AGAIN,
        |heard| heard["values"]["subscribers"][0].is_string(),
    )?;
    std::thread::sleep(camera::SETTLED);
    let (mut due, mut late) = (Instant::now(), 0);
    for number in 0..frames {
        client.send(Message::binary(publish(&message::picture(number, size))))?;
        due += Duration::from_secs_f64(1.0 / RATE);
        let now = Instant::now();
        late += u32::from(now > due);
        std::thread::sleep(due.saturating_duration_since(now));
    }
    // What is still on its way, and being sent again.
    std::thread::sleep(Duration::from_secs(2));
    say(&json!({"late": late}));
    // The session stays until the taker has been asked.
    std::io::copy(&mut std::io::stdin(), &mut std::io::sink())?;
    Ok(())
}

/// A picture as `cbor-raw`.
fn publish(picture: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(picture.len() + 128);
    let mut writer = Writer::op(&mut out, Format::Cbor, "publish", None);
    writer.text("topic", "/pictures");
    writer.text("compression", "cbor-raw");
    writer.raw("msg", None, picture);
    writer.end();
    out
}

/// Takes pictures: what came, when asked.
fn takes(reliable: &str) -> Result<()> {
    let mut client = Client::connect()?;
    client.say(
        &json!({"op": "subscribe", "topic": "/pictures", "type": types::IMAGE,
        "compression": "cbor-raw", "qos": quality(reliable)}),
    )?;
    // The server knows of it when it answers what is asked after it.
    let asks = json!({"op": "call_service", "service": "/rosapi/get_time"});
    client.until(|_| asks.clone(), AGAIN, |heard| heard["result"] == true)?;
    say(&json!({}));
    let seen = Arc::new(Mutex::new(Seen::default()));
    let watched = seen.clone();
    std::thread::spawn(move || {
        if let Err(error) = watch(&mut client, &watched) {
            eprintln!("a client that takes pictures: {error:#}");
        }
    });
    std::io::Read::read(&mut std::io::stdin(), &mut [0])?;
    let seen = seen.lock().ok().context("the other thread panicked")?;
    say(&seen.told());
    Ok(())
}

fn watch(client: &mut Client, seen: &Mutex<Seen>) -> Result<()> {
    loop {
        let Some(Message::Binary(frame)) = client.hear(LONG)? else {
            continue;
        };
        let Op::Publish(publish) = Op::parse(Frame::Binary(&frame))? else {
            continue;
        };
        let raw = publish.msg.raw()?;
        let mut seen = seen.lock().ok().context("the other thread panicked")?;
        seen.take(&raw.bytes).context("it is no picture")?;
    }
}
