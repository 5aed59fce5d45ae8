//! Keys of discovery samples: which participant or endpoint a sample is about, even if it only reports its disposal
//! (9.6.4.8).

use bytes::Bytes;

use crate::wire::{Data, ParameterWriter, list_header, next_parameter, parameter_list, pid};
use crate::{EntityId, Guid};

/// Returns the GUID that a sample is about, from its key hash, which is the GUID itself, or from its payload, which may
/// be complete or only a key.
pub fn guid_of_key(data: &Data) -> Option<Guid> {
    data.inline.key_hash.map(Guid::from).or_else(|| data.payload.as_ref().and_then(guid_of_payload))
}

fn guid_of_payload(payload: &Bytes) -> Option<Guid> {
    const GUID_PARAMETERS: [u16; 3] = [pid::ENDPOINT_GUID, pid::KEY_HASH, pid::PARTICIPANT_GUID];
    let mut input = parameter_list(payload).ok()?;
    let mut guids = [None; GUID_PARAMETERS.len()];
    while let Some((number, mut value)) = next_parameter(&mut input, &GUID_PARAMETERS).ok()? {
        let rank = GUID_PARAMETERS.iter().position(|known| *known == number)?;
        guids[rank] = Some(value.guid().ok()?);
    }
    // Endpoint data also contains the GUID of the participant.
    guids.into_iter().flatten().next()
}

/// Encodes the payload of a sample that disposes of a participant or endpoint: only its key. Such a sample must also
/// have the key hash in its inline QoS, because Fast DDS looks at nothing else.
pub fn key_payload(guid: Guid) -> Bytes {
    let mut bytes = list_header();
    let mut list = ParameterWriter::new(&mut bytes);
    let is_participant = guid.entity == EntityId::PARTICIPANT;
    list.guid(if is_participant { pid::PARTICIPANT_GUID } else { pid::ENDPOINT_GUID }, guid);
    list.end();
    bytes.into()
}
