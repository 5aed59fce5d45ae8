//! A client that never reads while 100 MB of images are published per second: its effect on another and on the daemon.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use bench_report::{BenchDaemon, BenchReport, Process, Target, is_full_run, quantile_seconds};

use crate::contestants::{ClientPath, Encoding, PathTarget};
use crate::line::BenchConnection;
use crate::node::{MeterNode, PublishCredit};
use crate::relay::RelayHops;

const PICTURES: &str = "/meter/image_out";
/// Images per second, 0.92 MB each.
const PER_SECOND: u32 = 108;

/// Measures the same load with and without a slow reader.
pub(crate) fn measure(report: &mut BenchReport, daemon: &BenchDaemon, node: &MeterNode, only: &str) -> Result<()> {
    if !"slow reader".contains(only) {
        return Ok(());
    }
    let time = Duration::from_secs(if is_full_run() { 60 } else { 8 });
    let hops = RelayHops { inward: Some("/meter/ping"), outward: Some("/meter/pong"), ..RelayHops::default() };
    let course = PathTarget { daemon, node, hops };
    let credit = node.credit(PICTURES)?;
    eprintln!("slow reader: {} s without, {0} s with", time.as_secs());
    // A reader that does read, so that the same images cross the same hops.
    let reading = Arc::new(AtomicBool::new(true));
    let reader = subscribe_to_pictures(daemon)?;
    let thread = std::thread::spawn({
        let reading = reading.clone();
        move || drain(reader, &reading)
    });
    let without = measure_under_load(&course, &credit, time)?;
    reading.store(false, Ordering::Relaxed);
    thread.join().map_err(|_| anyhow!("the reader panicked"))??;
    let slow = subscribe_to_pictures(daemon)?;
    let process = Process::from_pid(daemon.pid());
    let before = process.resident()?;
    let with = measure_under_load(&course, &credit, time)?;
    let grown = process.resident()? - before;
    drop(slow);
    for (at, name) in [(0, "p50"), (1, "p99")] {
        let figure = report.figure(format!("a String beside a slow reader, {name}"), "µs", with[at]);
        figure.relative_to("beside one that reads", without[at]).require(Target::RatioAtMost(1.5));
    }
    let figure = report.figure("memory for a slow reader", "MB", grown).require(Target::AtMost(20.0));
    figure.note(format!("{} s at 100 MB/s", time.as_secs()));
    Ok(())
}

fn subscribe_to_pictures(daemon: &BenchDaemon) -> Result<BenchConnection> {
    let mut line = BenchConnection::connect_robot(daemon)?;
    line.send_text(&format!(r#"{{"op":"subscribe","topic":"{PICTURES}","type":"sensor_msgs/Image"}}"#))?;
    Ok(line)
}

fn drain(mut line: BenchConnection, reading: &AtomicBool) -> Result<()> {
    while reading.load(Ordering::Relaxed) {
        line.receive_messages()?;
    }
    Ok(())
}

/// Returns p50 and p99 in µs of Strings that go there and back while images are published.
fn measure_under_load(course: &PathTarget<'_>, credit: &PublishCredit, time: Duration) -> Result<[f64; 2]> {
    let mut open = course.open(ClientPath::Daemon(Encoding::Json))?;
    let (begun, mut paid, mut times) = (Instant::now(), 0, Vec::new());
    while begun.elapsed() < time {
        let due = (begun.elapsed().as_secs_f64() * f64::from(PER_SECOND)) as u32;
        if due > paid {
            credit.grant(due - paid);
            paid = due;
        }
        let asked = Instant::now();
        open.line.send(&open.message)?;
        open.line.receive_messages()?;
        times.push(asked.elapsed());
        std::thread::sleep(Duration::from_millis(3));
    }
    course.close(open)?;
    Ok([0.5, 0.99].map(|fraction| quantile_seconds(&times, fraction) * 1e6))
}
