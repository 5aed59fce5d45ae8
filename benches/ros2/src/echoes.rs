//! The role `client echoes THERE BACK BYTES SECONDS`: a client with [`IN_FLIGHT`] messages in flight, as
//! rosbridge-server-rs measures itself. Each has a number and a text, which are checked when it comes back.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use bench_report::quantile_seconds;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

use crate::client::{AGAIN, BenchClient, PATIENCE};
use crate::exchanges::{print_json, print_ready};
use crate::messages;

/// Messages that are sent before the first one has to come back.
pub(crate) const IN_FLIGHT: usize = 32;
/// Messages that a topic keeps in the server.
pub(crate) const DEPTH: &str = "256";
/// Round trips before the measurement, one at a time.
const WARM: usize = 20;
/// Digits of a message's number.
const DIGITS: usize = 16;

/// Topics of a round trip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EchoPath {
    /// The client subscribes to what it publishes.
    Itself,
    /// A node returns what the client publishes.
    Node,
}

impl EchoPath {
    /// Returns the topics to publish on and to subscribe to.
    pub(crate) fn topics(self) -> [&'static str; 2] {
        match self {
            Self::Itself => ["/echo", "/echo"],
            Self::Node => ["/ping", "/pong"],
        }
    }
}

/// Runs the role with these arguments.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    let [there, back, size, seconds] = words else {
        bail!("it takes two topics, a size and a number of seconds, not {words:?}");
    };
    let mut client = EchoClient::connect(there, back, size.parse()?)?;
    for _ in 0..WARM {
        client.send_next()?;
        client.receive()?;
    }
    print_ready();
    print_json(&client.measure(Duration::from_secs(seconds.parse()?))?);
    Ok(())
}

struct EchoClient {
    client: BenchClient,
    /// A message up to its number.
    head: String,
    /// The rest of its text.
    filler: String,
    /// Number of the last message.
    number: usize,
}

impl EchoClient {
    /// Connects and waits until a message comes back, which has the number 0.
    fn connect(there: &str, back: &str, size: usize) -> Result<Self> {
        let mut client = BenchClient::connect()?;
        let depth: u32 = DEPTH.parse()?;
        let qos = json!({"history": "keep_last", "depth": depth, "reliability": "reliable", "durability": "volatile"});
        client.send_op(&json!({"op": "advertise", "topic": there, "type": messages::STRING, "qos": qos}))?;
        client.send_op(&json!({"op": "subscribe", "topic": back, "type": messages::STRING, "qos": qos}))?;
        let filler = "x".repeat(size.checked_sub(DIGITS).context("a message has a number")?);
        let first = format!("{:0DIGITS$}{filler}", 0);
        let publish = json!({"op": "publish", "topic": there, "msg": {"data": first}});
        client.repeat_until(|_| publish.clone(), AGAIN, |heard| heard["topic"] == back)?;
        let head = format!(r#"{{"op":"publish","topic":"{there}","msg":{{"data":""#);
        Ok(Self { client, head, filler, number: 0 })
    }

    /// Sends the next message; returns its number.
    fn send_next(&mut self) -> Result<usize> {
        self.number += 1;
        let Self { head, filler, number, .. } = self;
        let text = format!("{head}{number:0DIGITS$}{filler}\"}}}}");
        self.client.send(Message::text(text))?;
        Ok(self.number)
    }

    /// Receives a message; returns its number. Further copies of the first one are ignored.
    fn receive(&mut self) -> Result<usize> {
        loop {
            let message = self.client.receive(PATIENCE)?.context("a message does not come back")?;
            let text = message.to_text().context("it comes back in another encoding")?;
            let number = parse_echo(text, &self.filler);
            let number = number.with_context(|| format!("no message of ours: {}", text.get(..300).unwrap_or(text)))?;
            if number > 0 {
                return Ok(number);
            }
        }
    }

    /// Keeps messages in flight for this time; returns rate and quantiles in milliseconds. None may be lost or change.
    fn measure(&mut self, time: Duration) -> Result<Value> {
        let (begun, mut sent, mut times) = (Instant::now(), HashMap::new(), Vec::new());
        for _ in 0..IN_FLIGHT {
            let now = Instant::now();
            sent.insert(self.send_next()?, now);
        }
        while !sent.is_empty() {
            let number = self.receive()?;
            let since = sent.remove(&number).with_context(|| format!("message {number} came twice"))?;
            times.push(since.elapsed());
            let now = Instant::now();
            if now < begun + time {
                sent.insert(self.send_next()?, now);
            }
        }
        let rate = times.len() as f64 / begun.elapsed().as_secs_f64();
        let milliseconds = |share| quantile_seconds(&times, share) * 1e3;
        Ok(json!({
            "rate": rate, "p50": milliseconds(0.5), "p95": milliseconds(0.95), "p99": milliseconds(0.99),
        }))
    }
}

/// Returns the number of a message with this filler; `None` if it is another one.
fn parse_echo(text: &str, filler: &str) -> Option<usize> {
    let (_, data) = text.split_once("\"data\":")?;
    let (number, rest) = data.trim_start().strip_prefix('"')?.split_at_checked(DIGITS)?;
    let is_whole = rest.strip_prefix(filler).is_some_and(|end| end.starts_with('"'));
    number.parse().ok().filter(|_| is_whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_echo_is_its_number_and_all_of_its_text() {
        let echo = |data: &str| format!(r#"{{"op": "publish", "msg": {{"data": "{data}"}}, "topic": "/echo"}}"#);
        assert_eq!(parse_echo(&echo("0000000000000042xxx"), "xxx"), Some(42));
        assert_eq!(parse_echo(&echo("0000000000000042xx"), "xxx"), None);
        assert_eq!(parse_echo(&echo("0000000000000042xxxx"), "xxx"), None);
        assert_eq!(parse_echo(r#"{"op":"status","msg":"no"}"#, "xxx"), None);
    }
}
