//! The roles that send and receive images.

use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{Process, quantile_seconds};
use rtps::ReceivedSample;
use serde_json::{Value, json};
use tokio::sync::mpsc::UnboundedReceiver;

use crate::ends::{create_reader, create_writer, join, qos_profile, wait_until_matched};
use crate::measuring::{print_json, wait_for_request};
use crate::message::{self, IMAGE, Size};

const PICTURES: (&str, &str) = ("rt/pictures", IMAGE);
/// Images per second.
pub(crate) const RATE: f64 = 30.0;
/// Time until both sides have discovered each other.
pub(crate) const SETTLED: Duration = Duration::from_millis(500);

/// Runs the role `sends WIDTH HEIGHT FRAMES RELIABLE`; prints its processor time and how many frames were late.
pub(crate) async fn send_pictures(words: &[&str]) -> Result<()> {
    let [width, height, frames, reliable] = words else {
        anyhow::bail!("it takes width, height, frames, reliable");
    };
    let size = Size { width: width.parse()?, height: height.parse()? };
    let frames: u32 = frames.parse()?;
    let participant = join().await?;
    let writer = create_writer(&participant, PICTURES, qos_profile(*reliable == "1"));
    print_json(&json!({}));
    wait_until_matched(writer.watch_matches()).await?;
    tokio::time::sleep(SETTLED).await;
    let this = Process::current();
    let (before, mut due, mut late) = (this.live_thread_time("")?, Instant::now(), 0);
    for number in 0..frames {
        writer.write(message::picture(number, size));
        due += Duration::from_secs_f64(1.0 / RATE);
        late += u32::from(Instant::now() > due);
        tokio::time::sleep_until(due.into()).await;
    }
    // Time for retransmissions.
    tokio::time::sleep(Duration::from_secs(2)).await;
    let spent = (this.live_thread_time("")? - before).as_secs_f64() * 1e3;
    print_json(&json!({
        "processor": spent, "late": late, "dropped": writer.dropped_samples(), "peak": this.peak()?,
    }));
    wait_for_request().await.map(drop)
}

/// Runs the role `takes RELIABLE`; prints what was received when asked.
pub(crate) async fn receive_pictures(words: &[&str]) -> Result<()> {
    let participant = join().await?;
    let (_reader, mut samples) = create_reader(&participant, PICTURES, qos_profile(words == ["1"]));
    let this = Process::current();
    let before = this.live_thread_time("")?;
    print_json(&json!({}));
    let mut seen = FrameStatistics::default();
    tokio::select! {
        () = seen.watch(&mut samples) => {}
        asked = wait_for_request() => drop(asked?),
    }
    let spent = (this.live_thread_time("")? - before).as_secs_f64() * 1e3;
    let mut told = seen.to_json();
    told["processor"] = spent.into();
    told["peak"] = this.peak()?.into();
    told["after"] = this.resident()?.into();
    print_json(&told);
    Ok(())
}

/// Statistics of the received frames.
#[derive(Default)]
pub(crate) struct FrameStatistics {
    came: u32,
    reordered: u32,
    last: Option<u32>,
    ages: Vec<Duration>,
}

impl FrameStatistics {
    async fn watch(&mut self, samples: &mut UnboundedReceiver<ReceivedSample>) {
        while let Some(sample) = samples.recv().await {
            if self.record(&sample.payload).is_none() {
                eprintln!("a sample of {} bytes is no picture", sample.payload.len());
            }
        }
    }

    /// Returns the statistics in the form in which a role prints them.
    pub(crate) fn to_json(&self) -> Value {
        let milliseconds = |share| quantile_seconds(&self.ages, share) * 1e3;
        json!({
            "came": self.came, "reordered": self.reordered, "p50": milliseconds(0.5), "p99": milliseconds(0.99),
        })
    }

    /// Records an image; returns `None` if the payload is not one.
    pub(crate) fn record(&mut self, payload: &[u8]) -> Option<()> {
        let (number, age) = message::parse_picture(payload)?;
        self.came += 1;
        self.reordered += u32::from(self.last.is_some_and(|last| number <= last));
        self.last = self.last.max(Some(number));
        self.ages.push(age);
        Some(())
    }
}

/// Width, height, number of frames and reliability as arguments of the role of either side.
pub(crate) fn role_arguments(size: Size, frames: u32, reliable: bool) -> [String; 4] {
    let reliable = u8::from(reliable).to_string();
    [size.width.to_string(), size.height.to_string(), frames.to_string(), reliable]
}

/// Maximum duration of a transfer of `frames` frames, including retransmissions.
pub(crate) fn transfer_timeout(frames: u32) -> Duration {
    Duration::from_secs_f64(f64::from(frames) / RATE * 1.5) + Duration::from_secs(30)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_after_a_later_one_is_out_of_order() {
        let mut seen = FrameStatistics::default();
        for number in [0, 1, 3, 2, 4] {
            seen.record(&message::picture(number, Size { width: 2, height: 2 })).expect("a picture");
        }
        assert_eq!((seen.came, seen.reordered), (5, 1));
        assert!(seen.record(b"no picture").is_none());
    }
}
