//! Pictures at 30 Hz between ours and a node of rclpy with the buffers it comes with, in both directions and both reliabilities; and between that
//! node and a robot of the portal.

use std::fmt;

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use serde_json::Value;

use crate::camera::{self, RATE};
use crate::lost::Lost;
use crate::message::Size;
use crate::process::Process;
use crate::world::{Program, Transport, World, number};

/// Whose camera, and whose eye.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    In,
    Out,
    /// From a node to a robot.
    ToRobot,
    /// From a robot to a node.
    FromRobot,
    Rclpy(Transport),
}

impl fmt::Display for Way {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::In => "rclpy to ours",
            Self::Out => "ours to rclpy",
            Self::ToRobot => "rclpy through the portal to a robot",
            Self::FromRobot => "robot through the portal to rclpy",
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
    /// What was between both.
    portal: Option<Portal>,
}

/// A portal when pictures have passed it.
struct Portal {
    /// What it took of a processor, in milliseconds.
    processor: f64,
    /// The peak of its memory.
    peak: f64,
    /// Pictures that were lost, by place.
    lost: Lost,
}

impl Found {
    fn lost(&self) -> Result<f64> {
        Ok(f64::from(self.sent) - number(&self.taker, "came")?)
    }

    /// Milliseconds of a processor for a frame, of the sender and of the taker; of the portal instead of its robot.
    fn processor(&self) -> Result<[f64; 2]> {
        let of = |side: &Value| match (&side["processor"], &self.portal) {
            (Value::Null, Some(portal)) => anyhow::Ok(portal.processor),
            _ => number(side, "processor"),
        };
        let each = |side| anyhow::Ok(of(side)? / f64::from(self.sent));
        Ok([each(&self.sender)?, each(&self.taker)?])
    }

    /// The peak of our process's memory, if one was there.
    fn peak(&self) -> Option<f64> {
        let of = |side: &Value| side["peak"].as_f64();
        let portal = self.portal.as_ref().map(|portal| portal.peak);
        portal
            .or_else(|| of(&self.sender))
            .or_else(|| of(&self.taker))
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
        _ => Transport::Stock,
    };
    let mut portal = match way {
        Way::ToRobot | Way::FromRobot => Some(world.ours(&["portal", "kept"])?),
        _ => None,
    };
    let as_client = |words: &[&str]| world.ours(&[&["client"], words].concat());
    let mut taker: Program = match way {
        Way::In => world.ours(&taking)?,
        Way::ToRobot => as_client(&taking)?,
        Way::Out | Way::FromRobot | Way::Rclpy(_) => world.rclpy(of_rclpy, &taking)?,
    };
    let process = portal.as_ref().map(|portal| Process::of(portal.pid()));
    let before = process.as_ref().map(Process::processor_in_all);
    let mut sender: Program = match way {
        Way::Out => world.ours(&sending)?,
        Way::FromRobot => as_client(&sending)?,
        Way::In | Way::ToRobot | Way::Rclpy(_) => world.rclpy(of_rclpy, &sending)?,
    };
    let told = sender.answer_within(camera::patience(frames))?;
    let took = taker.tell()?;
    let lost = |counts: &Value| match way {
        Way::ToRobot => Lost::to_robot(frames, number(&took, "came")?, counts),
        _ => Lost::from_robot(frames, number(&took, "came")?, counts),
    };
    let portal = match (&mut portal, process, before) {
        (Some(program), Some(process), Some(before)) => Some(Portal {
            processor: (process.processor_in_all()? - before?).as_secs_f64() * 1e3,
            peak: process.peak()?,
            lost: lost(&program.tell()?)?,
        }),
        _ => None,
    };
    Ok(Found {
        sent: frames,
        sender: told,
        taker: took,
        portal,
    })
}

/// Seconds of what must not be lost, and of the rest.
fn lengths() -> Result<(u32, u32)> {
    let brief = if crate::full() { 60 } else { 20 };
    match std::env::var("CLOUDROID_BENCH_SECONDS") {
        Ok(all) => all
            .parse()
            .map(|all| (all, all))
            .context("CLOUDROID_BENCH_SECONDS is no number of seconds"),
        Err(_) => Ok((60, brief)),
    }
}

/// What must not be lost is watched for a minute.
pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let (long, brief) = lengths()?;
    let mut failed = Vec::new();
    for size in [Size::SMALL, Size::LARGE] {
        for reliable in [true, false] {
            let seconds = if reliable { long } else { brief };
            let quality = if reliable { "reliable" } else { "best effort" };
            let what = format!(
                "{:.1} MB pictures, {quality}",
                f64::from(size.bytes()) / 1e6
            );
            let peers = [Transport::Stock, Transport::Udp].map(Way::Rclpy);
            let mut floors = Vec::new();
            for peer in peers {
                eprintln!("{what}, {peer}: {brief} s");
                match run(peer, size, reliable, brief) {
                    Ok(found) => floors.push((peer, found)),
                    // Others are measured all the same.
                    Err(why) => report.left_out(format!("{what}, {peer}"), format!("{why:#}")),
                }
            }
            let robots = [Way::FromRobot, Way::ToRobot]
                .into_iter()
                .filter(|_| reliable);
            for way in [Way::Out, Way::In].into_iter().chain(robots) {
                eprintln!("{what}, {way}: {seconds} s");
                let of = format!("{what}, {way}");
                let told = run(way, size, reliable, seconds)
                    .and_then(|found| tell(report, &of, &found, &floors));
                if let Err(why) = told {
                    report.left_out(&of, format!("{why:#}"));
                    failed.push(of);
                }
            }
        }
    }
    ensure!(failed.is_empty(), "not to the end: {}", failed.join("; "));
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
    let portal = match &found.portal {
        Some(portal) => {
            note += &format!("; {}", portal.lost);
            ", the portal in its robot's place"
        }
        None => "",
    };
    for (peer, floor) in floors {
        note += &format!("; {peer} lost {} of {}", floor.lost()?, floor.sent);
    }
    report
        .figure(format!("{what}: lost"), "", found.lost()?)
        .reach(Target::AtMost(0.0))
        .note(note);
    if let Some(portal) = &found.portal {
        report
            .figure(
                format!("{what}: lost by the portal"),
                "",
                portal.lost.portal as f64,
            )
            .reach(Target::AtMost(0.0));
    }
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
                "sender {sender:.2} and taker {taker:.2}{portal}; {sends:.2} and {takes:.2}"
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
    if let Some(peak) = found.peak() {
        report
            .figure(format!("{what}: memory of ours, at its peak"), "MB", peak)
            .note("resident, of the whole process");
    }
    Ok(())
}
