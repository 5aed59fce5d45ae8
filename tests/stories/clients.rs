//! Independent rosbridge clients against a real servant: topics, services in both directions, actions, parameters,
//! time, and the end of a servant.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use support::daemon::Daemon;
use support::deployer::path_str;
use support::patience::tell_patience;
use support::world::{FIXTURE, StoryService, world};
use support::{Verdict, binaries};

use crate::access::{create_token, daemon};

/// Programs of the clients.
const ROSLIBPY: &str = "with_roslibpy.py";
const ROSLIB: &str = "with_roslib.cjs";

pub fn roslibpy_finds_nothing_missing() -> Verdict {
    run_client(roslibpy(ROSLIBPY), "roslibpy")
}

pub fn roslib_finds_nothing_missing() -> Verdict {
    run_client(roslib(ROSLIB), "roslib")
}

pub fn roslibrust_finds_nothing_missing() -> Verdict {
    run_client(roslibrust(), "roslibrust")
}

pub fn clients_with_tokens_find_nothing_missing() -> Verdict {
    let daemon = daemon("clients")?;
    let package = package_path(FIXTURE)?;
    let push = [&["push", package.as_str()], FIXTURE.arguments].concat();
    daemon.deployer().run(&push)?.expect_success()?;
    for (command, name) in [(roslibpy(ROSLIBPY), "roslibpy"), (roslib(ROSLIB), "roslib"), (roslibrust(), "roslibrust")]
    {
        let scope = ["--role", "robot", "--service", FIXTURE.name, "--robot"];
        let token = create_token(&daemon, &[&[name], &scope[..], &[name]].concat())?;
        let path = format!("{}?token={token}", FIXTURE.name);
        run_with_servant(&daemon, command, (FIXTURE, name), &[daemon.url(&path)])?;
    }
    Ok(())
}

pub fn what_a_node_that_is_well_prints_is_in_its_log_at_once() -> Verdict {
    let daemon = world().daemon_with(FIXTURE)?;
    let _robot = daemon.robot(&format!("{}?robot=reader", FIXTURE.name))?;
    let id = daemon.servant_of(FIXTURE.name, "reader")?["id"].clone();
    let id = id.as_str().context("an id")?;
    support::wait_until("a line of ROS_INFO", || {
        let log = daemon.deployer().run(&["logs", id])?.expect_success()?;
        Ok(if log.stdout.contains("the fixture is ready") { Ok(()) } else { Err(log.output()) })
    })
}

pub fn the_first_five_minutes_of_the_readme_end_well() -> Verdict {
    let daemon = world().ensure_shared()?;
    let checkout = binaries::checkout();
    daemon.deployer().run(&["push", path_str(&checkout.join("examples/shout"))])?.expect_success()?;
    let readme = std::fs::read_to_string(checkout.join("README.md"))?;
    let (_, program) = readme.split_once("```python\n").context("a program")?;
    let (program, _) = program.split_once("```").context("its end")?;
    let address = daemon.url("shout?robot=r2");
    let stated = "ws://127.0.0.1:9090/shout?robot=r2";
    ensure!(program.contains(stated) && program.lines().filter(|line| !line.is_empty()).count() <= 10, "{program}");
    let mut robot = Command::new(binaries::python())
        .args(["-c", &program.replace(stated, &address)])
        .stdout(Stdio::piped())
        .spawn()?;
    let said = robot.stdout.take().context("its standard output")?;
    let first = BufReader::new(said).lines().next();
    robot.kill()?;
    robot.wait()?;
    ensure!(first.context("it said nothing")?? == "HELLO");
    Ok(())
}

/// Returns the directory of a service's package.
fn package_path(service: StoryService) -> anyhow::Result<String> {
    let package = binaries::package(service.package.context("a package of the repository")?);
    Ok(path_str(&package).to_owned())
}

pub fn roslibpy(name: &str) -> Command {
    let mut command = Command::new(binaries::python());
    command.arg(program_path(name));
    command
}

pub fn roslib(name: &str) -> Command {
    let mut command = Command::new("node");
    command.arg(program_path(name));
    command.env("NODE_PATH", binaries::node_modules());
    command
}

pub fn roslibrust() -> Command {
    Command::new(binaries::path("robot-with-roslibrust"))
}

fn program_path(name: &str) -> PathBuf {
    binaries::checkout().join("tests/robots").join(name)
}

/// Runs the program of a client for a robot of this name.
fn run_client(command: Command, robot: &str) -> Verdict {
    let daemon = world().daemon_with(FIXTURE)?;
    let path = format!("{}?robot={robot}", FIXTURE.name);
    run_with_servant(&daemon, command, (FIXTURE, robot), &[daemon.url(&path)])
}

/// Runs the program of a client with these arguments; when it asks for that, stops the robot's servant.
pub fn run_with_servant(
    daemon: &Daemon,
    mut command: Command,
    (service, robot): (StoryService, &str),
    words: &[String],
) -> Verdict {
    let mut child = tell_patience(&mut command)
        .args(words)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .with_context(|| format!("{command:?}"))?;
    let mut said = Vec::new();
    for line in BufReader::new(child.stdout.take().context("piped")?).lines() {
        let line = line?;
        if line == "end my servant" {
            let servant = daemon.servant_of(service.name, robot)?;
            let id = servant["id"].as_str().context("an id")?;
            daemon.deployer().run(&["stop", id])?.expect_success()?;
        }
        said.push(line);
    }
    let status = child.wait()?;
    ensure!(
        status.success() && said.last().is_some_and(|line| line == "done"),
        "{robot} ended with {status} after {said:?}; the daemon said:\n{}",
        daemon.log_tail()
    );
    Ok(())
}
