//! An ordinary ROS node: it publishes each message of `in` on `out` with a greeting before it, and its service `~echo`
//! returns its request.
//!
//! A message `ask SERVICE` or `get PARAMETER` publishes the response of the service or the value of the parameter
//! instead. Arguments: `crash-on=TEXT` exits with status 3 when TEXT arrives; `patient` subscribes to `in` when `out`
//! has a subscriber; `keeps` also requests latched messages; `awaits=TOPIC` and `awaits-latched=TOPIC` subscribe to
//! `in` after the first message on TOPIC.
//!
//! In ROS 1 the greeting is a parameter of a sibling. With `--ros-args` it is a ROS 2 node, the greeting is a parameter
//! of its own, and there is an action `count` whose results are its goals.
//!
//! The tests of the local original use it as the original.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::JoinOptions;
use ros::bus::{
    ActionHandler, ActionServer, Bus, FailureReason, GoalEnd, GoalOutcome, ParamValue, QosProfile, RosVersion,
    ServiceHandler, ServiceType, WireType,
};
use ros::net::{HostSockets, Sockets};
use ros::ros1::names::{self, PeerUri};
use ros::schema::Registry;
use tokio::sync::mpsc;

struct Echo;

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        Ok(request)
    }
}

/// Forwards goals, to be ended later.
struct RelayGoals(mpsc::UnboundedSender<(String, Bytes)>);

impl ActionHandler for RelayGoals {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let sent = self.0.send((id.to_owned(), goal));
        sent.map_err(|error| FailureReason::new(error.to_string()))
    }
    fn on_cancel(&self, _: &str) {}
    fn on_failed(&self, reason: &str) {
        eprintln!("{reason}");
    }
}

/// An action server and the goals that it receives.
type Counting = (Box<dyn ActionServer>, mpsc::UnboundedReceiver<(String, Bytes)>);

fn serve_count(bus: &dyn Bus, action: &str) -> Result<Counting, Box<dyn std::error::Error>> {
    let registry = Registry::for_version(RosVersion::Two);
    let text = "int32 number\n---\nint32 number\n---\nint32 number\n";
    registry.insert("tests/action/Count", text)?;
    let (sender, goals) = mpsc::unbounded_channel();
    let of = registry.action("tests/action/Count")?;
    let server = bus.serve_action(action, &of, Arc::new(RelayGoals(sender)))?;
    Ok((server, goals))
}

/// Returns the offset of the message: in ROS 2 it follows the CDR header.
fn payload_offset(bus: &dyn Bus) -> usize {
    match bus.version() {
        RosVersion::One => 0,
        RosVersion::Two => 4,
    }
}

fn decode(bus: &dyn Bus, message: &[u8]) -> String {
    let text = &message[payload_offset(bus) + 4..];
    let text = String::from_utf8_lossy(text).into_owned();
    text.trim_end_matches('\0').to_owned()
}

fn encode(bus: &dyn Bus, text: &str) -> Result<Bytes, Box<dyn std::error::Error>> {
    let (header, end): (&[u8], &[u8]) = match bus.version() {
        RosVersion::One => (&[], &[]),
        RosVersion::Two => (&[0, 1, 0, 0], &[0]),
    };
    let length = u32::try_from(text.len() + end.len())?.to_le_bytes();
    Ok([header, &length, text.as_bytes(), end].concat().into())
}

async fn ask_service(bus: &dyn Bus, service: &str) -> String {
    let request = match bus.version() {
        RosVersion::One => Bytes::new(),
        RosVersion::Two => Bytes::from_static(&[0, 1, 0, 0, 0]),
    };
    match bus.call(service, request, Duration::from_secs(20)).await {
        Ok(answer) => String::from_utf8_lossy(&answer[payload_offset(bus)..]).into_owned(),
        Err(error) => error.to_string(),
    }
}

