//! Which participant or end a sample of discovery is about, also where it says only that it is no more (9.6.4.8).

use bytes::Bytes;

use crate::wire::{Data, ParameterWriter, list, list_header, parameter, pid};
use crate::{EntityId, Guid};

/// Whom it is about: by the hash of its key, which is the GUID itself, or by its payload. Payloads are read whether they
/// are all or only the key.
pub fn guid_of_key(data: &Data) -> Option<Guid> {
    data.inline
        .key_hash
        .map(Guid::from)
        .or_else(|| data.payload.as_ref().and_then(guid_of_payload))
}

fn guid_of_payload(payload: &Bytes) -> Option<Guid> {
    const KNOWN: [u16; 3] = [pid::ENDPOINT_GUID, pid::KEY_HASH, pid::PARTICIPANT_GUID];
    let mut input = list(payload).ok()?;
    let mut guids = [None; KNOWN.len()];
    while let Some((number, mut value)) = parameter(&mut input, &KNOWN).ok()? {
        let rank = KNOWN.iter().position(|known| *known == number)?;
        guids[rank] = Some(value.guid().ok()?);
    }
    // An end tells its participant too.
    guids.into_iter().flatten().next()
}

/// The payload of a sample that says that a participant or end is no more: only its key. Such a sample also has the hash
/// of the key in its inline QoS, as Fast DDS looks at nothing else.
pub fn key(guid: Guid) -> Bytes {
    let mut bytes = list_header();
    let mut list = ParameterWriter::new(&mut bytes);
    let is_participant = guid.entity == EntityId::PARTICIPANT;
    list.guid(
        if is_participant {
            pid::PARTICIPANT_GUID
        } else {
            pid::ENDPOINT_GUID
        },
        guid,
    );
    list.end();
    bytes.into()
}
