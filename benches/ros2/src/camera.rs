//! The roles that send pictures and take them.

use std::time::{Duration, Instant};

use anyhow::Result;
use rtps::Sample;
use serde_json::{Value, json};
use tokio::sync::mpsc::UnboundedReceiver;

use crate::ends::{join, matched, quality, reads, writes};
use crate::message::{self, IMAGE, Size};
use crate::process::Process;
use crate::roles::{say, until_asked};

const PICTURES: (&str, &str) = ("rt/pictures", IMAGE);
/// As often each second.
pub(crate) const RATE: f64 = 30.0;
/// Both sides know of each other after that.
pub(crate) const SETTLED: Duration = Duration::from_millis(500);

/// `sends WIDTH HEIGHT FRAMES RELIABLE`: what it took of the processor, and how many frames were late.
pub(crate) async fn sends(words: &[&str]) -> Result<()> {
    let [width, height, frames, reliable] = words else {
        anyhow::bail!("it takes width, height, frames, reliable");
    };
    let size = Size {
        width: width.parse()?,
        height: height.parse()?,
    };
    let frames: u32 = frames.parse()?;
    let participant = join().await?;
    let writer = writes(&participant, PICTURES, quality(*reliable == "1"));
    say(&json!({}));
    matched(writer.ends()).await?;
    tokio::time::sleep(SETTLED).await;
    let this = Process::this();
    let (before, mut due, mut late) = (this.processor("")?, Instant::now(), 0);
    for number in 0..frames {
        writer.write(message::picture(number, size));
        due += Duration::from_secs_f64(1.0 / RATE);
        late += u32::from(Instant::now() > due);
        tokio::time::sleep_until(due.into()).await;
    }
    // What is still being sent again.
    tokio::time::sleep(Duration::from_secs(2)).await;
    let spent = (this.processor("")? - before).as_secs_f64() * 1e3;
    say(&json!({
        "processor": spent, "late": late, "dropped": writer.dropped(), "peak": this.peak()?,
    }));
    until_asked().await.map(drop)
}

/// `takes RELIABLE`: what came, when asked.
pub(crate) async fn takes(words: &[&str]) -> Result<()> {
    let participant = join().await?;
    let (_reader, mut samples) = reads(&participant, PICTURES, quality(words == ["1"]));
    let this = Process::this();
    let before = this.processor("")?;
    say(&json!({}));
    let mut seen = Seen::default();
    tokio::select! {
        () = seen.watch(&mut samples) => {}
        asked = until_asked() => drop(asked?),
    }
    let spent = (this.processor("")? - before).as_secs_f64() * 1e3;
    let mut told = seen.told();
    told["processor"] = spent.into();
    told["peak"] = this.peak()?.into();
    told["after"] = this.resident()?.into();
    say(&told);
    Ok(())
}

/// What has come.
#[derive(Default)]
pub(crate) struct Seen {
    came: u32,
    reordered: u32,
    last: Option<u32>,
    ages: Vec<Duration>,
}

impl Seen {
    async fn watch(&mut self, samples: &mut UnboundedReceiver<Sample>) {
        while let Some(sample) = samples.recv().await {
            if self.take(&sample.payload).is_none() {
                eprintln!("a sample of {} bytes is no picture", sample.payload.len());
            }
        }
    }

    /// As an answer to whoever asks.
    pub(crate) fn told(&self) -> Value {
        let milliseconds = |share| {
            let age = bench_report::quantile(&self.ages, share);
            age.map_or(f64::NAN, |age| age.as_secs_f64() * 1e3)
        };
        json!({
            "came": self.came, "reordered": self.reordered, "p50": milliseconds(0.5), "p99": milliseconds(0.99),
        })
    }

    /// Counts a picture; none where it is no picture.
    pub(crate) fn take(&mut self, payload: &[u8]) -> Option<()> {
        let (number, age) = message::of_picture(payload)?;
        self.came += 1;
        self.reordered += u32::from(self.last.is_some_and(|last| number <= last));
        self.last = self.last.max(Some(number));
        self.ages.push(age);
        Some(())
    }
}

/// Widths, heights and frames as words for either side's role.
pub(crate) fn words(size: Size, frames: u32, reliable: bool) -> [String; 4] {
    let reliable = u8::from(reliable).to_string();
    [
        size.width.to_string(),
        size.height.to_string(),
        frames.to_string(),
        reliable,
    ]
}

/// So many frames take so long, and what is sent again.
pub(crate) fn patience(frames: u32) -> Duration {
    Duration::from_secs_f64(f64::from(frames) / RATE * 1.5) + Duration::from_secs(30)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_after_a_later_one_is_out_of_order() {
        let mut seen = Seen::default();
        for number in [0, 1, 3, 2, 4] {
            seen.take(&message::picture(
                number,
                Size {
                    width: 2,
                    height: 2,
                },
            ))
            .expect("a picture");
        }
        assert_eq!((seen.came, seen.reordered), (5, 1));
        assert!(seen.take(b"no picture").is_none());
    }
}
