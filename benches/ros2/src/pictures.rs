//! Pictures at 30 Hz between ours and a node of rclpy with the buffers it comes with, in both directions and both reliabilities.

use std::fmt;

use anyhow::Result;
use bench_report::{Report, Target};
use serde_json::Value;

use crate::camera::{self, RATE};
use crate::message::Size;
use crate::world::{Program, Transport, World, number};

/// Whose camera, and whose eye.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    In,
    Out,
    Rclpy(Transport),
}

impl fmt::Display for Way {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::In => "rclpy to ours",
            Self::Out => "ours to rclpy",
            Self::Rclpy(Transport::Stock) => "rclpy to rclpy by shared memory",
            Self::Rclpy(Transport::Udp) => "rclpy to rclpy by UDP",
        })
    }
}

/// What either side tells.
struct Found {
    sent: u32,
    sender: Value,
    taker: Value,
}

impl Found {
    fn lost(&self) -> Result<f64> {
        Ok(f64::from(self.sent) - number(&self.taker, "came")?)
    }

    /// Milliseconds of a processor for a frame, of the sender and of the taker.
    fn processor(&self) -> Result<[f64; 2]> {
        let of = |side| anyhow::Ok(number(side, "processor")? / f64::from(self.sent));
        Ok([of(&self.sender)?, of(&self.taker)?])
    }

    /// Whether so much came that what it took can be compared.
    fn is_peer(&self) -> Result<bool> {
        Ok(self.lost()? < f64::from(self.sent) / 10.0)
    }
}

fn run(way: Way, size: Size, reliable: bool, seconds: u32) -> Result<Found> {
    let frames = seconds * RATE as u32;
    let words = camera::words(size, frames, reliable);
    let [width, height, count, quality] = words.each_ref().map(String::as_str);
    let (taking, sending) = (["takes", quality], ["sends", width, height, count, quality]);
    let world = World::new()?;
    let of_rclpy = match way {
        Way::Rclpy(transport) => transport,
        Way::In | Way::Out => Transport::Stock,
    };
    let mut taker: Program = match way {
        Way::In => world.ours(&taking)?,
        Way::Out | Way::Rclpy(_) => world.rclpy(of_rclpy, &taking)?,
    };
    let mut sender: Program = match way {
        Way::Out => world.ours(&sending)?,
        Way::In | Way::Rclpy(_) => world.rclpy(of_rclpy, &sending)?,
    };
    let told = sender.answer_within(camera::patience(frames))?;
    Ok(Found {
        sent: frames,
        sender: told,
        taker: taker.tell()?,
    })
}

/// What must not be lost is watched for a minute.
pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let brief = if crate::full() { 60 } else { 20 };
    for size in [Size::SMALL, Size::LARGE] {
        for reliable in [true, false] {
            let seconds = if reliable { 60 } else { brief };
            let quality = if reliable { "reliable" } else { "best effort" };
            let what = format!(
                "{:.1} MB pictures, {quality}",
                f64::from(size.bytes()) / 1e6
            );
            let peers = [Transport::Stock, Transport::Udp].map(Way::Rclpy);
            let mut floors = Vec::new();
            for peer in peers {
                eprintln!("{what}, {peer}: {brief} s");
                floors.push((peer, run(peer, size, reliable, brief)?));
            }
            for way in [Way::Out, Way::In] {
                eprintln!("{what}, {way}: {seconds} s");
                let found = run(way, size, reliable, seconds)?;
                tell(report, &format!("{what}, {way}"), &found, &floors)?;
            }
        }
    }
    Ok(())
}

fn tell(report: &mut Report, what: &str, found: &Found, floors: &[(Way, Found)]) -> Result<()> {
    let mut note = format!(
        "of {}, {} late to be sent",
        found.sent, found.sender["late"]
    );
    if let Some(overflows) = found.taker["overflows"].as_u64() {
        note += &format!("; {overflows} datagrams found the buffer full");
    }
    for (peer, floor) in floors {
        note += &format!("; {peer} lost {} of {}", floor.lost()?, floor.sent);
    }
    report
        .figure(format!("{what}: lost"), "", found.lost()?)
        .reach(Target::AtMost(0.0))
        .note(note);
    report
        .figure(
            format!("{what}: reordered"),
            "",
            number(&found.taker, "reordered")?,
        )
        .reach(Target::AtMost(0.0));
    for (peer, floor) in floors {
        if !floor.is_peer()? {
            continue;
        }
        let ([sender, taker], [sends, takes]) = (found.processor()?, floor.processor()?);
        report
            .figure(
                format!("{what}: processor for a frame, both sides"),
                "ms",
                sender + taker,
            )
            .beside(peer.to_string(), sends + takes)
            .note(format!(
                "sender {sender:.2} and taker {taker:.2}; {sends:.2} and {takes:.2}"
            ));
        report
            .figure(
                format!("{what}: age when taken, p50"),
                "ms",
                number(&found.taker, "p50")?,
            )
            .beside(peer.to_string(), number(&floor.taker, "p50")?)
            .note(format!("p99 {:.1}", number(&found.taker, "p99")?));
    }
    let ours = [&found.sender, &found.taker]
        .into_iter()
        .find_map(|side| side["peak"].as_f64());
    if let Some(peak) = ours {
        report
            .figure(format!("{what}: memory of ours, at its peak"), "MB", peak)
            .note("resident, of the whole process");
    }
    Ok(())
}
