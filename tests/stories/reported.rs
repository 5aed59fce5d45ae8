//! Failures of rosbridge_suite that its users reported in 2026: memory that grows with every client and with JSON in
//! binary frames, deadlocks and races where many clients subscribe, leave or come at once, and a crash by a package
//! that nobody has.

use std::sync::Barrier;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, ScopedJoinHandle};

use anyhow::{Context, anyhow, ensure};
use ros::bus::RosVersion;
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;
use support::twins::Twin;
use support::world::world;
use support::{Verdict, procfs};
use tokio_tungstenite::tungstenite::{Bytes, Message};

const TOPIC: &str = "/chatter";
/// Clients that subscribe at the same time, and clients that publish.
const SUBSCRIBERS: usize = 8;
const PUBLISHERS: usize = 2;
/// Number of times that each of them subscribes in one pass.
const ROUNDS: usize = 60;
/// Passes after the first one, in which caches are filled.
const PASSES: usize = 2;
/// Allocated memory in kB by which two moments may differ: a few kB for each client of the later passes.
const SLACK: u64 = 8 << 10;

fn subscription() -> Value {
    json!({"op": "subscribe", "topic": TOPIC, "type": "std_msgs/String"})
}

fn advertisement() -> Value {
    json!({"op": "advertise", "topic": TOPIC, "type": "std_msgs/String"})
}

fn publication(text: &str) -> Value {
    json!({"op": "publish", "topic": TOPIC, "msg": {"data": text}})
}

fn join_client(client: ScopedJoinHandle<'_, Verdict>) -> Verdict {
    client.join().map_err(|_| anyhow!("a client panicked"))?
}

/// Subscribes, hears something and goes, in one of three ways, again and again.
fn subscribe_repeatedly(daemon: &Daemon, path: &str, number: usize) -> Verdict {
    for round in 0..ROUNDS {
        let mut robot = daemon.robot(path)?;
        robot.send(subscription())?;
        robot.next_message_on(TOPIC)?;
        match (number + round) % 3 {
            0 => {
                robot.send(json!({"op": "unsubscribe", "topic": TOPIC}))?;
                robot.leave()?;
            }
            1 => robot.leave()?,
            _ => drop(robot),
        }
    }
    Ok(())
}

/// Comes, publishes and goes until the pass is over.
fn publish_repeatedly(daemon: &Daemon, path: &str, is_over: &AtomicBool) -> Verdict {
    while !is_over.load(Ordering::Relaxed) {
        let mut robot = daemon.robot(path)?;
        robot.send(advertisement())?;
        for _ in 0..20 {
            robot.send(publication("hello"))?;
            robot.call("/rosapi/get_time", json!({}))?;
        }
        robot.leave()?;
    }
    Ok(())
}

/// Has all clients come and go, and waits until nothing of them is left in the graph.
fn make_pass(daemon: &Daemon, path: &str) -> Verdict {
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        let publishers: Vec<_> =
            (0..PUBLISHERS).map(|_| scope.spawn(|| publish_repeatedly(daemon, path, &is_over))).collect();
        let subscribers: Vec<_> =
            (0..SUBSCRIBERS).map(|number| scope.spawn(move || subscribe_repeatedly(daemon, path, number))).collect();
        let heard = subscribers.into_iter().try_for_each(join_client);
        is_over.store(true, Ordering::Relaxed);
        let published = publishers.into_iter().try_for_each(join_client);
        heard.and(published)
    })?;
    let mut robot = daemon.robot(path)?;
    support::wait_until("a graph without the topic", || {
        let answer = robot.call("/rosapi/topics", json!({}))?;
        let topics = answer["values"]["topics"].as_array().context("topics")?;
        Ok((!topics.contains(&json!(TOPIC))).then_some(()).ok_or_else(|| answer.to_string()))
    })?;
    robot.leave()
}

/// Returns the memory in kB that a process has allocated.
fn allocated_memory(pid: i32) -> anyhow::Result<u64> {
    let status = procfs::status(pid).context("the daemon is gone")?;
    let memory = status.get("RssAnon").and_then(|memory| memory.split_whitespace().next()).context("RssAnon")?;
    Ok(memory.parse()?)
}

fn count_descriptors(pid: i32) -> anyhow::Result<usize> {
    Ok(std::fs::read_dir(format!("/proc/{pid}/fd"))?.count())
}

pub fn clients_that_subscribe_and_leave_at_once_leave_nothing(ros: RosVersion) -> Verdict {
    let twin = Twin::adder(ros);
    let daemon = world().setup(&format!("reported-{}", ros.number())).start()?;
    twin.service.push_to(&daemon)?;
    let path = format!("{}?robot=crowd", twin.service.name);
    make_pass(&daemon, &path)?;
    let (memory, descriptors) = (allocated_memory(daemon.pid())?, count_descriptors(daemon.pid())?);
    for _ in 0..PASSES {
        make_pass(&daemon, &path)?;
    }
    // Freed memory is returned to the kernel a while later.
    support::wait_until("the memory and the descriptors of before", || {
        let now = (allocated_memory(daemon.pid())?, count_descriptors(daemon.pid())?);
        let is_back = now.0 <= memory + SLACK && now.1 <= descriptors + PUBLISHERS + SUBSCRIBERS;
        let grown = || format!("{now:?} kB and descriptors after {:?}", (memory, descriptors));
        Ok(is_back.then_some(()).ok_or_else(grown))
    })?;
    daemon.stop()?;
    Ok(())
}

/// Types whose definitions the clients ask for, each of them first.
const TYPES: [&str; 4] = ["std_msgs/String", "std_msgs/Header", "std_msgs/ColorRGBA", "std_msgs/Float64MultiArray"];