/// Joins the ROS system that the environment names.
async fn join(version: RosVersion, node: &str) -> Result<Arc<dyn Bus>, Box<dyn std::error::Error>> {
    let options = match version {
        RosVersion::One => {
            let master = std::env::var("ROS_MASTER_URI")?;
            let master = PeerUri::parse(&master, "http").ok_or("ROS_MASTER_URI")?;
            let master = HostSockets.resolve(&master.host, master.port).await?;
            JoinOptions::new(master, node)
        }
        RosVersion::Two => JoinOptions::in_domain(std::env::var("ROS_DOMAIN_ID")?.parse()?, node),
    };
    Ok(ros::connect(version, Arc::new(HostSockets), options).await?)
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let given = |name: &str| {
        let prefix = format!("{name}:=");
        arguments.iter().rev().find_map(|argument| argument.strip_prefix(&prefix)).map(str::to_owned)
    };
    let version =
        if arguments.iter().any(|argument| argument == "--ros-args") { RosVersion::Two } else { RosVersion::One };
    let namespace = std::env::var("ROS_NAMESPACE").unwrap_or_default();
    let namespace = given("__ns").unwrap_or(namespace);
    let name = given("__node").or_else(|| given("__name"));
    let name = name.unwrap_or_else(|| "relay".into());
    let node = names::canonical(&format!("{namespace}/{name}"));
    let topic = |name: &str| names::resolve(&given(name).unwrap_or_else(|| name.into()), &node);
    let crash = arguments.iter().find_map(|argument| argument.strip_prefix("crash-on="));

    let bus = join(version, &node).await?;
    let greeting = match bus.parameters() {
        Ok(parameters) => {
            let greeting = parameters.get(&format!("{node}_sibling/greeting")).await;
            let seen = ParamValue::Bool(true);
            parameters.set(&format!("{node}/seen"), seen).await?;
            match greeting {
                Ok(ParamValue::String(greeting)) => greeting,
                _ => String::new(),
            }
        }
        Err(_) => given("greeting").unwrap_or_default(),
    };
    let registry = Registry::for_version(version);
    registry.insert("std_msgs/msg/String", "string data\n")?;
    let wire_type = WireType::from_message(&*registry.message("std_msgs/String")?);
    let (server, mut goals) = match version {
        RosVersion::One => (None, mpsc::unbounded_channel().1),
        RosVersion::Two => {
            let (server, goals) = serve_count(&*bus, &topic("count"))?;
            (Some(server), goals)
        }
    };
    let echo_type = ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef");
    let _echo = bus.serve(&format!("{node}/echo"), echo_type, Arc::new(Echo)).await?;
    let out = bus.advertise(&topic("out"), wire_type.clone(), QosProfile::keep_last(8)).await?;
    if arguments.iter().any(|argument| argument == "patient") {
        out.matched_subscribers().wait_for(|now| now.connected_count() > 0).await?;
    }
    for (prefix, is_latched) in [("awaits=", false), ("awaits-latched=", true)] {
        let awaited = arguments.iter().find_map(|it| it.strip_prefix(prefix));
        if let Some(awaited) = awaited {
            let qos = QosProfile::keep_last(8).latching(is_latched);
            let mut heard = bus.subscribe(awaited, wire_type.clone(), qos).await?;
            heard.messages.recv().await;
        }
    }
    let keeps = arguments.iter().any(|argument| argument == "keeps");
    let qos = QosProfile::keep_last(8).latching(keeps);
    let mut input = bus.subscribe(&topic("in"), wire_type, qos).await?;
    let mut end = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::interrupt())?;
    loop {
        tokio::select! {
            message = input.messages.recv() => {
                let Some(message) = message else { return Ok(()) };
                let text = decode(&*bus, &message.bytes);
                if crash == Some(text.as_str()) {
                    std::process::exit(3);
                }
                let text = match text.split_once(' ') {
                    Some(("ask", service)) => ask_service(&*bus, service).await,
                    Some(("get", parameter)) => match bus.parameter(parameter).await {
                        Ok(value) => format!("{value:?}"),
                        Err(error) => error.to_string(),
                    },
                    _ => format!("{greeting}{text}"),
                };
                out.publish(encode(&*bus, &text)?);
            }
            Some((id, result)) = goals.recv() => {
                if let Some(server) = &server {
                    let outcome = GoalOutcome::Succeeded;
                    server.end_goal(&id, GoalEnd { outcome, text: String::new(), result });
                }
            }
            _ = end.recv() => {
                bus.close().await;
                return Ok(());
            }
        }
    }
}
