//! A servant is ready when what its robot came for is there, not when its processes run.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use serde_json::json;
use support::Told;
use support::robot::Robot;
use support::world::world;

/// Longer than nodes are given that were told to show less.
const LONG: Duration = Duration::from_secs(7);

pub fn a_node_that_is_slow_is_waited_for_until_its_interface_is_there() -> Told {
    let models = TcpListener::bind("127.0.0.1:0")?;
    let port = models.local_addr()?.port();
    let config = format!("[allow]\negress = [\"127.0.0.1:{port}\"]\n");
    let daemon = world().own("slow").config(&config).start()?;
    // At the push it is served at once.
    std::thread::scope(|scope| {
        let serving = scope.spawn(|| models.accept()?.0.write_all(b"12"));
        daemon
            .deployer()
            .pushes(
                "slow_py",
                &[
                    "--node",
                    "slow.py",
                    "--param",
                    &format!("/port={port}"),
                    "--egress",
                    &format!("127.0.0.1:{port}"),
                ],
            )?
            .succeeded()?;
        serving.join().expect("a thread")?;
        anyhow::Ok(())
    })?;
    let url = daemon.url("slow_py?robot=patient");
    let coming = std::thread::spawn(move || Robot::connect(&url));
    let mut node = models.accept()?.0;
    node.write_all(b"1")?;
    let mut said = String::new();
    BufReader::new(node.try_clone()?).read_line(&mut said)?;
    ensure!(said == "registered\n", "{said:?}");
    // It runs, the Master knows it, and yet there is nothing for a robot.
    let began = Instant::now();
    while began.elapsed() < LONG {
        let servant = daemon.servant_of("slow_py", "patient")?;
        ensure!(
            servant["phase"] == "starting",
            "taken for ready after {:?}: {servant:#}",
            began.elapsed()
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    node.write_all(b"2")?;
    let mut robot = coming.join().expect("a thread")?;
    robot.subscribes("/answers")?;
    robot.says(json!({"op": "advertise", "topic": "/questions", "type": "std_msgs/String"}))?;
    robot.awaits_subscriber("/questions")?;
    robot.says(json!({"op": "publish", "topic": "/questions", "msg": {"data": "now"}}))?;
    ensure!(robot.hears_on("/answers")?["data"] == "you asked now");
    ensure!(daemon.servant_of("slow_py", "patient")?["phase"] == "ready");
    let events = daemon.deployer().asks(&["events"])?;
    let incomplete = events.as_array().context("events")?.iter();
    ensure!(
        incomplete
            .filter(|event| event["kind"] == "interface-incomplete")
            .count()
            == 0,
        "{events:#}"
    );
    drop(robot);
    daemon.ends()?;
    Ok(())
}
