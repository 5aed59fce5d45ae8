//! `ros_discovery_info`: the topic on which each participant announces its nodes and their endpoints, because DDS knows
//! no nodes.
//!
//! Source: `rmw_dds_common/msg/{ParticipantEntitiesInfo,NodeEntitiesInfo,Gid}.msg`. A gid has 16 bytes, and 24 in
//! distributions before Iron, of which the last 8 are zero; the type's name is the same.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{DiscoveredGraph, EndpointQos, Guid, GuidPrefix, HistoryKind, ReceivedSample, Sink, TopicDescription};
use tokio::sync::watch;

use super::names;

/// Maximum size of an announcement; larger ones are ignored.
const MAX_BYTES: usize = 1 << 20;
/// Maximum number of participants whose announcements are kept.
const MAX_PARTICIPANTS: usize = 1024;
/// Maximum length of a name or namespace in the definition.
const MAX_NAME: usize = 256;

/// Size of a gid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum GidSize {
    /// Since Iron.
    #[default]
    Sixteen,
    /// Before Iron.
    TwentyFour,
}

impl GidSize {
    fn bytes(self) -> usize {
        match self {
            Self::Sixteen => 16,
            Self::TwentyFour => 24,
        }
    }
}

/// The announcement of one participant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ParticipantEntities {
    /// Nodes; those with invalid names are left out.
    pub(super) nodes: Vec<DiscoveredNode>,
    /// Size of its gids.
    pub(super) gids: GidSize,
}

/// A node and its endpoints.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct DiscoveredNode {
    /// Absolute name.
    pub(super) name: Arc<str>,
    /// Readers of the node.
    pub(super) readers: Vec<Guid>,
    /// Writers of the node.
    pub(super) writers: Vec<Guid>,
}

/// Returns the topic for endpoints of ours.
pub(super) fn topic() -> TopicDescription {
    TopicDescription {
        name: "ros_discovery_info".to_owned(),
        type_name: "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_".to_owned(),
        user_data: Bytes::new(),
    }
}

/// Returns the QoS of its endpoints: participants that join later get the last announcement.
pub(super) fn qos() -> EndpointQos {
    EndpointQos {
        durability: rtps::DurabilityKind::TransientLocal,
        history: HistoryKind::KeepLast(1),
        ..EndpointQos::default()
    }
}

/// The announcements of the other participants.
#[derive(Default)]
pub(super) struct ParticipantTable {
    told: Mutex<HashMap<GuidPrefix, Arc<ParticipantEntities>>>,
    changes: watch::Sender<u64>,
}

impl ParticipantTable {
    /// Returns a counter of changes.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// Returns the current participants and their announcements; forgets the announcements of others.
    pub(super) fn snapshot(
        &self,
        discovered: &watch::Receiver<Arc<DiscoveredGraph>>,
    ) -> (Arc<DiscoveredGraph>, HashMap<GuidPrefix, Arc<ParticipantEntities>>) {
        let mut told = self.told.lock();
        // Read while the lock is held: a participant that has announced something by now was discovered before.
        let now = Arc::clone(&discovered.borrow());
        told.retain(|prefix, _| now.participants.contains_key(prefix));
        (now, told.clone())
    }
}

impl Sink for ParticipantTable {
    fn on_sample(&self, sample: ReceivedSample) {
        let from = sample.writer.prefix;
        let Some(entities) = decode(&sample.payload) else {
            tracing::debug!(participant = ?from, "the list of nodes of a participant cannot be read");
            return;
        };
        {
            let mut told = self.told.lock();
            if told.len() >= MAX_PARTICIPANTS && !told.contains_key(&from) {
                return;
            }
            told.insert(from, Arc::new(entities));
        }
        self.changes.send_modify(|number| *number += 1);
    }
}

/// Decodes an announcement; `None` if it cannot be read.
fn decode(payload: &[u8]) -> Option<ParticipantEntities> {
    let (header, body) = payload.split_first_chunk::<4>()?;
    let big = match header {
        [0, 0, ..] => true,
        [0, 1, ..] => false,
        _ => return None,
    };
    if body.len() > MAX_BYTES {
        return None;
    }
    // A gid of 16 bytes is followed by the number of nodes and, if that is zero, by nothing.
    let padded = body.get(16..24).is_some_and(|rest| rest == [0; 8]);
    let gids = if padded && body.len() >= 28 { GidSize::TwentyFour } else { GidSize::Sixteen };
    let mut cursor = CdrCursor { body, at: 0, big };
    cursor.take(gids.bytes())?;
    let mut nodes = Vec::new();
    for _ in 0..cursor.word()? {
        let (namespace, name) = (cursor.text()?, cursor.text()?);
        let full = format!("{}/{name}", namespace.trim_end_matches('/'));
        let node = DiscoveredNode { name: full.into(), readers: cursor.gids(gids)?, writers: cursor.gids(gids)? };
        if names::is_global(&node.name) {
            nodes.push(node);
        }
    }
    Some(ParticipantEntities { nodes, gids })
}

/// Reads CDR values in order.
struct CdrCursor<'a> {
    body: &'a [u8],
    at: usize,
    big: bool,
}

