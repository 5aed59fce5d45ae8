//! Independent software for ROS 2 against a servant of ROS 2: rosbridge clients, Foxglove's client, readers of
//! recordings.

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

use crate::access::{create_token, daemon};
use crate::{clients, recordings, viewers};

/// Returns the URL path for a robot, with a token.
fn robot_address(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let scope = ["--role", "robot", "--service", HERALD.name, "--robot"];
    let secret = create_token(daemon, &[&[robot], &scope[..], &[robot]].concat())?;
    Ok(format!("{}?token={secret}", HERALD.name))
}

/// Interval between publications.
const PAUSE: Duration = Duration::from_millis(50);
/// Type of the square.
const SQUARE: &str = "geometry_msgs/msg/PolygonStamped";

/// Returns a message of the square.
fn square(header: &Value) -> Value {
    let points = [[0.0, 0.0], [1.5, 0.0], [1.5, 1.5], [0.0, 1.5]];
    let points = points.map(|[x, y]| json!({"x": x, "y": y, "z": 0.0}));
    json!({"header": header, "polygon": {"points": points}})
}

/// Runs `does` while the robot publishes its name and a square periodically.
fn run_while_publishing(robot: &mut Robot, does: impl FnOnce() -> Verdict) -> Verdict {
    for (topic, of) in [("/name", "std_msgs/msg/String"), ("/square", SQUARE)] {
        robot.send(json!({"op": "advertise", "topic": topic, "type": of}))?;
    }
    let square = square(&json!({"frame_id": "floor"}));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let crying = scope.spawn(|| {
            let says = |topic: &str, msg: &Value| json!({"op": "publish", "topic": topic, "msg": msg});
            while !over.load(Ordering::Relaxed) {
                robot.send(says("/name", &json!({"data": "rover"})))?;
                robot.send(says("/square", &square))?;
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

/// Checks that nodes and clients with incompatible quality of service are told so, with that of both sides.
fn expect_differences_reported(robot: &mut Robot) -> Verdict {
    robot.send(json!({"op": "advertise", "topic": "/name", "type": "std_msgs/msg/String",
        "qos": {"reliability": "best_effort"}}))?;
    let told = robot.wait_for_status("no messages pass between /herald and this client")?;
    let told = told["msg"].as_str().context("words")?;
    ensure!(
        told.contains("reliability: the publisher offers best_effort, the subscriber asks for reliable")
            && told.contains("(publisher: best_effort, volatile; subscriber: reliable, volatile)"),
        "{told}"
    );
    robot.send(json!({"op": "unadvertise", "topic": "/name"}))
}

/// Checks that a header as ROS 1 has it arrives without its `seq`, and that the client is told so once.
fn expect_seq_dropped(robot: &mut Robot) -> Verdict {
    robot.send(json!({"op": "set_level", "level": "warning"}))?;
    robot.send(json!({"op": "advertise", "topic": "/square", "type": SQUARE}))?;
    robot.subscribe("/square")?;
    let header = json!({"seq": 7, "stamp": {"secs": 5, "nsecs": 6}, "frame_id": "floor"});
    let square = json!({"op": "publish", "topic": "/square", "msg": square(&header)});
    let is_square = |told: &Value| told["op"] == "publish" && told["topic"] == "/square";
    for _ in 0..2 {
        let heard = robot.send_until(&square, "the square", is_square)?;
        let plain = json!({"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "floor"});
        ensure!(heard["msg"]["header"] == plain, "{heard}");
    }
    let told = robot.wait_for_status("\"seq\" of a std_msgs/msg/Header was dropped")?;
    ensure!(told["level"] == "warning", "{told}");
    let tells_again = |told: &Value| told["msg"].as_str().is_some_and(|text| text.contains("\"seq\""));
    ensure!(robot.has_not_heard(tells_again)?, "it was told twice");
    robot.send(json!({"op": "unsubscribe", "topic": "/square"}))?;
    robot.send(json!({"op": "unadvertise", "topic": "/square"}))?;
    robot.send(json!({"op": "set_level", "level": "error"}))
}

/// Records the robot's messages in both directions, reads them with the format's own reader, and replays them.
fn check_recording(daemon: &Daemon, servant: &str, robot: &mut Robot) -> Verdict {
    let place = world().directory("recordings-2")?;
    let file = place.path().join("said.mcap");
    let of = ["/name", "/square", "/greeting"];
    let mut typed = vec!["--format", "json", "record", servant, "-o", path_str(&file)];
    typed.extend(of.iter().flat_map(|topic| ["--topic", topic]));
    let duration = format!("{}s", scale_seconds(3));
    typed.extend(["--duration", &*duration]);
    let mut summary = Value::Null;
    run_while_publishing(robot, || {
        let said = daemon.deployer().run(&typed)?.expect_success()?.stdout;
        summary = serde_json::from_str(&said)?;
        Ok(())
    })?;
    let read = recordings::read_recording(&file)?;
    ensure!(read["profile"] == "ros2", "{read}");
    let topics = json!({"/greeting": "herald_msgs/msg/Greeting", "/name": "std_msgs/msg/String", "/square": SQUARE});
    ensure!(read["topics"] == topics, "{read}");
    ensure!(read["messages"] == summary["messages"], "{read} {summary}");
    let names = recordings::topic_texts(&read, "/name")?;
    ensure!(names.len() > 10 && names.iter().all(|name| name == "rover"), "{names:?}");

    // Replayed to the servant of another robot, whose node answers.
    let mut other = daemon.robot(&robot_address(daemon, "other")?)?;
    other.subscribe("/greeting")?;
    let name = json!({"op": "publish", "topic": "/name", "type": "std_msgs/msg/String", "msg": {"data": "other"}});
    let is_greeted =
        |text: &'static str| move |told: &Value| told["topic"] == "/greeting" && told["msg"]["text"] == text;
    other.send_until(&name, "a greeting", is_greeted("Hello, other"))?;
    let to = daemon.servant_of(HERALD.name, "other")?;
    let to = to["id"].as_str().context("an id")?.to_owned();
    let replay = ["replay", path_str(&file), "--to", &to, "--topic", "/name"];
    daemon.deployer().run(&replay)?.expect_success()?;
    other.wait_for("a greeting of what is replayed", is_greeted("Hello, rover"))?;
    other.leave()
}

pub fn they_find_nothing_missing() -> Verdict {
    let daemon = daemon("clients-2")?;
    daemon.deployer().push("herald_ros2", HERALD.arguments)?.expect_success()?;
    for (command, robot) in [
        (clients::roslibpy("ros2_with_roslibpy.py"), "roslibpy"),
        (clients::roslib("ros2_with_roslib.mjs"), "roslib"),
        (clients::roslibrust(), "roslibrust"),
    ] {
        let mut words = vec![daemon.url(&robot_address(&daemon, robot)?)];
        // The others have a separate program for each ROS.
        words.extend((robot == "roslibrust").then(|| "ros2".to_owned()));
        clients::run_with_servant(&daemon, command, (HERALD, robot), &words)?;
    }

    let mut rover = daemon.robot(&robot_address(&daemon, "rover")?)?;
    rover.call("/greet", json!({"name": "rover"}))?;
    let servant = daemon.servant_of(HERALD.name, "rover")?;
    let servant = servant["id"].as_str().context("an id")?.to_owned();
    expect_differences_reported(&mut rover)?;
    expect_seq_dropped(&mut rover)?;
    let olga = create_token(&daemon, &["olga", "--role", "operator"])?;
    let eve = create_token(&daemon, &["eve", "--role", "viewer", "--service", "herald"])?;
    run_while_publishing(&mut rover, || {
        for (token, part) in [(&olga, "acts"), (&eve, "looks")] {
            let url = daemon.url(&format!("foxglove/{servant}?token={token}"));
            viewers::run_foxglove("ros2_with_foxglove.cjs", &url, part)?;
        }
        Ok(())
    })?;
    check_recording(&daemon, &servant, &mut rover)?;
    daemon.stop()?;
    Ok(())
}
