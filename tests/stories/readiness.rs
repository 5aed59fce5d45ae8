//! A servant is ready when what its robot came for is there, not when its processes run.

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use serde_json::json;
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::world;
use tokio_tungstenite::tungstenite::Message;

/// Longer than nodes are given that were told to show less.
const LONG: Duration = Duration::from_secs(7);

/// A daemon with our slow package, whose node waits for `1` and then `2` from the address given back.
fn slow(name: &str) -> anyhow::Result<(Daemon, TcpListener)> {
    let models = TcpListener::bind("127.0.0.1:0")?;
    let port = models.local_addr()?.port();
    let config = format!("[allow]\negress = [\"127.0.0.1:{port}\"]\n");
    let daemon = world().own(name).config(&config).start()?;
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
    Ok((daemon, models))
}

/// Waits until the next node of it is registered, and goes on waiting for its `2`.
fn registered(models: &TcpListener) -> anyhow::Result<TcpStream> {
    let mut node = models.accept()?.0;
    node.write_all(b"1")?;
    let mut said = String::new();
    BufReader::new(node.try_clone()?).read_line(&mut said)?;
    ensure!(said == "registered\n", "{said:?}");
    Ok(node)
}

pub fn who_leaves_while_its_servant_starts_is_let_go_at_once() -> Verdict {
    let (daemon, models) = slow("leaving")?;
    let mut robot = daemon.robot("slow_py")?;
    let _node = registered(&models)?;
    // There is nothing for it yet, and it is heard all the same.
    robot.sends(Message::Ping("are you there".into()))?;
    let pong = robot.frame()?;
    ensure!(pong == Message::Pong("are you there".into()), "{pong:?}");
    robot.sends(Message::Close(None))?;
    let closed = robot.frame()?;
    ensure!(closed == Message::Close(None), "{closed:?}");
    // Nobody can come back to its servant: it is not started to its end.
    daemon.awaits_event("a servant's end before it was ready", |event| {
        event["message"]
            .as_str()
            .is_some_and(|text| text.contains("its robot left before it was ready"))
    })?;

    // Who stays may say what it wants in the meantime, and gets it in order.
    let mut robot = daemon.robot("slow_py?robot=eager")?;
    let mut node = registered(&models)?;
    robot.says(json!({"op": "advertise", "topic": "/questions", "type": "std_msgs/String"}))?;
    robot.says(json!({"op": "subscribe", "topic": "/answers", "type": "std_msgs/String"}))?;
    robot.says(json!({"op": "publish", "topic": "/questions", "msg": {"data": "early"}}))?;
    robot.sends(Message::Ping("still there".into()))?;
    let pong = robot.frame()?;
    ensure!(pong == Message::Pong("still there".into()), "{pong:?}");
    ensure!(daemon.servant_of("slow_py", "eager")?["phase"] == "starting");
    node.write_all(b"2")?;
    ensure!(robot.hears_on("/answers")?["data"] == "you asked early");
    drop(robot);
    daemon.ends()?;
    Ok(())
}

pub fn a_node_that_is_slow_is_waited_for_until_its_interface_is_there() -> Verdict {
    let (daemon, models) = slow("slow")?;
    let url = daemon.url("slow_py?robot=patient");
    let coming = std::thread::spawn(move || Robot::connect(&url));
    let mut node = registered(&models)?;
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