impl<'a> CdrCursor<'a> {
    fn take(&mut self, size: usize) -> Option<&'a [u8]> {
        let end = self.at.checked_add(size)?;
        let taken = self.body.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }

    fn word(&mut self) -> Option<usize> {
        self.at = self.at.checked_next_multiple_of(4)?;
        let word: [u8; 4] = self.take(4)?.try_into().ok()?;
        let value = if self.big { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) };
        usize::try_from(value).ok()
    }

    fn text(&mut self) -> Option<&'a str> {
        let length = self.word()?;
        if length > MAX_NAME + 1 {
            return None;
        }
        let bytes = self.take(length)?;
        std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes)).ok()
    }

    fn gids(&mut self, size: GidSize) -> Option<Vec<Guid>> {
        let count = self.word()?;
        let bytes = self.take(count.checked_mul(size.bytes())?)?;
        let gids = bytes.chunks_exact(size.bytes());
        gids.map(|gid| Some(Guid::from(*gid.first_chunk::<16>()?))).collect()
    }
}

/// Encodes an announcement with gids of this size.
pub(super) fn encode(participant: Guid, nodes: &[DiscoveredNode], size: GidSize) -> Bytes {
    let mut body = Vec::new();
    put_gid(&mut body, participant, size);
    put_count(&mut body, nodes.len());
    for node in nodes {
        let (namespace, name) = node.name.rsplit_once('/').unwrap_or(("", &*node.name));
        for text in [if namespace.is_empty() { "/" } else { namespace }, name] {
            put_count(&mut body, text.len() + 1);
            body.extend(text.as_bytes());
            body.push(0);
        }
        for ends in [&node.readers, &node.writers] {
            put_count(&mut body, ends.len());
            for end in ends {
                put_gid(&mut body, *end, size);
            }
        }
    }
    let mut payload = vec![0, 1, 0, 0];
    payload.append(&mut body);
    payload.into()
}

fn put_gid(body: &mut Vec<u8>, guid: Guid, size: GidSize) {
    body.extend(guid.bytes());
    body.resize(body.len() + size.bytes() - 16, 0);
}

fn put_count(body: &mut Vec<u8>, count: usize) {
    body.resize(body.len().next_multiple_of(4), 0);
    // Nobody has four billion endpoints.
    body.extend(u32::try_from(count).unwrap_or(u32::MAX).to_le_bytes());
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn guid(number: u8) -> Guid {
        Guid::from([number; 16])
    }

    fn node(name: &str, readers: &[u8], writers: &[u8]) -> DiscoveredNode {
        let guids = |numbers: &[u8]| numbers.iter().copied().map(guid).collect();
        DiscoveredNode { name: name.into(), readers: guids(readers), writers: guids(writers) }
    }

    #[test]
    fn what_is_told_comes_back_in_both_sizes() {
        let some = vec![node("/ns/peer", &[1, 2], &[3]), node("/talker", &[], &[])];
        for nodes in [some, Vec::new()] {
            for gids in [GidSize::Sixteen, GidSize::TwentyFour] {
                let payload = encode(guid(9), &nodes, gids);
                let told = decode(&payload).expect("it can be read");
                assert_eq!(told, ParticipantEntities { nodes: nodes.clone(), gids });
            }
        }
    }

    /// The payload as rmw_fastrtps of Jazzy writes it, according to the definition.
    #[test]
    fn bytes_are_those_of_the_definition() {
        let payload = encode(guid(7), &[node("/a", &[8], &[])], GidSize::Sixteen);
        let mut expected = vec![0, 1, 0, 0];
        expected.extend([7; 16]);
        expected.extend([1, 0, 0, 0]);
        expected.extend([2, 0, 0, 0, b'/', 0, 0, 0]);
        expected.extend([2, 0, 0, 0, b'a', 0, 0, 0]);
        expected.extend([1, 0, 0, 0]);
        expected.extend([8; 16]);
        expected.extend([0, 0, 0, 0]);
        assert_eq!(payload, expected);
    }

    #[test]
    fn big_endian_is_read() {
        let mut payload = vec![0, 0, 0, 0];
        payload.extend([7; 16]);
        payload.extend([0, 0, 0, 1]);
        payload.extend([0, 0, 0, 2, b'/', 0, 0, 0]);
        payload.extend([0, 0, 0, 2, b'a', 0, 0, 0]);
        payload.extend([0; 8]);
        let told = decode(&payload).expect("it can be read");
        assert_eq!(told.nodes, [node("/a", &[], &[])]);
    }

    #[test]
    fn names_that_are_none_are_left_out() {
        let nodes = [node("/a b", &[1], &[]), node("/good", &[2], &[])];
        let told = decode(&encode(guid(9), &nodes, GidSize::Sixteen)).expect("it can be read");
        assert_eq!(told.nodes, [node("/good", &[2], &[])]);
    }

    proptest! {
        #[test]
        fn whatever_comes_is_read_or_refused(payload in proptest::collection::vec(any::<u8>(), 0..400)) {
            let _ = decode(&payload);
        }

        #[test]
        fn what_is_cut_off_or_changed_is_read_or_refused(cut in 0_usize..200, at in 0_usize..200, to: u8) {
            let nodes = [node("/ns/peer", &[1, 2], &[3]), node("/talker", &[], &[4])];
            let mut payload = encode(guid(9), &nodes, GidSize::Sixteen).to_vec();
            if let Some(byte) = payload.get_mut(at) {
                *byte = to;
            }
            payload.truncate(cut);
            let _ = decode(&payload);
        }
    }
}
