//! What ends offer and ask for, as parameters (9.6.3.2; DDS 1.4, 2.2.3 for what holds where one is left out).

use std::time::Duration;

use crate::qos::{Durability, EndpointQos, History, Liveliness, Reliability, Representations};
use crate::wire::{Input, ParameterWriter, WireError, pid};

/// How long whoever writes may wait for room; nobody but its own writer uses it. DDS's default.
const MAX_BLOCKING: Duration = Duration::from_millis(100);

/// There are three.
const MOST_REPRESENTATIONS: u32 = 8;

/// Which parameters [`take`] takes.
pub(super) const KNOWN: [u16; 7] = [
    pid::RELIABILITY,
    pid::DURABILITY,
    pid::HISTORY,
    pid::DEADLINE,
    pid::LIFESPAN,
    pid::LIVELINESS,
    pid::DATA_REPRESENTATION,
];

/// What a writer or a reader has that says nothing.
pub(super) fn unsaid(is_writer: bool) -> EndpointQos {
    EndpointQos {
        reliability: if is_writer {
            Reliability::Reliable
        } else {
            Reliability::BestEffort
        },
        durability: Durability::Volatile,
        history: History::KeepLast(1),
        deadline: None,
        lifespan: None,
        liveliness: Liveliness::Automatic,
        lease: None,
        representations: Representations::XCDR1,
    }
}

/// All of them, in full.
pub(super) fn write(qos: &EndpointQos, list: &mut ParameterWriter) {
    let reliability = match qos.reliability {
        Reliability::BestEffort => 1,
        Reliability::Reliable => 2,
    };
    list.kind_and_duration(pid::RELIABILITY, reliability, Some(MAX_BLOCKING));
    let durability = match qos.durability {
        Durability::Volatile => 0,
        Durability::TransientLocal => 1,
        Durability::Transient => 2,
        Durability::Persistent => 3,
    };
    list.u32(pid::DURABILITY, durability);
    let (kind, depth) = match qos.history {
        // A signed number on the wire.
        History::KeepLast(depth) => (0, depth.clamp(1, i32::MAX as u32)),
        History::KeepAll => (1, 0),
    };
    list.pair(pid::HISTORY, kind, depth);
    list.duration(pid::DEADLINE, qos.deadline);
    list.duration(pid::LIFESPAN, qos.lifespan);
    let liveliness = match qos.liveliness {
        Liveliness::Automatic => 0,
        Liveliness::ManualByParticipant => 1,
        Liveliness::ManualByTopic => 2,
    };
    list.kind_and_duration(pid::LIVELINESS, liveliness, qos.lease);
    if qos.representations != Representations::XCDR1 {
        let numbers: Vec<u16> = qos.representations.numbers().collect();
        let mut value = (numbers.len() as u32).to_le_bytes().to_vec();
        value.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        list.raw(pid::DATA_REPRESENTATION, &value);
    }
}

/// Takes one of them.
pub(super) fn take(qos: &mut EndpointQos, number: u16, mut value: Input) -> Result<(), WireError> {
    match number {
        pid::RELIABILITY => {
            qos.reliability = match value.u32()? {
                1 => Reliability::BestEffort,
                2 => Reliability::Reliable,
                _ => return Err(WireError::Value(number)),
            }
        }
        pid::DURABILITY => {
            qos.durability = match value.u32()? {
                0 => Durability::Volatile,
                1 => Durability::TransientLocal,
                2 => Durability::Transient,
                3 => Durability::Persistent,
                _ => return Err(WireError::Value(number)),
            }
        }
        pid::HISTORY => {
            qos.history = match (value.u32()?, value.i32()?) {
                // What keeps none is not refused: it tells no more than how its owner is made.
                (0, depth) => History::KeepLast(u32::try_from(depth).unwrap_or(0).max(1)),
                (1, _) => History::KeepAll,
                _ => return Err(WireError::Value(number)),
            }
        }
        pid::DEADLINE => qos.deadline = value.duration()?.finite(),
        pid::LIFESPAN => qos.lifespan = value.duration()?.finite(),
        pid::LIVELINESS => {
            qos.liveliness = match value.u32()? {
                0 => Liveliness::Automatic,
                1 => Liveliness::ManualByParticipant,
                2 => Liveliness::ManualByTopic,
                _ => return Err(WireError::Value(number)),
            };
            qos.lease = value.duration()?.finite();
        }
        pid::DATA_REPRESENTATION => {
            let mut numbers = Vec::new();
            for _ in 0..value.u32()?.min(MOST_REPRESENTATIONS) {
                numbers.push(value.u16()?);
            }
            qos.representations = Representations::of(&numbers);
        }
        _ => {}
    }
    Ok(())
}
