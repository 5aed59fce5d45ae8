//! Images at 30 Hz between our participant and an rclpy node with its default buffers, in both directions and with both
//! reliabilities; and between that node and a robot of the portal.

use std::fmt;

use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Process, Target, is_full_run};
use serde_json::Value;

use crate::camera::{self, RATE};
use crate::lost::PictureLosses;
use crate::message::Size;
use crate::world::{BenchNetwork, BenchProgram, Transport, json_number};

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
    let words = camera::role_arguments(size, frames, reliable);
    let [width, height, count, quality] = words.each_ref().map(String::as_str);
    let (taking, sending) = (["takes", quality], ["sends", width, height, count, quality]);
    let world = BenchNetwork::new()?;
    let of_rclpy = match way {
        PicturePath::Rclpy(transport) => transport,
        _ => Transport::Stock,
    };
    let mut portal = match way {
        PicturePath::ToRobot | PicturePath::FromRobot => Some(world.start_role(&["portal", "kept"])?),
        _ => None,
    };
    let as_client = |words: &[&str]| world.start_role(&[&["client"], words].concat());
    let mut taker: BenchProgram = match way {
        PicturePath::In => world.start_role(&taking)?,
        PicturePath::ToRobot => as_client(&taking)?,
        PicturePath::Out | PicturePath::FromRobot | PicturePath::Rclpy(_) => world.start_rclpy(of_rclpy, &taking)?,
    };
    let process = portal.as_ref().map(|portal| Process::from_pid(portal.pid()));
    let before = process.as_ref().map(Process::total_processor_time);
    let mut sender: BenchProgram = match way {
        PicturePath::Out => world.start_role(&sending)?,
        PicturePath::FromRobot => as_client(&sending)?,
        PicturePath::In | PicturePath::ToRobot | PicturePath::Rclpy(_) => world.start_rclpy(of_rclpy, &sending)?,
    };
    let told = sender.answer_within(camera::transfer_timeout(frames))?;
    let took = taker.request_answer()?;
    let lost = |counts: &Value| match way {
        PicturePath::ToRobot => PictureLosses::to_robot(frames, json_number(&took, "came")?, counts),
        _ => PictureLosses::from_robot(frames, json_number(&took, "came")?, counts),
    };
    let portal = match (&mut portal, process, before) {
        (Some(program), Some(process), Some(before)) => Some(PortalUsage {
            processor: (process.total_processor_time()? - before?).as_secs_f64() * 1e3,
            peak: process.peak()?,
            lost: lost(&program.request_answer()?)?,
        }),
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
        let title = format!("{what}: processor for a frame, both sides");
        report
            .figure(title, "ms", sender + taker)
            .relative_to(peer.to_string(), sends + takes)
            .note(format!("sender {sender:.2} and taker {taker:.2}{portal}; {sends:.2} and {takes:.2}"));
        let title = format!("{what}: age when taken, p50");
        report
            .figure(title, "ms", json_number(&found.taker, "p50")?)
            .relative_to(peer.to_string(), json_number(&floor.taker, "p50")?)
            .note(format!("p99 {:.1}", json_number(&found.taker, "p99")?));
    }
    if let Some(peak) = found.peak_memory() {
        report
            .figure(format!("{what}: memory of ours, at its peak"), "MB", peak)
            .note("resident, of the whole process");
    }
    Ok(())
}
