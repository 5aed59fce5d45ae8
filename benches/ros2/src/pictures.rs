//! Images at 30 Hz between our participant and an rclpy node with its default buffers, in both directions and with both
//! reliabilities; and between that node and a robot of the portal, each of whose stages counts its losses.

use std::fmt;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Process, Target, is_full_run, quantile_seconds};
use bridge::Metrics;
use serde_json::{Value, json};

use crate::messages::{self, Size};
use crate::world::{BenchNetwork, BenchProgram, Transport, json_number};

/// Images per second.
pub(crate) const RATE: f64 = 30.0;
/// Time until both sides have discovered each other.
pub(crate) const SETTLED: Duration = Duration::from_millis(500);

/// Statistics of the received frames.
#[derive(Default)]
pub(crate) struct FrameStatistics {
    came: u32,
    reordered: u32,
    last: Option<u32>,
    ages: Vec<Duration>,
}

impl FrameStatistics {
    /// Returns the statistics in the form in which a role prints them.
    pub(crate) fn to_json(&self) -> Value {
        let milliseconds = |share| quantile_seconds(&self.ages, share) * 1e3;
        json!({
            "came": self.came, "reordered": self.reordered, "p50": milliseconds(0.5), "p99": milliseconds(0.99),
        })
    }

    /// Records an image; returns `None` if the payload is not one.
    pub(crate) fn record(&mut self, payload: &[u8]) -> Option<()> {
        let (number, age) = messages::parse_picture(payload)?;
        self.came += 1;
        self.reordered += u32::from(self.last.is_some_and(|last| number <= last));
        self.last = self.last.max(Some(number));
        self.ages.push(age);
        Some(())
    }
}

/// Returns the portal's counters of the images that it has passed on.
pub(crate) fn metrics_json(metrics: &Metrics) -> Value {
    json!({
        "read": metrics.published.get(), "written_off": metrics.node_dropped.get(),
        "heard": metrics.received.get(), "bus": metrics.bus_dropped.get(), "queue": metrics.dropped.get(),
    })
}

/// Images that did not reach the next stage.
#[derive(Debug, PartialEq, Eq)]
struct PictureLosses {
    /// Losses of the portal itself.
    portal: i64,
    places: Vec<(&'static str, i64)>,
}

impl PictureLosses {
    /// Computes the losses of `sent` images that a node wrote and of which a robot received `came`.
    fn to_robot(sent: u32, came: i64, counts: &Value) -> Option<Self> {
        let [heard, bus, queue] = ["heard", "bus", "queue"].map(|name| counts[name].as_i64());
        let (heard, bus, queue) = (heard?, bus?, queue?);
        let places = vec![
            ("the node's writer or the way to the portal", i64::from(sent) - heard - bus),
            ("the bus's queue", bus),
            ("the robot's queue in the portal", queue),
            ("the robot", heard - queue - came),
        ];
        Some(Self { portal: bus + queue, places })
    }

    /// Computes the losses of `sent` images that a robot sent and of which a node received `came`. A node that keeps
    /// the last five may acknowledge an image and then replace it by a newer one: such a loss is the node's.
    fn from_robot(sent: u32, came: i64, counts: &Value) -> Option<Self> {
        let (read, written_off) = (counts["read"].as_i64()?, counts["written_off"].as_i64()?);
        let places = vec![
            ("the robot", i64::from(sent) - read),
            ("the portal's writer, which the node did not follow", written_off),
            ("the node", read - written_off - came),
        ];
        Some(Self { portal: written_off, places })
    }
}

impl fmt::Display for PictureLosses {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lost = self.places.iter().filter(|(_, count)| *count != 0);
        let lost: Vec<String> = lost.map(|(place, count)| format!("{count} by {place}")).collect();
        if lost.is_empty() { out.write_str("none lost anywhere") } else { write!(out, "lost: {}", lost.join(", ")) }
    }
}

/// Sender and receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PicturePath {
    In,
    Out,
    /// From a node to a robot.
    ToRobot,
    /// From a robot to a node.
    FromRobot,
    Rclpy(Transport),
}

impl fmt::Display for PicturePath {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::In => out.write_str("rclpy to ours"),
            Self::Out => out.write_str("ours to rclpy"),
            Self::ToRobot => out.write_str("rclpy through the portal to a robot"),
            Self::FromRobot => out.write_str("robot through the portal to rclpy"),
            Self::Rclpy(transport) => write!(out, "rclpy to rclpy by {transport}"),
        }
    }
}

/// Program at one end of a transfer.
#[derive(Clone, Copy)]
enum Peer {
    Ours,
    /// A client of the portal.
    Robot,
    Rclpy(Transport),
}

