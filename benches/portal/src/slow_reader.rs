//! A client that subscribes to pictures and does not read, while 100 MB of them are published a second: what that costs
//! another client of the same servant, and the daemon.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use bench_report::{Report, Target};
use bench_servant::{Daemon, full};

use crate::contestants::{Course, Encoding, Way};
use crate::line::Line;
use crate::node::{Credit, Node};
use crate::relay::Hops;
use crate::watch::resident;

const PICTURES: &str = "/meter/image_out";
/// Pictures of 0.92 MB per second.
const PER_SECOND: u32 = 108;

/// The same load with and without a slow reader.
pub(crate) fn measure(report: &mut Report, daemon: &Daemon, node: &Node, only: &str) -> Result<()> {
    if !"slow reader".contains(only) {
        return Ok(());
    }
    let time = Duration::from_secs(if full() { 60 } else { 8 });
    let hops = Hops {
        inward: Some("/meter/ping"),
        outward: Some("/meter/pong"),
        ..Hops::default()
    };
    let course = Course { daemon, node, hops };
    let credit = node.credit(PICTURES)?;
    eprintln!("slow reader: {} s without, {0} s with", time.as_secs());
    // A reader that reads: the same pictures cross the same hops.
    let reading = Arc::new(AtomicBool::new(true));
    let reader = subscribe(daemon)?;
    let thread = std::thread::spawn({
        let reading = reading.clone();
        move || drain(reader, &reading)
    });
    let without = under_load(&course, &credit, time)?;
    reading.store(false, Ordering::Relaxed);
    thread
        .join()
        .map_err(|_| anyhow!("the reader panicked"))??;
    let slow = subscribe(daemon)?;
    let before = resident(daemon.pid())?;
    let with = under_load(&course, &credit, time)?;
    let grown = resident(daemon.pid())? - before;
    drop(slow);
    for (at, name) in [(0, "p50"), (1, "p99")] {
        report
            .figure(
                format!("a String beside a slow reader, {name}"),
                "µs",
                with[at],
            )
            .beside("beside one that reads", without[at])
            .reach(Target::RatioAtMost(1.5));
    }
    report
        .figure("memory for a slow reader", "MB", grown)
        .reach(Target::AtMost(20.0))
        .note(format!("{} s at 100 MB/s", time.as_secs()));
    Ok(())
}

fn subscribe(daemon: &Daemon) -> Result<Line> {
    let mut line = Line::robot(daemon)?;
    line.say(&format!(
        r#"{{"op":"subscribe","topic":"{PICTURES}","type":"sensor_msgs/Image"}}"#
    ))?;
    Ok(line)
}

fn drain(mut line: Line, reading: &AtomicBool) -> Result<()> {
    while reading.load(Ordering::Relaxed) {
        line.receive()?;
    }
    Ok(())
}

/// p50 and p99 of Strings there and back, in µs, one every few milliseconds while pictures are published.
fn under_load(course: &Course<'_>, credit: &Credit, time: Duration) -> Result<[f64; 2]> {
    let mut open = course.open(Way::Daemon(Encoding::Json))?;
    let (begun, mut paid, mut times) = (Instant::now(), 0, Vec::new());
    while begun.elapsed() < time {
        let due = (begun.elapsed().as_secs_f64() * f64::from(PER_SECOND)) as u32;
        if due > paid {
            credit.pay(due - paid);
            paid = due;
        }
        let asked = Instant::now();
        open.line.send(&open.message)?;
        open.line.receive()?;
        times.push(asked.elapsed());
        std::thread::sleep(Duration::from_millis(3));
    }
    course.close(open)?;
    let part = |fraction| bench_report::quantile(&times, fraction);
    Ok(
        [0.5, 0.99]
            .map(|fraction| part(fraction).map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)),
    )
}
