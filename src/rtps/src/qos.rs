//! QoS policies of endpoints, and their compatibility (DDS 1.4, 2.2.3).

use std::fmt;
use std::time::Duration;

/// Reliability policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ReliabilityKind {
    /// Samples are sent once and may be lost.
    BestEffort,
    /// Samples are sent again until they are acknowledged.
    Reliable,
}

/// Durability policy: which samples new readers receive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum DurabilityKind {
    /// Samples written from then on.
    Volatile,
    /// Also those in the writer's history.
    TransientLocal,
    /// Also those kept by other processes.
    Transient,
    /// Also those in persistent storage.
    Persistent,
}

/// History policy: how many samples an endpoint keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum HistoryKind {
    /// The last samples, up to this depth.
    KeepLast(u32),
    /// All samples, within the memory limits.
    KeepAll,
}

/// Liveliness policy: who asserts that a writer is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LivelinessKind {
    /// The presence of its participant.
    Automatic,
    /// Any assertion by its participant.
    ManualByParticipant,
    /// The writer itself.
    ManualByTopic,
}

/// Data representations, the encodings of samples (DDS-XTypes 1.3, 7.6.3.1.1). A writer uses its first one; a reader
/// accepts all of its own. ROS 2 writes XCDR1, and so do we.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Representations {
    first: u8,
    /// Bit set of all representation ids.
    all: u8,
}

impl Representations {
    /// Only XCDR1, which is the default.
    pub const XCDR1: Self = Self { first: 0, all: 1 };
    /// Only XCDR2.
    pub const XCDR2: Self = Self { first: 2, all: 4 };

    /// Creates the policy from representation ids, of which a writer uses the first; ids above 7 are unknown.
    pub fn from_numbers(numbers: &[u16]) -> Self {
        let Some(first) = numbers.first() else {
            return Self::XCDR1;
        };
        let known = |number: &u16| u8::try_from(*number).ok().filter(|number| *number < 8);
        let all = numbers.iter().filter_map(known);
        Self { first: known(first).unwrap_or(u8::MAX), all: all.fold(0, |all, number| all | 1 << number) }
    }

    /// Returns all ids, the first one first.
    pub fn numbers(self) -> impl Iterator<Item = u16> {
        let others = (0..8).filter(move |number| *number != self.first && self.contains(*number));
        std::iter::once(self.first).chain(others).map(u16::from)
    }

    fn contains(self, number: u8) -> bool {
        number < 8 && self.all & 1 << number != 0
    }
}

/// QoS offered by a writer or requested by a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct EndpointQos {
    /// Reliability policy.
    pub reliability: ReliabilityKind,
    /// Durability policy.
    pub durability: DurabilityKind,
    /// History policy. Peers need not announce it.
    pub history: HistoryKind,
    /// Maximum time between two samples; `None`: unlimited.
    pub deadline: Option<Duration>,
    /// Time after which a sample of a writer is stale; `None`: never.
    pub lifespan: Option<Duration>,
    /// Liveliness policy.
    pub liveliness: LivelinessKind,
    /// Liveliness lease duration; `None`: infinite.
    pub lease: Option<Duration>,
    /// Data representations.
    pub representations: Representations,
}

impl Default for EndpointQos {
    fn default() -> Self {
        Self {
            reliability: ReliabilityKind::Reliable,
            durability: DurabilityKind::Volatile,
            history: HistoryKind::KeepLast(10),
            deadline: None,
            lifespan: None,
            liveliness: LivelinessKind::Automatic,
            lease: None,
            representations: Representations::XCDR1,
        }
    }
}

/// A policy that makes a reader and a writer incompatible: the reader requests more than the writer offers.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Mismatch {
    /// Name of the policy.
    pub policy: &'static str,
    /// Value offered by the writer.
    pub offered: String,
    /// Value requested by the reader.
    pub requested: String,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { policy, offered, requested } = self;
        write!(formatter, "{policy}: the publisher offers {offered}, the subscriber asks for {requested}")
    }
}

