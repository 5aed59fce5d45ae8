//! Encoding of QoS policies as parameters (9.6.3.2; defaults in DDS 1.4, 2.2.3).

use std::time::Duration;

use crate::qos::{DurabilityKind, EndpointQos, HistoryKind, LivelinessKind, ReliabilityKind, Representations};
use crate::wire::{ParameterWriter, WireError, WireReader, pid};

/// Maximum blocking time of a writer, which only the writer itself uses. Default of DDS.
const MAX_BLOCKING: Duration = Duration::from_millis(100);

/// Maximum number of data representations read; three are defined.
const MOST_REPRESENTATIONS: u32 = 8;

/// Parameters that [`set_parameter`] handles.
pub(super) const KNOWN_PARAMETERS: [u16; 7] = [
    pid::RELIABILITY,
    pid::DURABILITY,
    pid::HISTORY,
    pid::DEADLINE,
    pid::LIFESPAN,
    pid::LIVELINESS,
    pid::DATA_REPRESENTATION,
];

/// Returns the default QoS of a writer or reader.
pub(super) fn default_qos(is_writer: bool) -> EndpointQos {
    EndpointQos {
        reliability: if is_writer { ReliabilityKind::Reliable } else { ReliabilityKind::BestEffort },
        durability: DurabilityKind::Volatile,
        history: HistoryKind::KeepLast(1),
        deadline: None,
        lifespan: None,
        liveliness: LivelinessKind::Automatic,
        lease: None,
        representations: Representations::XCDR1,
    }
}

/// Writes all policies.
pub(super) fn write_qos(qos: &EndpointQos, list: &mut ParameterWriter) {
    let reliability = match qos.reliability {
        ReliabilityKind::BestEffort => 1,
        ReliabilityKind::Reliable => 2,
    };
    list.kind_and_duration(pid::RELIABILITY, reliability, Some(MAX_BLOCKING));
    let durability = match qos.durability {
        DurabilityKind::Volatile => 0,
        DurabilityKind::TransientLocal => 1,
        DurabilityKind::Transient => 2,
        DurabilityKind::Persistent => 3,
    };
    list.u32(pid::DURABILITY, durability);
    let (kind, depth) = match qos.history {
        // The depth is signed on the wire.
        HistoryKind::KeepLast(depth) => (0, depth.clamp(1, i32::MAX as u32)),
        HistoryKind::KeepAll => (1, 0),
    };
    list.pair(pid::HISTORY, kind, depth);
    list.duration(pid::DEADLINE, qos.deadline);
    list.duration(pid::LIFESPAN, qos.lifespan);
    let liveliness = match qos.liveliness {
        LivelinessKind::Automatic => 0,
        LivelinessKind::ManualByParticipant => 1,
        LivelinessKind::ManualByTopic => 2,
    };
    list.kind_and_duration(pid::LIVELINESS, liveliness, qos.lease);
    if qos.representations != Representations::XCDR1 {
        let numbers: Vec<u16> = qos.representations.numbers().collect();
        let mut value = (numbers.len() as u32).to_le_bytes().to_vec();
        value.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        list.raw(pid::DATA_REPRESENTATION, &value);
    }
}

/// Sets one policy from its parameter.
pub(super) fn set_parameter(qos: &mut EndpointQos, number: u16, mut value: WireReader) -> Result<(), WireError> {
    match number {
        pid::RELIABILITY => {
            qos.reliability = match value.u32()? {
                1 => ReliabilityKind::BestEffort,
                2 => ReliabilityKind::Reliable,
                _ => return Err(WireError::Value(number)),
            }
        }
        pid::DURABILITY => {
            qos.durability = match value.u32()? {
                0 => DurabilityKind::Volatile,
                1 => DurabilityKind::TransientLocal,
                2 => DurabilityKind::Transient,
                3 => DurabilityKind::Persistent,
                _ => return Err(WireError::Value(number)),
            }
        }
        pid::HISTORY => {
            qos.history = match (value.u32()?, value.i32()?) {
                // A depth of 0 is not an error: it only describes the remote endpoint.
                (0, depth) => HistoryKind::KeepLast(u32::try_from(depth).unwrap_or(0).max(1)),
                (1, _) => HistoryKind::KeepAll,
                _ => return Err(WireError::Value(number)),
            }
        }
        pid::DEADLINE => qos.deadline = value.duration()?.finite(),
        pid::LIFESPAN => qos.lifespan = value.duration()?.finite(),
        pid::LIVELINESS => {
            qos.liveliness = match value.u32()? {
                0 => LivelinessKind::Automatic,
                1 => LivelinessKind::ManualByParticipant,
                2 => LivelinessKind::ManualByTopic,
                _ => return Err(WireError::Value(number)),
            };
            qos.lease = value.duration()?.finite();
        }
        pid::DATA_REPRESENTATION => {
            let mut numbers = Vec::new();
            for _ in 0..value.u32()?.min(MOST_REPRESENTATIONS) {
                numbers.push(value.u16()?);
            }
            qos.representations = Representations::from_numbers(&numbers);
        }
        _ => {}
    }
    Ok(())
}
