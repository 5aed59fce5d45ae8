//! What robots can do.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::time::Duration;

use anyhow::{Context, Result};
use rosbridge::{Compression, Format, Op, Payload, Publish, Writer};
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

/// Does it from so many threads at once; those that end well.
fn at_once<T: Send>(count: usize, work: impl Fn() -> Result<T> + Sync) -> Vec<T> {
    std::thread::scope(|scope| {
        let all: Vec<_> = (0..count).map(|_| scope.spawn(&work)).collect();
        let all = all.into_iter().filter_map(|one| one.join().ok());
        all.filter_map(Result::ok).collect()
    })
}

/// Begins messages that do not end.
pub(crate) fn messages(daemon: &Daemon) -> Result<String> {
    // Its servant is there.
    daemon
        .robot("adder_py?robot=greedy")?
        .calls("/rosapi/get_time", json!({}))?;
    let held = at_once(MESSAGES, || {
        let mut robot = daemon.robot("adder_py?robot=greedy")?;
        let frame = Frame::message(vec![7; MESSAGE], OpCode::Data(Data::Binary), false);
        robot.sends(Message::Frame(frame))?;
        // Refused, or not.
        let closed = robot.frame_within(Duration::from_secs(2));
        Ok((closed, robot))
    });
    let open = held.iter().filter(|(heard, _)| heard.is_err()).count();
    Ok(format!("{} of {MESSAGES} were refused", MESSAGES - open))
}

/// Begins bodies that do not end.
pub(crate) fn trials(daemon: &Daemon) -> Result<String> {
    let held = at_once(TRIALS, || {
        // At the daemon's socket: a service is tried by its operators and its owner.
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

/// Publishes a std_msgs/Int8MultiArray of so many elements, as ROS bytes.
fn publish(robot: &mut Robot, topic: &str, elements: usize, element: i8) -> Result<()> {
    // An empty layout: no dimensions, no offset.
    let mut bytes = vec![0; 8];
    bytes.extend_from_slice(&u32::try_from(elements)?.to_le_bytes());
    bytes.resize(12 + elements, element as u8);
    let mut message = Vec::new();
    let mut writer = Writer::new(&mut message, Format::Cbor);
    writer.bytes("bytes", &bytes);
    writer.end();
    let op = Op::from(Publish {
        id: None,
        topic: topic.into(),
        msg: Payload::cbor(&message),
        compression: Compression::CborRaw,
        latch: false,
        type_name: None,
        qos: None,
    });
    let mut out = Vec::new();
    op.print(&mut out, Format::Cbor);
    robot.sends(Message::binary(out))
}

fn advertise(robot: &mut Robot, topic: &str) -> Result<()> {
    let message_type = "std_msgs/Int8MultiArray";
    robot.says(json!({"op": "advertise", "topic": topic, "type": message_type}))?;
    robot.calls("/rosapi/topic_type", json!({"topic": topic}))?;
    Ok(())
}

/// Subscribes as JSON to a message that becomes too long.
pub(crate) fn json(daemon: &Daemon) -> Result<String> {
    let mut publisher = daemon.robot("adder_py?robot=victim")?;
    let mut reader = daemon.robot("adder_py?robot=victim")?;
    advertise(&mut publisher, "/big")?;
    reader.subscribes("/big")?;
    reader.calls("/rosapi/get_time", json!({}))?;
    publish(&mut publisher, "/big", 60_000_000, -100)?;
    let heard = reader.hears("what became of it", |heard| {
        heard["op"] == "publish" || heard["op"] == "status"
    })?;
    Ok(match heard["op"].as_str() {
        Some("status") => "it was left out, with a status".to_owned(),
        _ => "it came".to_owned(),
    })
}

/// Subscribes and asks from many connections, and does not read.
pub(crate) fn unread(daemon: &Daemon) -> Result<String> {
    let mut publisher = daemon.robot("adder_py?robot=victim")?;
    advertise(&mut publisher, "/unread")?;
    let value = Value::from("x".repeat(5_000_000)).to_string();
    let set = publisher.calls(
        "/rosapi/set_param",
        json!({"name": "/unread", "value": value}),
    )?;
    anyhow::ensure!(set["result"] == true, "{set}");
    let url = daemon.url("adder_py?robot=victim");
    let mut slow = Vec::new();
    for _ in 0..READERS {
        let mut robot = Robot::on_a_short_line(&url, &[])?;
        robot.subscribes("/unread")?;
        robot.calls("/rosapi/get_time", json!({}))?;
        slow.push(robot);
    }
    // The publisher is of the same client: where its memory is used up by then, its next message is refused.
    let published = (0..10)
        .take_while(|_| {
            publish(&mut publisher, "/unread", 4_000_000, -100).is_ok()
                && publisher.calls("/rosapi/get_time", json!({})).is_ok()
        })
        .count();
    for robot in &mut slow {
        for _ in 0..10 {
            let call = json!({"op": "call_service", "service": "/rosapi/get_param", "args": {"name": "/unread"}});
            // Some are closed by now.
            let _ = robot.says(call);
        }
    }
    std::thread::sleep(Duration::from_secs(3));
    let (_, metrics) = daemon.get("/metrics")?;
    let held = metrics
        .lines()
        .find_map(|line| line.strip_prefix("cloudroid_memory_bytes{what=\"held\"}"));
    let held: f64 = held.context("what is held is told")?.trim().parse()?;
    Ok(format!(
        "{published} of 10 messages were taken, {:.0} MB were counted in the end",
        held / 1e6
    ))
}
