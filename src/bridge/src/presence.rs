//! `/client_count` and `/connected_clients`: who is connected, as rosbridge_suite publishes it. The bridge answers
//! for these topics itself, unless a node of the servant has topics of these names.

use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{Message, WireType};
use ros::codec::{self, FillOptions, Time};
use ros::schema::{MessageType, Registry};
use serde_json::json;

const COUNT: &str = "/client_count";
const CLIENTS: &str = "/connected_clients";

/// Both topics.
pub(crate) const TOPICS: [&str; 2] = [COUNT, CLIENTS];

const DEFINITIONS: [(&str, &str); 3] = [
    ("std_msgs/Int32", "int32 data\n"),
    (
        "rosbridge_msgs/ConnectedClient",
        "string ip_address\ntime connection_time\n",
    ),
    (
        "rosbridge_msgs/ConnectedClients",
        "ConnectedClient[] clients\n",
    ),
];

/// Who is connected.
#[derive(Default)]
pub(crate) struct Presence {
    present: Mutex<Vec<Present>>,
}

struct Present {
    number: u64,
    name: String,
    since: Time,
}

/// The type of one of these topics.
pub(crate) fn type_name(topic: &str) -> Option<&'static str> {
    match topic {
        COUNT => Some("std_msgs/Int32"),
        CLIENTS => Some("rosbridge_msgs/ConnectedClients"),
        _ => None,
    }
}

/// Adds the types of these topics where the servant has none of these names.
pub(crate) fn define(registry: &Registry) {
    for (name, text) in DEFINITIONS {
        if registry.message(name).is_err()
            && let Err(error) = registry.insert(name, text)
        {
            tracing::warn!(%error, "{name} cannot be defined");
        }
    }
}

impl Presence {
    pub(crate) fn enter(&self, number: u64, name: &str) {
        self.present.lock().push(Present {
            number,
            name: name.to_owned(),
            since: Time::now(),
        });
    }

    pub(crate) fn leave(&self, number: u64) {
        self.present
            .lock()
            .retain(|present| present.number != number);
    }

    /// What the topic says now, where its type has room for that.
    pub(crate) fn message(&self, topic: &str, message_type: &MessageType) -> Option<Message> {
        let said = {
            let present = self.present.lock();
            let client = |Present { name, since, .. }: &Present| {
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
        codec::from_json(
            message_type,
            said.to_string().as_bytes(),
            &mut bytes,
            &options,
        )
        .ok()?;
        Some(Message {
            bytes: bytes.into(),
            wire_type: Arc::new(WireType::of(message_type)),
            publisher: "/rosbridge_websocket".into(),
            latching: true,
        })
    }
}
