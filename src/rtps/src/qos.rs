//! What ends of a topic offer and ask for, and whether that fits (DDS 1.4, 2.2.3).

use std::fmt;
use std::time::Duration;

/// Whether samples may be lost on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Reliability {
    /// Sent once.
    BestEffort,
    /// Sent again until they have come.
    Reliable,
}

/// What newcomers among the readers are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Durability {
    /// What is written from then on.
    Volatile,
    /// Also what the writer still keeps.
    TransientLocal,
    /// Also what others keep of it.
    Transient,
    /// Also what was kept on a disk.
    Persistent,
}

/// How many samples an end keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum History {
    /// The last ones.
    KeepLast(u32),
    /// All, as far as there is room.
    KeepAll,
}

/// Who says that a writer is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Liveliness {
    /// Its participant's being there.
    Automatic,
    /// Anything of its participant that says so.
    ManualByParticipant,
    /// Itself.
    ManualByTopic,
}

/// How samples are encoded (DDS-XTypes 1.3, 7.6.3.1.1). A writer writes in the first one of its own; a reader reads all of its own.
/// ROS 2 writes XCDR1, and so do we.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Representations {
    first: u8,
    /// The bit of each number.
    all: u8,
}

impl Representations {
    /// XCDR1 alone, which holds for whoever says nothing.
    pub const XCDR1: Self = Self { first: 0, all: 1 };
    /// XCDR2 alone.
    pub const XCDR2: Self = Self { first: 2, all: 4 };

    /// By their numbers, the first of which a writer writes in; numbers beyond 7 stand for nothing that is known.
    pub fn of(numbers: &[u16]) -> Self {
        let Some(first) = numbers.first() else {
            return Self::XCDR1;
        };
        let known = |number: &u16| u8::try_from(*number).ok().filter(|number| *number < 8);
        let all = numbers.iter().filter_map(known);
        Self {
            first: known(first).unwrap_or(u8::MAX),
            all: all.fold(0, |all, number| all | 1 << number),
        }
    }

    /// The numbers of all, the first one first.
    pub fn numbers(self) -> impl Iterator<Item = u16> {
        let others = (0..8).filter(move |number| *number != self.first && self.reads(*number));
        std::iter::once(self.first).chain(others).map(u16::from)
    }

    fn reads(self, number: u8) -> bool {
        number < 8 && self.all & 1 << number != 0
    }
}

/// What an end offers (a writer) or asks for (a reader).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct EndpointQos {
    /// Whether samples may be lost.
    pub reliability: Reliability,
    /// What newcomers are given.
    pub durability: Durability,
    /// How many are kept. Peers need not tell it.
    pub history: History,
    /// The longest time between two samples; none where that does not matter.
    pub deadline: Option<Duration>,
    /// After so long a sample is of no use; none where it always is. Of writers.
    pub lifespan: Option<Duration>,
    /// Who says that the writer is alive.
    pub liveliness: Liveliness,
    /// Within which time; none where that does not matter.
    pub lease: Option<Duration>,
    /// How samples are encoded.
    pub representations: Representations,
}

impl Default for EndpointQos {
    fn default() -> Self {
        Self {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            history: History::KeepLast(10),
            deadline: None,
            lifespan: None,
            liveliness: Liveliness::Automatic,
            lease: None,
            representations: Representations::XCDR1,
        }
    }
}

/// A policy in which a reader asks for more than a writer offers: no sample passes between them.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Mismatch {
    /// The policy's name.
    pub policy: &'static str,
    /// What the writer offers.
    pub offered: String,
    /// What the reader asks for.
    pub requested: String,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            policy,
            offered,
            requested,
        } = self;
        write!(
            formatter,
            "{policy}: the publisher offers {offered}, the subscriber asks for {requested}"
        )
    }
}

impl EndpointQos {
    /// The policies by which a writer with this and a reader with `requested` do not match; none where they do.
    pub fn mismatches(&self, requested: &EndpointQos) -> Vec<Mismatch> {
        let mut found = Vec::new();
        let mut check = |fits: bool, policy, offered: String, requested: String| {
            if !fits {
                found.push(Mismatch {
                    policy,
                    offered,
                    requested,
                });
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
            shorter(self.deadline, requested.deadline),
            "deadline",
            duration(self.deadline),
            duration(requested.deadline),
        );
        check(
            self.liveliness >= requested.liveliness,
            "liveliness",
            self.liveliness.to_string(),
            requested.liveliness.to_string(),
        );
        check(
            shorter(self.lease, requested.lease),
            "liveliness lease",
            duration(self.lease),
            duration(requested.lease),
        );
        let offered = self.representations;
        check(
            requested.representations.reads(offered.first),
            "data representation",
            name(u16::from(offered.first)),
            requested
                .representations
                .numbers()
                .map(name)
                .collect::<Vec<_>>()
                .join(" or "),
        );
        found
    }
}

fn name(representation: u16) -> String {
    match representation {
        0 => "XCDR1".to_owned(),
        1 => "XML".to_owned(),
        2 => "XCDR2".to_owned(),
        other => format!("representation {other}"),
    }
}

/// Whether what is offered is at most what is asked for, where none is without end.
fn shorter(offered: Option<Duration>, requested: Option<Duration>) -> bool {
    match (offered, requested) {
        (_, None) => true,
        (None, Some(_)) => false,
        (Some(offered), Some(requested)) => offered <= requested,
    }
}

fn duration(duration: Option<Duration>) -> String {
    match duration {
        None => "infinite".to_owned(),
        Some(duration) => format!("{} s", duration.as_secs_f64()),
    }
}

/// In the words of ROS 2's tools.
impl fmt::Display for Reliability {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::BestEffort => "best_effort",
            Self::Reliable => "reliable",
        })
    }
}

impl fmt::Display for Durability {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Volatile => "volatile",
            Self::TransientLocal => "transient_local",
            Self::Transient => "transient",
            Self::Persistent => "persistent",
        })
    }
}

impl fmt::Display for Liveliness {
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
    fn a_reader_that_asks_for_more_is_told_what_of() {
        let offered = EndpointQos {
            reliability: Reliability::BestEffort,
            ..EndpointQos::default()
        };
        let requested = EndpointQos {
            durability: Durability::TransientLocal,
            deadline: Some(Duration::from_millis(500)),
            ..EndpointQos::default()
        };
        let told: Vec<String> = offered
            .mismatches(&requested)
            .iter()
            .map(Mismatch::to_string)
            .collect();
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
    fn a_reader_of_another_encoding_is_told_so() {
        let reader = |numbers: &[u16]| EndpointQos {
            representations: Representations::of(numbers),
            ..EndpointQos::default()
        };
        let ours = EndpointQos::default();
        for fits in [&[][..], &[0], &[2, 0], &[0, 1, 2]] {
            assert_eq!(ours.mismatches(&reader(fits)), [], "{fits:?}");
        }
        let told: Vec<String> = ours
            .mismatches(&reader(&[2, 1]))
            .iter()
            .map(Mismatch::to_string)
            .collect();
        let expected =
            "data representation: the publisher offers XCDR1, the subscriber asks for XCDR2 or XML";
        assert_eq!(told, [expected]);
        // A writer writes in its first one only.
        assert_eq!(reader(&[0, 2]).mismatches(&ours), []);
        assert_eq!(reader(&[2, 0]).mismatches(&ours).len(), 1);
    }
}
