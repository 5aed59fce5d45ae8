//! What answers are recognised by, read from serialized messages without decoding the rest.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use qos::{Key, Stamp};
use ros::bus::{Digest, Message, WireType};

/// Knows for each type whether it begins with a header.
#[derive(Debug, Default)]
pub struct Stamps {
    stamped: HashMap<Digest, bool>,
}

impl Stamps {
    /// The id of an action's goal, in goals, results and feedback; else the stamp.
    pub fn key(&mut self, message: &Message) -> Option<Key> {
        if is_of_action(&message.wire_type.name) {
            return goal_id(&message.bytes).map(Key::Goal);
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

/// Messages of an action that carry a goal's id.
pub fn is_of_action(type_name: &str) -> bool {
    ["ActionGoal", "ActionResult", "ActionFeedback"]
        .iter()
        .any(|end| type_name.ends_with(end))
}

/// `goal_id.id` of an ActionGoal, `status.goal_id.id` of the others: header (seq, stamp, frame_id), stamp, id.
fn goal_id(bytes: &[u8]) -> Option<Arc<str>> {
    let length = |at: usize| {
        let word = bytes.get(at..at.checked_add(4)?)?;
        usize::try_from(u32::from_le_bytes(word.try_into().ok()?)).ok()
    };
    let id = 12 + 4 + length(12)? + 8;
    let text = bytes.get(id + 4..(id + 4).checked_add(length(id)?)?)?;
    std::str::from_utf8(text).ok().map(Arc::from)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_s_id_is_found_and_nothing_read_beyond_the_end() {
        let mut bytes = vec![0; 12];
        for part in [&b"map"[..], b"goal-7"] {
            if part == b"goal-7" {
                bytes.extend([0; 8]);
            }
            bytes.extend(u32::try_from(part.len()).unwrap().to_le_bytes());
            bytes.extend(part);
        }
        assert_eq!(goal_id(&bytes).as_deref(), Some("goal-7"));
        for end in 0..bytes.len() {
            assert_eq!(goal_id(&bytes[..end]), None, "cut at {end}");
        }
        bytes[12..16].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(goal_id(&bytes), None);
    }
}
