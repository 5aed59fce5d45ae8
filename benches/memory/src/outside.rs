//! Attacks that robots can make.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::time::Duration;

use anyhow::{Context, Result};
use rosbridge::{Format, Writer};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};

const MESSAGES: usize = 20;
const MESSAGE: usize = 63_000_000;
const TRIALS: usize = 4;
const TRIAL: usize = 330_000_000;
const READERS: usize = 20;

/// Runs `work` in `count` threads at once; returns the results of those that succeed.
fn run_concurrently<T: Send>(count: usize, work: impl Fn() -> Result<T> + Sync) -> Vec<T> {
    std::thread::scope(|scope| {
        let all: Vec<_> = (0..count).map(|_| scope.spawn(&work)).collect();
        let all = all.into_iter().filter_map(|one| one.join().ok());
        all.filter_map(Result::ok).collect()
    })
}

/// Starts messages that never end.
pub(crate) fn hold_unfinished_messages(daemon: &Daemon) -> Result<String> {
    // Makes sure that the servant is running.
    daemon.robot("adder_py?robot=greedy")?.call("/rosapi/get_time", json!({}))?;
    let held = run_concurrently(MESSAGES, || {
        let mut robot = daemon.robot("adder_py?robot=greedy")?;
        let frame = Frame::message(vec![7; MESSAGE], OpCode::Data(Data::Binary), false);
        robot.send_frame(Message::Frame(frame))?;
        // Either refused or still open.
        let closed = robot.next_frame_within(Duration::from_secs(2));
        Ok((closed, robot))
    });
    let open = held.iter().filter(|(heard, _)| heard.is_err()).count();
    Ok(format!("{} of {MESSAGES} were refused", MESSAGES - open))
}

/// Starts request bodies that never end.
pub(crate) fn hold_unfinished_trials(daemon: &Daemon) -> Result<String> {
    let held = run_concurrently(TRIALS, || {
        // Uses the daemon's socket, because only operators and the owner of a service may start a trial.
        let mut stream = UnixStream::connect(daemon.home.join("run/daemon.sock"))?;
        stream.set_write_timeout(Some(Duration::from_secs(60)))?;
        let head = format!(
            "POST /api/v1/services/adder_py/trial?kind=bag HTTP/1.1\r\nHost: {}\r\nContent-Length: {}\r\n\r\n",
            daemon.address,
            TRIAL + 1
        );
        stream.write_all(head.as_bytes())?;
        let chunk = vec![7; 1 << 20];
        for _ in 0..TRIAL >> 20 {
            stream.write_all(&chunk)?;
        }
        Ok(stream)
    });
    Ok(format!("{} of {TRIALS} were refused", TRIALS - held.len()))
}

/// Publishes a std_msgs/Int8MultiArray of `elements` elements in ROS serialization.
fn publish_array(robot: &mut Robot, topic: &str, elements: usize, element: i8) -> Result<()> {
    // An empty layout: no dimensions, no offset.
    let mut bytes = vec![0; 8];
    bytes.extend_from_slice(&u32::try_from(elements)?.to_le_bytes());
    bytes.resize(12 + elements, element as u8);
    let mut out = Vec::new();
    let mut writer = Writer::op(&mut out, Format::Cbor, "publish", None);
    writer.text("topic", topic);
    writer.text("compression", "cbor-raw");
    writer.raw("msg", None, &bytes);
    writer.end();
    robot.send_frame(Message::binary(out))
}

fn advertise_array(robot: &mut Robot, topic: &str) -> Result<()> {
    let message_type = "std_msgs/Int8MultiArray";
    robot.send(json!({"op": "advertise", "topic": topic, "type": message_type}))?;
    robot.call("/rosapi/topic_type", json!({"topic": topic}))?;
    Ok(())
}

/// Subscribes in JSON to a message that becomes too long in this encoding.
pub(crate) fn subscribe_to_oversized_json(daemon: &Daemon) -> Result<String> {
    let mut publisher = daemon.robot("adder_py?robot=victim")?;
    let mut reader = daemon.robot("adder_py?robot=victim")?;
    advertise_array(&mut publisher, "/big")?;
    reader.subscribe("/big")?;
    reader.call("/rosapi/get_time", json!({}))?;
    publish_array(&mut publisher, "/big", 60_000_000, -100)?;
    let heard = reader.wait_for("what became of it", |heard| heard["op"] == "publish" || heard["op"] == "status")?;
    Ok(match heard["op"].as_str() {
        Some("status") => "it was left out, with a status".to_owned(),
        _ => "it came".to_owned(),
    })
}

/// Subscribes and sends requests on many connections, and never reads.
pub(crate) fn leave_messages_unread(daemon: &Daemon) -> Result<String> {
    let mut publisher = daemon.robot("adder_py?robot=victim")?;
    advertise_array(&mut publisher, "/unread")?;
    let value = Value::from("x".repeat(5_000_000)).to_string();
    let set = publisher.call("/rosapi/set_param", json!({"name": "/unread", "value": value}))?;
    anyhow::ensure!(set["result"] == true, "{set}");
    let url = daemon.url("adder_py?robot=victim");
    let mut slow = Vec::new();
    for _ in 0..READERS {
        let mut robot = Robot::connect_with_small_buffer(&url, &[])?;
        robot.subscribe("/unread")?;
        robot.call("/rosapi/get_time", json!({}))?;
        slow.push(robot);
    }
    // The publisher is the same client: once its memory budget is used up, its next message is refused.
    let published = (0..10)
        .take_while(|_| {
            publish_array(&mut publisher, "/unread", 4_000_000, -100).is_ok()
                && publisher.call("/rosapi/get_time", json!({})).is_ok()
        })
        .count();
    for robot in &mut slow {
        for _ in 0..10 {
            let call = json!({"op": "call_service", "service": "/rosapi/get_param", "args": {"name": "/unread"}});
            // Some of the connections have been closed by now.
            let _ = robot.send(call);
        }
    }
    std::thread::sleep(Duration::from_secs(3));
    let (_, metrics) = daemon.get("/metrics")?;
    let held = metrics.lines().find_map(|line| line.strip_prefix("cloudroid_memory_bytes{what=\"held\"}"));
    let held: f64 = held.context("what is held is told")?.trim().parse()?;
    Ok(format!("{published} of 10 messages were taken, {:.0} MB were counted in the end", held / 1e6))
}
