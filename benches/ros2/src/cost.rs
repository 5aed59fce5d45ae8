//! Resources of a bus and of servants: memory, descriptors, and processor time while idle.

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

/// Servants whose resources are measured together.
const SERVANTS: u64 = 50;

/// Measures one bus next to an rclpy node, then many servants next to nodes of our own.
pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let time = Duration::from_secs(if is_full_run() { 120 } else { 30 });
    measure_one(report, time)?;
    measure_many(report, time)
}

/// Returns the processor time of a process in percent of a core, over `time`.
fn core_share(program: &BenchProgram, time: Duration) -> Result<f64> {
    let process = Process::from_pid(program.pid());
    let (before, begun) = (process.live_thread_time("")?, Instant::now());
    std::thread::sleep(time);
    let spent = process.live_thread_time("")?.checked_sub(before).context("a thread has ended")?;
    Ok(spent.as_secs_f64() / begun.elapsed().as_secs_f64() * 100.0)
}

fn measure_one(report: &mut BenchReport, time: Duration) -> Result<()> {
    eprintln!("a participant at rest, for {time:?}");
    let world = BenchNetwork::new()?;
    let node = world.start_rclpy(Transport::Udp, &["relay"])?;
    let mut ours = world.start_role(&["rests"])?;
    std::thread::sleep(SETTLED);
    let idle = core_share(&ours, time)?;
    let found = ours.request_answer()?;
    let number = |name| json_number(&found, name);
    // Over another period of the same length, the node's own share; it receives as much as we do.
    let theirs = core_share(&node, time)?;
    let figure = report.figure("a participant at rest beside a node of rclpy", "% of a core", idle);
    figure.relative_to("that node", theirs).require(Target::AtMost(IDLE)).note(format!("over {time:?}"));
    let process = Process::from_pid(node.pid());
    let figure = report.figure("memory of that participant", "MB", number("memory")?);
    figure.relative_to("that node", process.resident()?).require(Target::AtMost(MEMORY));
    figure.note(format!("resident, beyond its process without it; {:.1} with it", number("process")?));
    let figure = report.figure("descriptors of that participant", "", number("descriptors")?);
    figure.relative_to("that node", process.descriptors()? as f64);
    figure.note(format!("and {} threads", number("threads")?));
    Ok(())
}

fn measure_many(report: &mut BenchReport, time: Duration) -> Result<()> {
    let seconds = time.as_secs();
    eprintln!("{SERVANTS} servants at rest, for {seconds} s");
    let world = BenchNetwork::new()?;
    let mut crowd = world.start_role(&["crowd", &SERVANTS.to_string(), &seconds.to_string()])?;
    let found = crowd.answer_within(Duration::from_secs(seconds + 60))?;
    let number = |name| json_number(&found, name);
    let what = format!("each of {SERVANTS} servants, each with bus, bridge and a robot's session");
    let figure = report.figure(format!("{what}, at rest"), "% of a core", number("share")?);
    figure.require(Target::AtMost(IDLE)).note(format!(
        "over {seconds} s, each in a namespace with a node of our making; the robots' ends of the sessions are in the \
         same process, and not in the time"
    ));
    let figure = report.figure(format!("memory of {what}"), "MB", number("memory")?).require(Target::AtMost(MEMORY));
    let (descriptors, threads) = (number("descriptors")?, number("threads")?);
    figure.note(format!("resident; {descriptors:.1} descriptors each, {threads} threads in all"));
    Ok(())
}
