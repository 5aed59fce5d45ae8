//! What a servant writes is bounded, and costs nobody else.

use anyhow::{Context, ensure};
use support::Verdict;
use support::burglar::tries;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::{BURGLAR, world};

/// A daemon with the burglar, whose servants may write little.
fn daemon(name: &str, quotas: &str) -> anyhow::Result<Daemon> {
    let setup = world().own(name).config(&format!("[servant]\n{quotas}\n"));
    let daemon = setup.start()?;
    let package = BURGLAR.package.context("a package")?;
    daemon
        .deployer()
        .pushes(package, BURGLAR.arguments)?
        .succeeded()?;
    Ok(daemon)
}

/// How much it got, and the kernel's words when it got no more.
fn got(robot: &mut Robot, what: &str, where_: &str) -> anyhow::Result<(u64, String)> {
    let attempt = tries(robot, what, where_)?;
    ensure!(attempt.succeeded, "{what} {where_}: {}", attempt.report);
    let (count, why) = attempt.report.split_once(' ').context("a count")?;
    Ok((count.parse()?, why.to_owned()))
}

pub fn what_a_servant_may_not_write_is_refused_to_it_alone() -> Verdict {
    let daemon = daemon("scratch", "scratch = \"8M\"\ninodes = 500")?;
    let mut greedy = daemon.robot("burglar_cpp?robot=greedy")?;
    let mut modest = daemon.robot("burglar_cpp?robot=modest")?;
    for place in ["/tmp", "/var/tmp", "/root", "/dev/shm"] {
        let (files, why) = got(&mut greedy, "crowd", place)?;
        ensure!((100..500).contains(&files), "{files} files in {place}");
        ensure!(why == "No space left on device", "{place}: {why}");
    }
    let mut filler = daemon.robot("burglar_cpp?robot=filler")?;
    for place in ["/tmp", "/var/tmp", "/root", "/dev/shm"] {
        let (bytes, why) = got(&mut filler, "fill", place)?;
        ensure!(
            (4 << 20..=8 << 20).contains(&bytes),
            "{bytes} bytes in {place}"
        );
        ensure!(why == "No space left on device", "{place}: {why}");
    }
    // Nobody else has less for it.
    for place in ["/tmp", "/root"] {
        let written = tries(&mut modest, "write", &format!("{place}/mine text"))?;
        ensure!(written.succeeded, "{place}: {}", written.report);
    }
    // Who was refused goes on.
    ensure!(tries(&mut filler, "environment", "HOME")?.succeeded);
    Ok(())
}

pub fn a_node_that_shouts_costs_no_disk() -> Verdict {
    let daemon = daemon("shouts", "log_rate = \"64K\"")?;
    let mut robot = daemon.robot("burglar_cpp?robot=loud")?;
    tries(&mut robot, "shout", "48")?;
    let id = daemon.servant_of("burglar_cpp", "loud")?["id"].clone();
    let id = id.as_str().context("an id")?;
    let directory = daemon.home.join("servants").join(id);
    // What has come together of the rate lets a line through, which is preceded by what was left out.
    let text = support::until("word of what was left out", || {
        tries(&mut robot, "shout", "1")?;
        let text = std::fs::read_to_string(directory.join("log.jsonl"))?;
        Ok(match text.contains("log_rate") {
            true => Ok(text),
            false => Err(format!("{} bytes without it", text.len())),
        })
    })?;
    // Ten seconds' worth, and what came meanwhile: never near what was shouted, which would have been rotated.
    ensure!(text.len() < 16 << 20, "{} bytes", text.len());
    let rotated = directory.join("log.jsonl.1").exists();
    ensure!(!rotated, "so much was written that the log was rotated");
    let told = daemon.deployer().types(&["logs", id])?.succeeded()?;
    ensure!(
        told.said().contains("are not in this log"),
        "the deployer is not told"
    );
    Ok(())
}
