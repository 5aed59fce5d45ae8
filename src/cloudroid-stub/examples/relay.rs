//! An ordinary ROS node: what comes on `in` leaves on `out`, with a greeting from a sibling's parameter before it;
//! `~echo` answers with its request. `crash-on=TEXT` ends it with status 3 when TEXT comes. When `ask SERVICE` comes, what
//! that service answers leaves. `patient`: it listens once it is heard.
//!
//! The tests of the local original start it in place of one.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, GlobalParameters, ParamValue, Qos, ServiceHandler, ServiceType, WireType};
use ros::net::{HostSockets, Sockets};
use ros::ros1::Ros1Bus;
use ros::ros1::names::{self, PeerUri};

struct Echo;

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _: &str) -> Result<Bytes, String> {
        Ok(request)
    }
}

async fn asked(bus: &dyn Bus, service: &str) -> String {
    match bus
        .call(service, Bytes::new(), Duration::from_secs(20))
        .await
    {
        Ok(answer) => String::from_utf8_lossy(&answer).into_owned(),
        Err(error) => error.to_string(),
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let given = |name: &str| {
        let prefix = format!("{name}:=");
        arguments
            .iter()
            .rev()
            .find_map(|argument| argument.strip_prefix(&prefix))
            .map(str::to_owned)
    };
    let namespace = std::env::var("ROS_NAMESPACE").unwrap_or_default();
    let name = given("__name").unwrap_or_else(|| "relay".into());
    let node = names::canonical(&format!("{namespace}/{name}"));
    let topic = |name: &str| names::resolve(&given(name).unwrap_or_else(|| name.into()), &node);
    let crash = arguments
        .iter()
        .find_map(|argument| argument.strip_prefix("crash-on="));

    let master =
        PeerUri::parse(&std::env::var("ROS_MASTER_URI")?, "http").ok_or("ROS_MASTER_URI")?;
    let master = HostSockets.resolve(&master.host, master.port).await?;
    let bus = Ros1Bus::connect(Arc::new(HostSockets), master, &node).await?;
    let greeting = match bus.get(&format!("{node}_sibling/greeting")).await {
        Ok(ParamValue::String(greeting)) => greeting,
        _ => String::new(),
    };
    bus.set(&format!("{node}/seen"), ParamValue::Bool(true))
        .await?;
    let wire_type = WireType::new(
        "std_msgs/String",
        "992ce8a1687cec8c8bd883ec73ca41d1",
        "string data\n",
    );
    let echo_type = ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef");
    let _echo = bus
        .serve(&format!("{node}/echo"), echo_type, Arc::new(Echo))
        .await?;
    let out = bus
        .advertise(&topic("out"), wire_type.clone(), Qos::keep_last(8))
        .await?;
    if arguments.iter().any(|argument| argument == "patient") {
        out.matched().wait_for(|now| now.connected() > 0).await?;
    }
    let mut input = bus
        .subscribe(&topic("in"), wire_type, Qos::keep_last(8))
        .await?;
    let mut end = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::interrupt())?;
    loop {
        tokio::select! {
            message = input.messages.recv() => {
                let Some(message) = message else { return Ok(()) };
                let text = String::from_utf8_lossy(&message.bytes[4..]).into_owned();
                if crash == Some(text.as_str()) {
                    std::process::exit(3);
                }
                let text = match text.strip_prefix("ask ") {
                    Some(service) => asked(&*bus, service).await,
                    None => format!("{greeting}{text}"),
                };
                let length = u32::try_from(text.len())?.to_le_bytes();
                out.publish([&length[..], text.as_bytes()].concat().into());
            }
            _ = end.recv() => {
                bus.close().await;
                return Ok(());
            }
        }
    }
}