impl PicturePath {
    /// Returns the sender and the receiver.
    fn peers(self) -> (Peer, Peer) {
        let stock = Peer::Rclpy(Transport::Stock);
        match self {
            Self::In => (stock, Peer::Ours),
            Self::Out => (Peer::Ours, stock),
            Self::ToRobot => (stock, Peer::Robot),
            Self::FromRobot => (Peer::Robot, stock),
            Self::Rclpy(transport) => (Peer::Rclpy(transport), Peer::Rclpy(transport)),
        }
    }
}

/// Results of both sides of a transfer.
struct TransferResult {
    sent: u32,
    sender: Value,
    taker: Value,
    /// The portal between both sides.
    portal: Option<PortalUsage>,
}

/// Resources of a portal after a transfer.
struct PortalUsage {
    /// Processor time in milliseconds.
    processor: f64,
    /// Peak memory.
    peak: f64,
    /// Lost images, by stage.
    lost: PictureLosses,
}

impl TransferResult {
    fn lost_count(&self) -> Result<f64> {
        Ok(f64::from(self.sent) - json_number(&self.taker, "came")?)
    }

    /// Returns the processor time per frame of sender and receiver, in milliseconds; the portal's takes the place of
    /// its robot's.
    fn processor_per_frame(&self) -> Result<[f64; 2]> {
        let of = |side: &Value| match (&side["processor"], &self.portal) {
            (Value::Null, Some(portal)) => anyhow::Ok(portal.processor),
            _ => json_number(side, "processor"),
        };
        let each = |side| anyhow::Ok(of(side)? / f64::from(self.sent));
        Ok([each(&self.sender)?, each(&self.taker)?])
    }

    /// Returns the peak memory of our process, if one took part.
    fn peak_memory(&self) -> Option<f64> {
        let of = |side: &Value| side["peak"].as_f64();
        let portal = self.portal.as_ref().map(|portal| portal.peak);
        portal.or_else(|| of(&self.sender)).or_else(|| of(&self.taker))
    }

    /// Returns whether enough images arrived to compare the resources.
    fn is_comparable(&self) -> Result<bool> {
        Ok(self.lost_count()? < f64::from(self.sent) / 10.0)
    }
}

fn run_transfer(way: PicturePath, size: Size, reliable: bool, seconds: u32) -> Result<TransferResult> {
    let frames = seconds * RATE as u32;
    let [width, height, count] = [size.width, size.height, frames].map(|number| number.to_string());
    let quality = if reliable { "1" } else { "0" };
    let world = BenchNetwork::new()?;
    let start = |kind: Peer, words: &[&str]| match kind {
        Peer::Ours => world.start_role(words),
        Peer::Robot => world.start_role(&[&["client"], words].concat()),
        Peer::Rclpy(transport) => world.start_rclpy(transport, words),
    };
    let (sends, takes) = way.peers();
    let mut portal = match way {
        PicturePath::ToRobot | PicturePath::FromRobot => Some(world.start_role(&["portal", "kept"])?),
        _ => None,
    };
    let mut taker = start(takes, &["takes", quality])?;
    let process = portal.as_ref().map(|portal: &BenchProgram| Process::from_pid(portal.pid()));
    let before = process.as_ref().map(Process::total_processor_time).transpose()?.unwrap_or_default();
    let mut sender = start(sends, &["sends", &width, &height, &count, quality])?;
    let patience = Duration::from_secs_f64(f64::from(frames) / RATE * 1.5) + Duration::from_secs(30);
    let told = sender.answer_within(patience)?;
    let took = taker.request_answer()?;
    let portal = match (&mut portal, process) {
        (Some(program), Some(process)) => {
            let (counts, came) = (program.request_answer()?, json_number(&took, "came")? as i64);
            let lost = match way {
                PicturePath::ToRobot => PictureLosses::to_robot(frames, came, &counts),
                _ => PictureLosses::from_robot(frames, came, &counts),
            };
            Some(PortalUsage {
                processor: (process.total_processor_time()? - before).as_secs_f64() * 1e3,
                peak: process.peak()?,
                lost: lost.with_context(|| format!("a counter is missing: {counts}"))?,
            })
        }
        _ => None,
    };
    Ok(TransferResult { sent: frames, sender: told, taker: took, portal })
}

/// Returns the duration in seconds of reliable transfers and of the others.
fn transfer_seconds() -> Result<(u32, u32)> {
    let brief = if is_full_run() { 60 } else { 20 };
    match std::env::var("CLOUDROID_BENCH_SECONDS") {
        Ok(all) => all.parse().map(|all| (all, all)).context("CLOUDROID_BENCH_SECONDS is no number of seconds"),
        Err(_) => Ok((60, brief)),
    }
}

