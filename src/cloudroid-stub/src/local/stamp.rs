//! Keys that correlate answers, read from serialized messages without decoding the rest.

use std::collections::HashMap;
use std::time::Duration;

use qos::{CorrelationKey, Stamp};
use ros::bus::{Digest, RosVersion, SerializedMessage, WireFormat, WireType};
use ros::codec;
use ros::ros1::actions;
use ros::schema::Registry;

/// Records for each type whether it begins with a header.
#[derive(Debug)]
pub struct StampReader {
    /// Position of the stamp in a header: ROS 1, ROS 2.
    headers: [codec::Stamps; 2],
    stamped: HashMap<Digest, bool>,
}

impl Default for StampReader {
    fn default() -> Self {
        let header = |version| {
            let header = Registry::for_version(version).message("std_msgs/Header");
            header.map(|header| codec::Stamps::for_type(&header)).unwrap_or_default()
        };
        Self { headers: [RosVersion::One, RosVersion::Two].map(header), stamped: HashMap::new() }
    }
}

impl StampReader {
    /// Adds the definition of a type, since ROS 2 messages do not carry it.
    pub fn learn(&mut self, wire_type: &WireType) {
        if !wire_type.definition.is_empty() {
            let stamped = is_stamped(wire_type);
            self.stamped.insert(wire_type.digest.clone(), stamped);
        }
    }

    /// Returns the goal id for goals, results and feedback of ROS 1 actions, otherwise the stamp.
    pub fn key(&mut self, message: &SerializedMessage) -> Option<CorrelationKey> {
        if message.wire_type.format == WireFormat::Ros1 && actions::carries_goal_id(&message.wire_type.name) {
            let id = actions::messages::goal_id(&message.bytes)?;
            return Some(CorrelationKey::Goal(id.into()));
        }
        self.read_stamp(message).map(CorrelationKey::Stamp)
    }

    /// Returns the stamp of a message whose type begins with `std_msgs/Header`.
    pub fn read_stamp(&mut self, message: &SerializedMessage) -> Option<Stamp> {
        let wire_type = &message.wire_type;
        let stamped = match self.stamped.get(&wire_type.digest) {
            Some(stamped) => *stamped,
            None => {
                self.learn(wire_type);
                // The definition of this type may still become known.
                is_stamped(wire_type)
            }
        };
        let header = match wire_type.format {
            WireFormat::Ros1 => &self.headers[0],
            WireFormat::Cdr => &self.headers[1],
        };
        let found = header.first(&message.bytes).filter(|_| stamped)?;
        Some(Stamp { secs: found.secs, nsecs: found.nsecs })
    }
}

/// Returns whether the first field is a header: by the definition, or, as long as it is unknown, by naming convention.
pub fn is_stamped(wire_type: &WireType) -> bool {
    if wire_type.definition.is_empty() {
        let (package, name) = wire_type.name.split_once('/').unwrap_or_default();
        return name.ends_with("Stamped") || matches!(package, "sensor_msgs" | "stereo_msgs");
    }
    let fields = wire_type.definition.lines().map(|line| line.split('#').next().unwrap_or_default().trim());
    let first = fields
        .filter(|line| !line.is_empty())
        // Constants are not fields; the `<=` of a bound (ROS 2) does not make a constant.
        .find(|line| !line.replace("<=", "").contains('='));
    let kind = first.and_then(|line| line.split_whitespace().next());
    matches!(kind, Some("Header" | "std_msgs/Header" | "std_msgs/msg/Header"))
}

/// Returns the age of a stamp by this machine's clock; zero for stamps in the future.
pub fn age(stamp: Stamp) -> Duration {
    let now = Duration::from_nanos(u64::try_from(link::clock::now()).unwrap_or_default());
    now.saturating_sub(Duration::new(u64::from(stamp.secs), stamp.nsecs.min(999_999_999)))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    /// 3 s and 4 ns, in a ROS 2 header.
    const STAMPED_HEADER: [u8; 16] = [0, 1, 0, 0, 3, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0, 0];

    fn message(of: &WireType, bytes: &'static [u8]) -> SerializedMessage {
        SerializedMessage {
            bytes: bytes.into(),
            wire_type: Arc::new(of.clone()),
            publisher: "/app".into(),
            latching: false,
        }
    }

    fn ros2_type(name: &str, digest: &str, definition: &str) -> WireType {
        WireType::new(name, digest, definition).with_version(RosVersion::Two)
    }

    #[test]
    fn stamps_of_ros_2_stand_behind_the_header_of_cdr() {
        let mut stamps = StampReader::default();
        let untold = ros2_type("p/msg/Found", "RIHS01_1", "");
        let stamp = |stamps: &mut StampReader, of: &WireType| stamps.key(&message(of, &STAMPED_HEADER));
        assert_eq!(stamp(&mut stamps, &untold), None);
        // The publisher does not send the definition; the cloud does.
        let definition = "uint8 ALL=1\nstd_msgs/Header header\nstring<=8 name\n";
        stamps.learn(&ros2_type("p/msg/Found", "RIHS01_1", definition));
        let expected = CorrelationKey::Stamp(Stamp { secs: 3, nsecs: 4 });
        assert_eq!(stamp(&mut stamps, &untold), Some(expected.clone()));
        let image = ros2_type("sensor_msgs/msg/Image", "RIHS01_2", "");
        assert_eq!(stamp(&mut stamps, &image), Some(expected));
        let named = ros2_type("p/msg/Named", "RIHS01_3", "string<=8 name\nstd_msgs/Header h\n");
        assert!(!is_stamped(&named));
        let cut = message(&image, &STAMPED_HEADER[..8]);
        assert_eq!(stamps.key(&cut), None);
    }
}