/// Connects with all others, and expects an answer and its own words.
fn come_with_others(daemon: &Daemon, path: &str, number: usize, all: &Barrier) -> Verdict {
    all.wait();
    let mut robot = daemon.robot(path)?;
    robot.send(subscription())?;
    robot.send(advertisement())?;
    let details = robot.call("/rosapi/message_details", json!({"type": TYPES[number % TYPES.len()]}))?;
    ensure!(details["result"] == true, "{details}");
    let own = format!("client {number}");
    robot.send_until(&publication(&own), "its own words", |heard| heard["msg"]["data"] == own.as_str())?;
    robot.leave()
}

pub fn clients_that_come_at_once_are_all_answered(ros: RosVersion) -> Verdict {
    let twin = Twin::adder(ros);
    let daemon = world().daemon_with(twin.service)?;
    let robot = twin.robot_name("hurry");
    let path = format!("{}?robot={robot}", twin.service.name);
    // Nobody has started their servant.
    let all = Barrier::new(4 * TYPES.len());
    thread::scope(|scope| {
        let clients: Vec<_> = (0..4 * TYPES.len())
            .map(|number| {
                let (daemon, path, all) = (&*daemon, &path, &all);
                scope.spawn(move || come_with_others(daemon, path, number, all))
            })
            .collect();
        clients.into_iter().try_for_each(join_client)
    })?;
    let servants = daemon.servants_of(twin.service.name)?;
    let count = servants.iter().filter(|servant| servant["robot"] == robot.as_str()).count();
    ensure!(count == 1, "{servants:?}");
    Ok(())
}

/// Operations that name a package which does not exist.
fn unknown_packages() -> Vec<Value> {
    let mut all = vec![
        json!({"op": "subscribe", "topic": "/nothing", "type": "no_such_msgs/Thing"}),
        json!({"op": "advertise", "topic": "/nothing", "type": "no_such_msgs/Thing"}),
        json!({"op": "publish", "topic": "/nothing_else", "type": "no_such_msgs/Thing", "msg": {}}),
        json!({"op": "advertise_service", "service": "/nothing", "type": "no_such_msgs/Ask"}),
        json!({"op": "advertise_action", "action": "/nothing", "type": "no_such_msgs/Do"}),
        json!({"op": "send_action_goal", "action": "/nothing", "action_type": "no_such_msgs/Do", "args": {}}),
        json!({"op": "call_service", "service": "/add_two", "type": "no_such_msgs/Ask", "args": {"nothing": 1}}),
    ];
    for (service, name) in [
        ("message_details", "no_such_msgs/Thing"),
        ("service_request_details", "no_such_msgs/Ask"),
        ("service_response_details", "no_such_msgs/Ask"),
        ("action_goal_details", "no_such_msgs/Do"),
        ("action_result_details", "no_such_msgs/Do"),
        ("action_feedback_details", "no_such_msgs/action/Do"),
    ] {
        let service = format!("/rosapi/{service}");
        all.push(json!({"op": "call_service", "service": service, "args": {"type": name}}));
    }
    all
}

/// Sends an operation, and expects a refusal that names the package.
fn expect_refusal(robot: &mut Robot, operation: &Value) -> Verdict {
    robot.send(operation.clone())?;
    let what = format!("the refusal of {operation}");
    let told = robot.wait_for(&what, |told| {
        let is_error = told["level"] == "error" || told["result"] == false;
        is_error && told.to_string().contains("no_such_msgs")
    })?;
    let expected = match operation["op"].as_str() {
        Some("call_service") => "service_response",
        Some("send_action_goal") => "action_result",
        _ => "status",
    };
    ensure!(told["op"] == expected, "{operation} was answered by {told}");
    Ok(())
}

pub fn a_package_that_nobody_has_is_told_to_who_names_it_alone(ros: RosVersion) -> Verdict {
    let twin = Twin::adder(ros);
    let daemon = world().daemon_with(twin.service)?;
    let path = format!("{}?robot={}", twin.service.name, twin.robot_name("mistaken"));
    let mut other = daemon.robot(&path)?;
    other.send(subscription())?;
    other.send(advertisement())?;
    let mut robot = daemon.robot(&path)?;
    for (number, operation) in unknown_packages().iter().enumerate() {
        expect_refusal(&mut robot, operation)?;
        let provided = robot.call("/rosapi/service_type", json!({"service": "/add_two"}))?;
        ensure!(provided["values"]["type"] != "", "{provided}");
        let text = format!("after {number}");
        other.send_until(&publication(&text), "its own words", |heard| heard["msg"]["data"] == text.as_str())?;
    }
    robot.leave()?;
    other.leave()
}

pub fn json_in_binary_frames_is_read_as_it_comes(ros: RosVersion) -> Verdict {
    let twin = Twin::adder(ros);
    let daemon = world().daemon_with(twin.service)?;
    let path = format!("{}?robot={}", twin.service.name, twin.robot_name("binary"));
    let mut hearer = daemon.robot(&path)?;
    hearer.send(subscription())?;
    hearer.call("/rosapi/get_time", json!({}))?;
    let mut speaker = daemon.robot(&path)?;
    let mut send = |operation: Value| speaker.send_frame(Message::Binary(Bytes::from(operation.to_string())));
    send(advertisement())?;
    // Many braces, in which rosbridge_suite sought the message, and its queue grew.
    let braces = "{}".repeat(300);
    let text = |number: usize| format!("{number} {braces}");
    for number in 0..200 {
        send(publication(&text(number)))?;
    }
    for number in 0..200 {
        ensure!(hearer.next_message_on(TOPIC)?["data"] == text(number).as_str(), "message {number} is missing");
    }
    speaker.leave()?;
    hearer.leave()
}
