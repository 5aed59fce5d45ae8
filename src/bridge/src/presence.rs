//! `/client_count` and `/connected_clients`: the connected clients, as published by rosbridge_suite. The bridge
//! publishes these topics itself, unless a node of the servant has topics of these names.

use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{RosVersion, SerializedMessage, WireType};
use ros::codec::{self, FillOptions, Time};
use ros::schema::{MessageType, Registry};
use serde_json::json;

const COUNT: &str = "/client_count";
const CLIENTS: &str = "/connected_clients";

/// Both topics.
pub(crate) const TOPICS: [&str; 2] = [COUNT, CLIENTS];

/// Returns the types of these topics and of their fields, for one ROS.
fn definitions(version: RosVersion) -> [(&'static str, &'static str); 3] {
    let client = match version {
        RosVersion::One => "string ip_address\ntime connection_time\n",
        RosVersion::Two => "string ip_address\nbuiltin_interfaces/Time connection_time\n",
    };
    [
        ("std_msgs/msg/Int32", "int32 data\n"),
        ("rosbridge_msgs/msg/ConnectedClient", client),
        ("rosbridge_msgs/msg/ConnectedClients", "ConnectedClient[] clients\n"),
    ]
}

/// The connected clients.
#[derive(Default)]
pub(crate) struct Presence {
    present: Mutex<Vec<ConnectedClient>>,
}

struct ConnectedClient {
    number: u64,
    name: String,
    since: Time,
}

/// Returns the type of one of these topics.
pub(crate) fn type_name(version: RosVersion, topic: &str) -> Option<&'static str> {
    match (topic, version) {
        (COUNT, RosVersion::One) => Some("std_msgs/Int32"),
        (COUNT, RosVersion::Two) => Some("std_msgs/msg/Int32"),
        (CLIENTS, RosVersion::One) => Some("rosbridge_msgs/ConnectedClients"),
        (CLIENTS, RosVersion::Two) => Some("rosbridge_msgs/msg/ConnectedClients"),
        _ => None,
    }
}

/// Adds the types of these topics unless the servant has types of these names.
pub(crate) fn define_types(version: RosVersion, registry: &Registry) {
    for (name, text) in definitions(version) {
        if registry.message(name).is_err()
            && let Err(error) = registry.insert(name, text)
        {
            tracing::warn!(%error, "{name} cannot be defined");
        }
    }
}

impl Presence {
    pub(crate) fn enter(&self, number: u64, name: &str) {
        self.present.lock().push(ConnectedClient { number, name: name.to_owned(), since: Time::now() });
    }

    pub(crate) fn leave(&self, number: u64) {
        self.present.lock().retain(|present| present.number != number);
    }

    /// Builds the current message of the topic, if its type has the expected fields.
    pub(crate) fn build_message(&self, topic: &str, message_type: &MessageType) -> Option<SerializedMessage> {
        let said = {
            let present = self.present.lock();
            let client = |ConnectedClient { name, since, .. }: &ConnectedClient| {
                let Time { secs, nsecs } = *since;
                json!({ "ip_address": name, "connection_time": { "secs": secs, "nsecs": nsecs } })
            };
            match topic {
                CLIENTS => json!({ "clients": present.iter().map(client).collect::<Vec<_>>() }),
                _ => json!({ "data": present.len() }),
            }
        };
        let mut bytes = Vec::new();
        let options = FillOptions::default();
        codec::from_json(message_type, said.to_string().as_bytes(), &mut bytes, &options).ok()?;
        Some(SerializedMessage {
            bytes: bytes.into(),
            wire_type: Arc::new(WireType::from_message(message_type)),
            publisher: "/rosbridge_websocket".into(),
            latching: true,
        })
    }
}
