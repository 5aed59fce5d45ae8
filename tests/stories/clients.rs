//! Clients of rosbridge that others wrote, against a real servant: topics, services both ways, actions, parameters, time,
//! and a servant that ends under them.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use support::world::{FIXTURE, world};
use support::{Verdict, binaries};

pub fn roslibpy_finds_nothing_missing() -> Verdict {
    let mut command = Command::new(binaries::python());
    command.arg(program("with_roslibpy.py"));
    finds_nothing_missing(command, "roslibpy")
}

pub fn roslib_finds_nothing_missing() -> Verdict {
    let mut command = Command::new("node");
    command.arg(program("with_roslib.cjs"));
    command.env("NODE_PATH", binaries::node_modules());
    finds_nothing_missing(command, "roslib")
}

pub fn roslibrust_finds_nothing_missing() -> Verdict {
    finds_nothing_missing(
        Command::new(binaries::path("robot-with-roslibrust")),
        "roslibrust",
    )
}

fn program(name: &str) -> PathBuf {
    binaries::checkout().join("tests/robots").join(name)
}

/// Runs a client's program for a robot of this name; when the program asks for it, ends the robot's servant.
fn finds_nothing_missing(mut command: Command, robot: &str) -> Verdict {
    let daemon = world().with(FIXTURE)?;
    let mut child = command
        .arg(daemon.url(&format!("{}?robot={robot}", FIXTURE.name)))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .with_context(|| format!("{command:?}"))?;
    let mut said = Vec::new();
    for line in BufReader::new(child.stdout.take().context("piped")?).lines() {
        let line = line?;
        if line == "end my servant" {
            let servant = daemon.servant_of(FIXTURE.name, robot)?;
            let id = servant["id"].as_str().context("an id")?;
            daemon.deployer().types(&["stop", id])?.succeeded()?;
        }
        said.push(line);
    }
    let status = child.wait()?;
    ensure!(
        status.success() && said.last().is_some_and(|line| line == "done"),
        "{robot} ended with {status} after {said:?}; the daemon said:\n{}",
        daemon.last_words()
    );
    Ok(())
}
