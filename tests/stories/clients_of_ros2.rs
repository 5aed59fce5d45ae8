//! What others wrote for ROS 2, against a servant of ROS 2: clients of rosbridge, Foxglove's client, readers of recordings.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::patience::scale_seconds;
use support::robot::Robot;
use support::world::{HERALD, world};

use crate::access::{daemon, token};
use crate::{clients, recordings, viewers};

/// Of a robot by its name.
fn address(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let scope = ["--role", "robot", "--service", HERALD.name, "--robot"];
    let secret = token(daemon, &[&[robot], &scope[..], &[robot]].concat())?;
    Ok(format!("{}?token={secret}", HERALD.name))
}

/// Between two cries.
const PAUSE: Duration = Duration::from_millis(50);
/// The type of what the robot shows.
const SQUARE: &str = "geometry_msgs/msg/PolygonStamped";

/// Does something while the robot says its name and shows a square, again and again.
fn while_it_cries(robot: &mut Robot, does: impl FnOnce() -> Verdict) -> Verdict {
    for (topic, of) in [("/name", "std_msgs/msg/String"), ("/square", SQUARE)] {
        robot.says(json!({"op": "advertise", "topic": topic, "type": of}))?;
    }
    let points = [[0.0, 0.0], [1.5, 0.0], [1.5, 1.5], [0.0, 1.5]];
    let points = points.map(|[x, y]| json!({"x": x, "y": y, "z": 0.0}));
    let square = json!({"header": {"frame_id": "floor"}, "polygon": {"points": points}});
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let crying = scope.spawn(|| {
            let says =
                |topic: &str, msg: &Value| json!({"op": "publish", "topic": topic, "msg": msg});
            while !over.load(Ordering::Relaxed) {
                robot.says(says("/name", &json!({"data": "rover"})))?;
                robot.says(says("/square", &square))?;
                thread::sleep(PAUSE);
            }
            anyhow::Ok(())
        });
        let verdict = does();
        over.store(true, Ordering::Relaxed);
        crying.join().expect("the robot's thread")?;
        verdict
    })
}

/// Nodes and clients that ask for different things are told so, with what both say.
fn differences_are_told(robot: &mut Robot) -> Verdict {
    robot.says(json!({"op": "advertise", "topic": "/name", "type": "std_msgs/msg/String", "qos": {"reliability": "best_effort"}}))?;
    let told = robot.hears_status("nothing passes between /herald and this client")?;
    let told = told["msg"].as_str().context("words")?;
    ensure!(
        told.contains(
            "reliability: the publisher offers best_effort, the subscriber asks for reliable"
        ) && told.contains("(publisher: best_effort, volatile; subscriber: reliable, volatile)"),
        "{told}"
    );
    robot.says(json!({"op": "unadvertise", "topic": "/name"}))
}

/// What the robot says and hears is recorded, read by the format's own reader, and replayed.
fn a_recording_is_read_and_replayed(daemon: &Daemon, servant: &str, robot: &mut Robot) -> Verdict {
    let place = world().directory("recordings-2")?;
    let file = place.path().join("said.mcap");
    let of = ["/name", "/square", "/greeting"];
    let mut typed = vec!["--format", "json", "record", servant, "-o", path_str(&file)];
    typed.extend(of.iter().flat_map(|topic| ["--topic", topic]));
    let duration = format!("{}s", scale_seconds(3));
    typed.extend(["--duration", &*duration]);
    let mut summary = Value::Null;
    while_it_cries(robot, || {
        let said = daemon.deployer().types(&typed)?.succeeded()?.stdout;
        summary = serde_json::from_str(&said)?;
        Ok(())
    })?;
    let read = recordings::reads(&file)?;
    ensure!(read["profile"] == "ros2", "{read}");
    let topics = json!({"/greeting": "herald_msgs/msg/Greeting", "/name": "std_msgs/msg/String", "/square": SQUARE});
    ensure!(read["topics"] == topics, "{read}");
    ensure!(read["messages"] == summary["messages"], "{read} {summary}");
    let names = recordings::texts(&read, "/name")?;
    ensure!(
        names.len() > 10 && names.iter().all(|name| name == "rover"),
        "{names:?}"
    );

    // Replayed to another robot's servant, its node answers.
    let mut other = daemon.robot(&address(daemon, "other")?)?;
    other.subscribes("/greeting")?;
    let name = json!({"op": "publish", "topic": "/name", "type": "std_msgs/msg/String", "msg": {"data": "other"}});
    let is_greeted = |text: &'static str| {
        move |told: &Value| told["topic"] == "/greeting" && told["msg"]["text"] == text
    };
    other.says_until(&name, "a greeting", is_greeted("Hello, other"))?;
    let to = daemon.servant_of(HERALD.name, "other")?;
    let to = to["id"].as_str().context("an id")?.to_owned();
    let replay = ["replay", path_str(&file), "--to", &to, "--topic", "/name"];
    daemon.deployer().types(&replay)?.succeeded()?;
    other.hears("a greeting of what is replayed", is_greeted("Hello, rover"))?;
    other.leaves()
}

pub fn they_find_nothing_missing() -> Verdict {
    let daemon = daemon("clients-2")?;
    daemon
        .deployer()
        .pushes("herald_ros2", HERALD.arguments)?
        .succeeded()?;
    for (command, robot) in [
        (clients::roslibpy("ros2_with_roslibpy.py"), "roslibpy"),
        (clients::roslib("ros2_with_roslib.mjs"), "roslib"),
        (clients::roslibrust(), "roslibrust"),
    ] {
        let mut words = vec![daemon.url(&address(&daemon, robot)?)];
        // The others have a program for each ROS.
        words.extend((robot == "roslibrust").then(|| "ros2".to_owned()));
        clients::does_all(&daemon, command, (HERALD, robot), &words)?;
    }

    let mut rover = daemon.robot(&address(&daemon, "rover")?)?;
    rover.calls("/greet", json!({"name": "rover"}))?;
    let servant = daemon.servant_of(HERALD.name, "rover")?;
    let servant = servant["id"].as_str().context("an id")?.to_owned();
    differences_are_told(&mut rover)?;
    let olga = token(&daemon, &["olga", "--role", "operator"])?;
    let eve = token(&daemon, &["eve", "--role", "viewer", "--service", "herald"])?;
    while_it_cries(&mut rover, || {
        for (token, part) in [(&olga, "acts"), (&eve, "looks")] {
            let url = daemon.url(&format!("foxglove/{servant}?token={token}"));
            viewers::foxglove("ros2_with_foxglove.cjs", &url, part)?;
        }
        Ok(())
    })?;
    a_recording_is_read_and_replayed(&daemon, &servant, &mut rover)?;
    daemon.ends()?;
    Ok(())
}