impl EndpointQos {
    /// Returns the policies in which a writer with this QoS does not satisfy a reader with `requested`; empty if they
    /// are compatible.
    pub fn mismatches(&self, requested: &EndpointQos) -> Vec<Mismatch> {
        let mut found = Vec::new();
        let mut check = |fits: bool, policy, offered: String, requested: String| {
            if !fits {
                found.push(Mismatch { policy, offered, requested });
            }
        };
        check(
            self.reliability >= requested.reliability,
            "reliability",
            self.reliability.to_string(),
            requested.reliability.to_string(),
        );
        check(
            self.durability >= requested.durability,
            "durability",
            self.durability.to_string(),
            requested.durability.to_string(),
        );
        check(
            is_at_most(self.deadline, requested.deadline),
            "deadline",
            format_duration(self.deadline),
            format_duration(requested.deadline),
        );
        check(
            self.liveliness >= requested.liveliness,
            "liveliness",
            self.liveliness.to_string(),
            requested.liveliness.to_string(),
        );
        check(
            is_at_most(self.lease, requested.lease),
            "liveliness lease",
            format_duration(self.lease),
            format_duration(requested.lease),
        );
        let offered = self.representations;
        check(
            requested.representations.contains(offered.first),
            "data representation",
            representation_name(u16::from(offered.first)),
            requested.representations.numbers().map(representation_name).collect::<Vec<_>>().join(" or "),
        );
        found
    }
}

fn representation_name(representation: u16) -> String {
    match representation {
        0 => "XCDR1".to_owned(),
        1 => "XML".to_owned(),
        2 => "XCDR2".to_owned(),
        other => format!("representation {other}"),
    }
}

/// Returns whether the offered duration is at most the requested one, where `None` is infinite.
fn is_at_most(offered: Option<Duration>, requested: Option<Duration>) -> bool {
    match (offered, requested) {
        (_, None) => true,
        (None, Some(_)) => false,
        (Some(offered), Some(requested)) => offered <= requested,
    }
}

fn format_duration(duration: Option<Duration>) -> String {
    match duration {
        None => "infinite".to_owned(),
        Some(duration) => format!("{} s", duration.as_secs_f64()),
    }
}

/// Formats the value as ROS 2 tools do.
impl fmt::Display for ReliabilityKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::BestEffort => "best_effort",
            Self::Reliable => "reliable",
        })
    }
}

impl fmt::Display for DurabilityKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Volatile => "volatile",
            Self::TransientLocal => "transient_local",
            Self::Transient => "transient",
            Self::Persistent => "persistent",
        })
    }
}

impl fmt::Display for LivelinessKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Automatic => "automatic",
            Self::ManualByParticipant => "manual_by_participant",
            Self::ManualByTopic => "manual_by_topic",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mismatched_policies_are_listed() {
        let offered = EndpointQos { reliability: ReliabilityKind::BestEffort, ..EndpointQos::default() };
        let requested = EndpointQos {
            durability: DurabilityKind::TransientLocal,
            deadline: Some(Duration::from_millis(500)),
            ..EndpointQos::default()
        };
        let told: Vec<String> = offered.mismatches(&requested).iter().map(Mismatch::to_string).collect();
        assert_eq!(
            told,
            [
                "reliability: the publisher offers best_effort, the subscriber asks for reliable",
                "durability: the publisher offers volatile, the subscriber asks for transient_local",
                "deadline: the publisher offers infinite, the subscriber asks for 0.5 s",
            ]
        );
        assert_eq!(requested.mismatches(&offered), []);
    }
    #[test]
    fn a_mismatched_data_representation_is_listed() {
        let reader = |numbers: &[u16]| EndpointQos {
            representations: Representations::from_numbers(numbers),
            ..EndpointQos::default()
        };
        let ours = EndpointQos::default();
        for fits in [&[][..], &[0], &[2, 0], &[0, 1, 2]] {
            assert_eq!(ours.mismatches(&reader(fits)), [], "{fits:?}");
        }
        let told: Vec<String> = ours.mismatches(&reader(&[2, 1])).iter().map(Mismatch::to_string).collect();
        let expected = "data representation: the publisher offers XCDR1, the subscriber asks for XCDR2 or XML";
        assert_eq!(told, [expected]);
        // A writer uses only its first representation.
        assert_eq!(reader(&[0, 2]).mismatches(&ours), []);
        assert_eq!(reader(&[2, 0]).mismatches(&ours).len(), 1);
    }
}
