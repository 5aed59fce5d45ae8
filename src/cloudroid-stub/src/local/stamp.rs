//! `header.stamp` of a serialized message, without decoding the rest.

use std::collections::HashMap;
use std::time::Duration;

use qos::Stamp;
use ros::bus::{Message, WireType};

/// Knows for each type whether it begins with a header.
#[derive(Debug, Default)]
pub struct Stamps {
    stamped: HashMap<String, bool>,
}

impl Stamps {
    /// The stamp of a message whose type begins with `std_msgs/Header`.
    pub fn of(&mut self, message: &Message) -> Option<Stamp> {
        let wire_type = &message.wire_type;
        let stamped = match self.stamped.get(&wire_type.md5) {
            Some(stamped) => *stamped,
            None => {
                let stamped = is_stamped(wire_type);
                // A type whose definition has not come may be known later.
                if !wire_type.definition.is_empty() {
                    self.stamped.insert(wire_type.md5.clone(), stamped);
                }
                stamped
            }
        };
        // Header: uint32 seq, then the time's two halves.
        let word = |at: usize| {
            let bytes = message.bytes.get(at..at + 4)?;
            Some(u32::from_le_bytes(bytes.try_into().ok()?))
        };
        stamped
            .then(|| {
                Some(Stamp {
                    secs: word(4)?,
                    nsecs: word(8)?,
                })
            })
            .flatten()
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
