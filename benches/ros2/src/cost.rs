//! What a participant takes: memory, descriptors, and the processor while nothing happens.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{Report, Target};

use crate::process::Process;
use crate::world::{Program, Transport, World, number};

/// In megabytes: of a servant, beyond its nodes.
const MEMORY: f64 = 8.0;
/// In percent of a core.
const IDLE: f64 = 0.1;
/// Discovery is over by then.
const SETTLED: Duration = Duration::from_secs(5);

/// One beside a node of rclpy, then many beside nodes of our making.
pub(crate) fn measure(report: &mut Report) -> Result<()> {
    one(report)?;
    many(report)
}

/// The share of a core that a process takes, in percent.
fn share(program: &Program, time: Duration) -> Result<f64> {
    let process = Process::of(program.pid());
    let (before, begun) = (process.processor("")?, Instant::now());
    std::thread::sleep(time);
    let spent = process
        .processor("")?
        .checked_sub(before)
        .context("a thread has ended")?;
    Ok(spent.as_secs_f64() / begun.elapsed().as_secs_f64() * 100.0)
}

fn one(report: &mut Report) -> Result<()> {
    let time = Duration::from_secs(if crate::full() { 120 } else { 30 });
    eprintln!("a participant at rest, for {} s", time.as_secs());
    let world = World::new()?;
    let node = world.rclpy(Transport::Udp, &["relay"])?;
    let mut ours = world.ours(&["rests"])?;
    std::thread::sleep(SETTLED);
    let idle = share(&ours, time)?;
    let found = ours.tell()?;
    // The same share of the same time is the node's own, which hears as much as we do.
    let theirs = share(&node, time)?;
    report
        .figure(
            "a participant at rest beside a node of rclpy",
            "% of a core",
            idle,
        )
        .beside("that node", theirs)
        .reach(Target::AtMost(IDLE))
        .note(format!("over {} s", time.as_secs()));
    let resident = Process::of(node.pid()).resident()?;
    report
        .figure(
            "memory of that participant",
            "MB",
            number(&found, "memory")?,
        )
        .beside("that node", resident)
        .reach(Target::AtMost(MEMORY))
        .note(format!(
            "resident, beyond its process without it; {:.1} with it",
            number(&found, "process")?
        ));
    report
        .figure(
            "descriptors of that participant",
            "",
            number(&found, "descriptors")?,
        )
        .beside("that node", Process::of(node.pid()).descriptors()? as f64)
        .note(format!("and {} threads", number(&found, "threads")?));
    Ok(())
}

/// What a crowd is of, as its role and as figures call it.
const CROWDS: [(&str, &str, &str); 2] = [
    (
        "participants",
        "participants",
        "each in a namespace with a node of our making",
    ),
    (
        "servants",
        "servants, each with bus, bridge and a robot's session",
        "each in a namespace with a node of our making; the robots' ends of the sessions are in the same process, and not in the time",
    ),
];

fn many(report: &mut Report) -> Result<()> {
    let (count, seconds) = (50, if crate::full() { 120 } else { 30 });
    for (role, what, note) in CROWDS {
        eprintln!("{count} {role} at rest, for {seconds} s");
        let world = World::new()?;
        let mut crowd = world.ours(&["crowd", role, &count.to_string(), &seconds.to_string()])?;
        let found = crowd.answer_within(Duration::from_secs(seconds + 60))?;
        report
            .figure(
                format!("each of {count} {what}, at rest"),
                "% of a core",
                number(&found, "share")?,
            )
            .reach(Target::AtMost(IDLE))
            .note(format!("over {seconds} s, {note}"));
        report
            .figure(
                format!("memory of each of {count} {what}"),
                "MB",
                number(&found, "memory")?,
            )
            .reach(Target::AtMost(MEMORY))
            .note(format!(
                "resident; {:.1} descriptors each, {} threads in all",
                number(&found, "descriptors")?,
                number(&found, "threads")?
            ));
    }
    Ok(())
}