/// Measures all transfers; reliable ones, which must not lose images, run for a minute.
pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let (long, brief) = transfer_seconds()?;
    let mut failed = Vec::new();
    for size in [Size::SMALL, Size::LARGE] {
        for reliable in [true, false] {
            let seconds = if reliable { long } else { brief };
            let quality = if reliable { "reliable" } else { "best effort" };
            let what = format!("{:.1} MB pictures, {quality}", f64::from(size.byte_count()) / 1e6);
            let peers = [Transport::Stock, Transport::Udp].map(PicturePath::Rclpy);
            let mut floors = Vec::new();
            for peer in peers {
                eprintln!("{what}, {peer}: {brief} s");
                match run_transfer(peer, size, reliable, brief) {
                    Ok(found) => floors.push((peer, found)),
                    // The other peers are measured all the same.
                    Err(why) => report.skip(format!("{what}, {peer}"), format!("{why:#}")),
                }
            }
            let robots = [PicturePath::FromRobot, PicturePath::ToRobot].into_iter().filter(|_| reliable);
            for way in [PicturePath::Out, PicturePath::In].into_iter().chain(robots) {
                eprintln!("{what}, {way}: {seconds} s");
                let of = format!("{what}, {way}");
                let told = run_transfer(way, size, reliable, seconds)
                    .and_then(|found| report_transfer(report, &of, &found, &floors));
                if let Err(why) = told {
                    report.skip(&of, format!("{why:#}"));
                    failed.push(of);
                }
            }
        }
    }
    ensure!(failed.is_empty(), "not to the end: {}", failed.join("; "));
    Ok(())
}

fn report_transfer(
    report: &mut BenchReport,
    what: &str,
    found: &TransferResult,
    floors: &[(PicturePath, TransferResult)],
) -> Result<()> {
    let mut note = format!("of {}, {} late to be sent", found.sent, found.sender["late"]);
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
        note += &format!("; {peer} lost {} of {}", floor.lost_count()?, floor.sent);
    }
    report.figure(format!("{what}: lost"), "", found.lost_count()?).require(Target::AtMost(0.0)).note(note);
    if let Some(portal) = &found.portal {
        let title = format!("{what}: lost by the portal");
        report.figure(title, "", portal.lost.portal as f64).require(Target::AtMost(0.0));
    }
    let title = format!("{what}: reordered");
    report.figure(title, "", json_number(&found.taker, "reordered")?).require(Target::AtMost(0.0));
    for (peer, floor) in floors {
        if !floor.is_comparable()? {
            continue;
        }
        let ([sender, taker], [sends, takes]) = (found.processor_per_frame()?, floor.processor_per_frame()?);
        let figure = report.figure(format!("{what}: processor for a frame, both sides"), "ms", sender + taker);
        figure.relative_to(peer.to_string(), sends + takes);
        figure.note(format!("sender {sender:.2} and taker {taker:.2}{portal}; {sends:.2} and {takes:.2}"));
        let figure = report.figure(format!("{what}: age when taken, p50"), "ms", json_number(&found.taker, "p50")?);
        figure.relative_to(peer.to_string(), json_number(&floor.taker, "p50")?);
        figure.note(format!("p99 {:.1}", json_number(&found.taker, "p99")?));
    }
    if let Some(peak) = found.peak_memory() {
        let figure = report.figure(format!("{what}: memory of ours, at its peak"), "MB", peak);
        figure.note("resident, of the whole process");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_after_a_later_one_is_out_of_order() {
        let mut seen = FrameStatistics::default();
        for number in [0, 1, 3, 2, 4] {
            seen.record(&messages::picture(number, Size { width: 2, height: 2 })).expect("a picture");
        }
        assert_eq!((seen.came, seen.reordered), (5, 1));
        assert!(seen.record(b"no picture").is_none());
    }

    #[test]
    fn each_loss_is_its_places() {
        let counts = json!({"read": 98, "written_off": 3, "heard": 97, "bus": 1, "queue": 10});
        let lost = PictureLosses::to_robot(100, 85, &counts).expect("counts");
        let places = "2 by the node's writer or the way to the portal, 1 by the bus's queue, 10 by the robot's queue \
                      in the portal, 2 by the robot";
        assert_eq!((lost.portal, lost.to_string()), (11, format!("lost: {places}")));
        let lost = PictureLosses::from_robot(100, 91, &counts).expect("counts");
        let places = "2 by the robot, 3 by the portal's writer, which the node did not follow, 4 by the node";
        assert_eq!((lost.portal, lost.to_string()), (3, format!("lost: {places}")));
        let whole = json!({"heard": 5, "bus": 0, "queue": 0});
        let lost = PictureLosses::to_robot(5, 5, &whole).expect("counts");
        assert_eq!(lost.to_string(), "none lost anywhere");
    }
}
