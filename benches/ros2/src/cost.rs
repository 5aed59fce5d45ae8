//! Resources of a participant: memory, descriptors, and processor time while idle.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchReport, Process, Target, is_full_run};

use crate::world::{BenchNetwork, BenchProgram, Transport, json_number};

/// Limit for the memory of a servant beyond its nodes, in megabytes.
const MEMORY: f64 = 8.0;
/// Limit for the processor time while idle, in percent of a core.
const IDLE: f64 = 0.1;
/// Time until discovery has finished.
const SETTLED: Duration = Duration::from_secs(5);

/// Measures one participant next to an rclpy node, then many next to nodes of our own.
pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    measure_one(report)?;
    measure_many(report)
}

/// Returns the processor time of a process in percent of a core, over `time`.
fn core_share(program: &BenchProgram, time: Duration) -> Result<f64> {
    let process = Process::from_pid(program.pid());
    let (before, begun) = (process.live_thread_time("")?, Instant::now());
    std::thread::sleep(time);
    let spent = process.live_thread_time("")?.checked_sub(before).context("a thread has ended")?;
    Ok(spent.as_secs_f64() / begun.elapsed().as_secs_f64() * 100.0)
}

fn measure_one(report: &mut BenchReport) -> Result<()> {
    let time = Duration::from_secs(if is_full_run() { 120 } else { 30 });
    eprintln!("a participant at rest, for {} s", time.as_secs());
    let world = BenchNetwork::new()?;
    let node = world.start_rclpy(Transport::Udp, &["relay"])?;
    let mut ours = world.start_role(&["rests"])?;
    std::thread::sleep(SETTLED);
    let idle = core_share(&ours, time)?;
    let found = ours.request_answer()?;
    // Over another period of the same length, the node's own share; it receives as much as we do.
    let theirs = core_share(&node, time)?;
    let title = "a participant at rest beside a node of rclpy";
    report
        .figure(title, "% of a core", idle)
        .relative_to("that node", theirs)
        .require(Target::AtMost(IDLE))
        .note(format!("over {} s", time.as_secs()));
    let resident = Process::from_pid(node.pid()).resident()?;
    let title = "memory of that participant";
    report
        .figure(title, "MB", json_number(&found, "memory")?)
        .relative_to("that node", resident)
        .require(Target::AtMost(MEMORY))
        .note(format!("resident, beyond its process without it; {:.1} with it", json_number(&found, "process")?));
    let title = "descriptors of that participant";
    report
        .figure(title, "", json_number(&found, "descriptors")?)
        .relative_to("that node", Process::from_pid(node.pid()).descriptors()? as f64)
        .note(format!("and {} threads", json_number(&found, "threads")?));
    Ok(())
}

/// Kinds of crowds: the role, its name in figures, and a note.
const CROWDS: [(&str, &str, &str); 2] = [
    ("participants", "participants", "each in a namespace with a node of our making"),
    (
        "servants",
        "servants, each with bus, bridge and a robot's session",
        "each in a namespace with a node of our making; the robots' ends of the sessions are in the same process, and \
         not in the time",
    ),
];

fn measure_many(report: &mut BenchReport) -> Result<()> {
    let (count, seconds) = (50, if is_full_run() { 120 } else { 30 });
    for (role, what, note) in CROWDS {
        eprintln!("{count} {role} at rest, for {seconds} s");
        let world = BenchNetwork::new()?;
        let mut crowd = world.start_role(&["crowd", role, &count.to_string(), &seconds.to_string()])?;
        let found = crowd.answer_within(Duration::from_secs(seconds + 60))?;
        let title = format!("each of {count} {what}, at rest");
        report
            .figure(title, "% of a core", json_number(&found, "share")?)
            .require(Target::AtMost(IDLE))
            .note(format!("over {seconds} s, {note}"));
        let title = format!("memory of each of {count} {what}");
        report.figure(title, "MB", json_number(&found, "memory")?).require(Target::AtMost(MEMORY)).note(format!(
            "resident; {:.1} descriptors each, {} threads in all",
            json_number(&found, "descriptors")?,
            json_number(&found, "threads")?
        ));
    }
    Ok(())
}
