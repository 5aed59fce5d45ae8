//! Limits for what a servant writes, which protect others.

use anyhow::{Context, ensure};
use support::Verdict;
use support::burglar::try_attempt;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::{BURGLAR, world};

/// Starts a daemon with the burglar, whose servants may write little.
fn start_daemon(name: &str, quotas: &str) -> anyhow::Result<Daemon> {
    let setup = world().setup(name).config(&format!("[servant]\n{quotas}\n"));
    let daemon = setup.start()?;
    let package = BURGLAR.package.context("a package")?;
    daemon.deployer().push(package, BURGLAR.arguments)?.expect_success()?;
    Ok(daemon)
}

/// Returns the amount written, and the kernel's error at the limit.
fn written_amount(robot: &mut Robot, what: &str, where_: &str) -> anyhow::Result<(u64, String)> {
    let attempt = try_attempt(robot, what, where_)?;
    ensure!(attempt.succeeded, "{what} {where_}: {}", attempt.report);
    let (count, why) = attempt.report.split_once(' ').context("a count")?;
    Ok((count.parse()?, why.to_owned()))
}

pub fn what_a_servant_may_not_write_is_refused_to_it_alone() -> Verdict {
    let daemon = start_daemon("scratch", "scratch = \"8M\"\ninodes = 500")?;
    let mut greedy = daemon.robot("burglar_cpp?robot=greedy")?;
    let mut modest = daemon.robot("burglar_cpp?robot=modest")?;
    for place in ["/tmp", "/var/tmp", "/root", "/dev/shm"] {
        let (files, why) = written_amount(&mut greedy, "crowd", place)?;
        ensure!((100..500).contains(&files), "{files} files in {place}");
        ensure!(why == "No space left on device", "{place}: {why}");
    }
    let mut filler = daemon.robot("burglar_cpp?robot=filler")?;
    for place in ["/tmp", "/var/tmp", "/root", "/dev/shm"] {
        let (bytes, why) = written_amount(&mut filler, "fill", place)?;
        ensure!((4 << 20..=8 << 20).contains(&bytes), "{bytes} bytes in {place}");
        ensure!(why == "No space left on device", "{place}: {why}");
    }
    // The space of others is not affected.
    for place in ["/tmp", "/root"] {
        let written = try_attempt(&mut modest, "write", &format!("{place}/mine text"))?;
        ensure!(written.succeeded, "{place}: {}", written.report);
    }
    // A robot whose write was refused continues to work.
    ensure!(try_attempt(&mut filler, "environment", "HOME")?.succeeded);
    Ok(())
}

pub fn a_node_that_shouts_costs_no_disk() -> Verdict {
    let daemon = start_daemon("shouts", "log_rate = \"64K\"")?;
    let mut robot = daemon.robot("burglar_cpp?robot=loud")?;
    try_attempt(&mut robot, "shout", "48")?;
    let id = daemon.servant_of("burglar_cpp", "loud")?["id"].clone();
    let id = id.as_str().context("an id")?;
    let directory = daemon.home.join("servants").join(id);
    // The rate limit eventually admits a line again, preceded by a note on the omitted ones.
    let text = support::wait_until("word of what was left out", || {
        try_attempt(&mut robot, "shout", "1")?;
        let text = std::fs::read_to_string(directory.join("log.jsonl"))?;
        Ok(if text.contains("log_rate") { Ok(text) } else { Err(format!("{} bytes without it", text.len())) })
    })?;
    // Ten seconds' worth plus the current rate: far less than was printed, which would have rotated the log.
    ensure!(text.len() < 16 << 20, "{} bytes", text.len());
    let rotated = directory.join("log.jsonl.1").exists();
    ensure!(!rotated, "so much was written that the log was rotated");
    let told = daemon.deployer().run(&["logs", id])?.expect_success()?;
    ensure!(told.output().contains("are not in this log"), "the deployer is not told");
    Ok(())
}
