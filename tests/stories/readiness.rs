//! A servant is ready when its node has registered what its robot needs, not when its processes run.

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

/// Longer than the time given to nodes that register less than expected.
const SLOW_START: Duration = Duration::from_secs(7);

/// Starts a daemon with our slow package, whose node waits for `1` and then `2` from the returned listener.
fn start_slow(name: &str) -> anyhow::Result<(Daemon, TcpListener)> {
    let models = TcpListener::bind("127.0.0.1:0")?;
    let port = models.local_addr()?.port();
    let config = format!("[allow]\negress = [\"127.0.0.1:{port}\"]\n");
    let daemon = world().setup(name).config(&config).start()?;
    models.set_nonblocking(true)?;
    // During the push the node gets both at once.
    std::thread::scope(|scope| {
        let serving = scope.spawn(|| anyhow::Ok(accept(&models)?.write_all(b"12")?));
        daemon
            .deployer()
            .push(
                "slow_py",
                &["--node", "slow.py", "--param", &format!("/port={port}"), "--egress", &format!("127.0.0.1:{port}")],
            )?
            .expect_success()?;
        serving.join().expect("a thread")?;
        anyhow::Ok(())
    })?;
    Ok((daemon, models))
}

/// Waits for the connection of the next node.
fn accept(models: &TcpListener) -> anyhow::Result<TcpStream> {
    let node = support::wait_until("a node that fetches its model", || {
        Ok(models.accept().map(|(node, _)| node).map_err(|error| error.to_string()))
    })?;
    node.set_nonblocking(false)?;
    Ok(node)
}

/// Waits until the next node has registered and waits for its `2`.
fn wait_until_registered(models: &TcpListener) -> anyhow::Result<TcpStream> {
    let mut node = accept(models)?;
    node.write_all(b"1")?;
    let mut said = String::new();
    BufReader::new(node.try_clone()?).read_line(&mut said)?;
    ensure!(said == "registered\n", "{said:?}");
    Ok(node)
}

pub fn who_leaves_while_its_servant_starts_is_let_go_at_once() -> Verdict {
    let (daemon, models) = start_slow("leaving")?;
    let mut robot = daemon.robot("slow_py")?;
    let _node = wait_until_registered(&models)?;
    // Nothing is ready yet, but its messages are received.
    robot.send_frame(Message::Ping("are you there".into()))?;
    let pong = robot.next_frame()?;
    ensure!(pong == Message::Pong("are you there".into()), "{pong:?}");
    robot.send_frame(Message::Close(None))?;
    let closed = robot.next_frame()?;
    ensure!(closed == Message::Close(None), "{closed:?}");
    // Since the robot cannot return to its servant, the start is aborted.
    daemon.wait_for_event("a servant's end before it was ready", |event| {
        event["message"].as_str().is_some_and(|text| text.contains("its robot left before it was ready"))
    })?;

    // A robot that stays may send messages meanwhile, and they are processed in order.
    let mut robot = daemon.robot("slow_py?robot=eager")?;
    let mut node = wait_until_registered(&models)?;
    robot.send(json!({"op": "advertise", "topic": "/questions", "type": "std_msgs/String"}))?;
    robot.send(json!({"op": "subscribe", "topic": "/answers", "type": "std_msgs/String"}))?;
    robot.send(json!({"op": "publish", "topic": "/questions", "msg": {"data": "early"}}))?;
    robot.send_frame(Message::Ping("still there".into()))?;
    let pong = robot.next_frame()?;
    ensure!(pong == Message::Pong("still there".into()), "{pong:?}");
    ensure!(daemon.servant_of("slow_py", "eager")?["phase"] == "starting");
    node.write_all(b"2")?;
    ensure!(robot.next_message_on("/answers")?["data"] == "you asked early");
    drop(robot);
    daemon.stop()?;
    Ok(())
}

pub fn a_node_that_is_slow_is_waited_for_until_its_interface_is_there() -> Verdict {
    let (daemon, models) = start_slow("slow")?;
    let url = daemon.url("slow_py?robot=patient");
    let coming = std::thread::spawn(move || Robot::connect(&url));
    let mut node = wait_until_registered(&models)?;
    // The node runs and has contacted the Master, but the servant is not ready.
    let began = Instant::now();
    while began.elapsed() < SLOW_START {
        let servant = daemon.servant_of("slow_py", "patient")?;
        ensure!(servant["phase"] == "starting", "taken for ready after {:?}: {servant:#}", began.elapsed());
        std::thread::sleep(Duration::from_millis(100));
    }
    node.write_all(b"2")?;
    let mut robot = coming.join().expect("a thread")?;
    robot.subscribe("/answers")?;
    robot.send(json!({"op": "advertise", "topic": "/questions", "type": "std_msgs/String"}))?;
    robot.wait_for_subscriber("/questions")?;
    robot.send(json!({"op": "publish", "topic": "/questions", "msg": {"data": "now"}}))?;
    ensure!(robot.next_message_on("/answers")?["data"] == "you asked now");
    ensure!(daemon.servant_of("slow_py", "patient")?["phase"] == "ready");
    let events = daemon.deployer().run_json(&["events"])?;
    let incomplete = events.as_array().context("events")?.iter();
    ensure!(incomplete.filter(|event| event["kind"] == "interface-incomplete").count() == 0, "{events:#}");
    drop(robot);
    daemon.stop()?;
    Ok(())
}
