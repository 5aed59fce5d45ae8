//! What answers are recognised by, read from serialized messages without decoding the rest.

use std::collections::HashMap;
use std::time::Duration;

use qos::{Key, Stamp};
use ros::bus::{Digest, Message, WireType};
use ros::codec;
use ros::ros1::actions;
use ros::schema::Registry;

/// Knows for each type whether it begins with a header.
#[derive(Debug)]
pub struct Stamps {
    header: codec::Stamps,
    stamped: HashMap<Digest, bool>,
}

impl Default for Stamps {
    fn default() -> Self {
        let header = Registry::new().message("std_msgs/Header");
        Self {
            header: header
                .map(|header| codec::Stamps::of(&header))
                .unwrap_or_default(),
            stamped: HashMap::new(),
        }
    }
}

impl Stamps {
    /// The id of an action's goal, in goals, results and feedback; else the stamp.
    pub fn key(&mut self, message: &Message) -> Option<Key> {
        if actions::carries_goal_id(&message.wire_type.name) {
            let id = actions::messages::goal_id(&message.bytes)?;
            return Some(Key::Goal(id.into()));
        }
        self.of(message).map(Key::Stamp)
    }

    /// The stamp of a message whose type begins with `std_msgs/Header`.
    pub fn of(&mut self, message: &Message) -> Option<Stamp> {
        let wire_type = &message.wire_type;
        let stamped = match self.stamped.get(&wire_type.digest) {
            Some(stamped) => *stamped,
            None => {
                let stamped = is_stamped(wire_type);
                // A type whose definition has not come may be known later.
                if !wire_type.definition.is_empty() {
                    self.stamped.insert(wire_type.digest.clone(), stamped);
                }
                stamped
            }
        };
        let found = self.header.first(&message.bytes).filter(|_| stamped)?;
        Some(Stamp {
            secs: found.secs,
            nsecs: found.nsecs,
        })
    }
}

/// Whether the first field is a header: by the definition, or, before that has come, by the custom of naming such types.
pub fn is_stamped(wire_type: &WireType) -> bool {
    if wire_type.definition.is_empty() {
        let (package, name) = wire_type.name.split_once('/').unwrap_or_default();
        return name.ends_with("Stamped") || matches!(package, "sensor_msgs" | "stereo_msgs");
    }
    let fields = wire_type
        .definition
        .lines()
        .map(|line| line.split('#').next().unwrap_or_default().trim());
    let first = fields
        .filter(|line| !line.is_empty())
        .find(|line| !line.contains('='));
    let kind = first.and_then(|line| line.split_whitespace().next());
    matches!(kind, Some("Header" | "std_msgs/Header"))
}

/// How long ago a stamp was, by this machine's clock; zero for stamps of the future.
pub fn age(stamp: Stamp) -> Duration {
    let now = Duration::from_nanos(u64::try_from(link::clock::now()).unwrap_or_default());
    now.saturating_sub(Duration::new(
        u64::from(stamp.secs),
        stamp.nsecs.min(999_999_999),
    ))
}
