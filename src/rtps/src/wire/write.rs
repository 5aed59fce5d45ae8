//! Datagrams as we write them: little endian, every submessage as long as a multiple of four bytes.

use super::{
    AckNack, Data, DataFrag, Gap, HEADER, Heartbeat, HeartbeatFrag, InlineQos, NackFrag,
    ParameterWriter, kind, pid,
};
use crate::sequence::NumberSet;
use crate::time::WireTime;
use crate::{EntityId, FragmentNumber, GuidPrefix, SequenceNumber, VendorId};

/// Of the protocol, as we speak it. Fast DDS 2 and Cyclone DDS speak it too.
pub(crate) const VERSION: [u8; 2] = [2, 3];

const LITTLE: u8 = 1;

static ZEROS: [u8; 3] = [0; 3];

/// DATA_FRAG without its payload, which is sent behind it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DataFragHead {
    /// For which reader; UNKNOWN: all that match.
    pub reader: EntityId,
    /// Of which writer.
    pub writer: EntityId,
    /// The sample's number.
    pub number: SequenceNumber,
    /// What it tells of itself. Each fragment tells it, as any may be the first to come.
    pub inline: InlineQos,
    /// The first fragment's number; the first of a sample is 1.
    pub first: FragmentNumber,
    /// How many fragments.
    pub count: u16,
    /// How long each is but the sample's last, in bytes.
    pub fragment_size: u16,
    /// How long the whole sample is, in bytes.
    pub sample_size: u32,
}

/// A datagram that is being written.
#[derive(Debug, Clone)]
pub struct DatagramWriter {
    bytes: Vec<u8>,
}

impl DatagramWriter {
    /// Only the header, of a participant of ours.
    pub fn new(prefix: GuidPrefix) -> Self {
        let mut bytes = Vec::with_capacity(256);
        bytes.extend_from_slice(b"RTPS");
        bytes.extend_from_slice(&VERSION);
        bytes.extend_from_slice(&VendorId::OURS.0);
        bytes.extend_from_slice(&prefix.0);
        Self { bytes }
    }

    /// What was written.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// How long it is, in bytes.
    pub fn len(&self) -> usize {
        self.bytes.len()
    }

    /// Whether it is nothing but the header.
    pub fn is_empty(&self) -> bool {
        self.len() == HEADER
    }

    /// For this participant is what follows; UNKNOWN: for everybody.
    pub fn destination(&mut self, prefix: GuidPrefix) -> &mut Self {
        self.submessage(kind::INFO_DST, LITTLE, |bytes| {
            bytes.extend_from_slice(&prefix.0)
        })
    }

    /// When the samples that follow were written.
    pub fn timestamp(&mut self, time: WireTime) -> &mut Self {
        self.submessage(kind::INFO_TS, LITTLE, |bytes| {
            bytes.extend_from_slice(&time.seconds.to_le_bytes());
            bytes.extend_from_slice(&time.fraction.to_le_bytes());
        })
    }

    /// Which samples a writer has.
    pub fn heartbeat(&mut self, heartbeat: &Heartbeat) -> &mut Self {
        let flags = LITTLE | flag(2, heartbeat.is_final) | flag(4, heartbeat.liveliness);
        self.submessage(kind::HEARTBEAT, flags, |bytes| {
            ends(bytes, heartbeat.reader, heartbeat.writer);
            bytes.extend_from_slice(&number_bytes(heartbeat.first));
            bytes.extend_from_slice(&number_bytes(heartbeat.last));
            bytes.extend_from_slice(&heartbeat.count.to_le_bytes());
        })
    }

    /// Which fragments of a sample a writer has.
    pub fn heartbeat_frag(&mut self, heartbeat: &HeartbeatFrag) -> &mut Self {
        self.submessage(kind::HEARTBEAT_FRAG, LITTLE, |bytes| {
            ends(bytes, heartbeat.reader, heartbeat.writer);
            bytes.extend_from_slice(&number_bytes(heartbeat.number));
            bytes.extend_from_slice(&heartbeat.last.to_le_bytes());
            bytes.extend_from_slice(&heartbeat.count.to_le_bytes());
        })
    }

    /// Which samples a reader has and which it misses.
    pub fn acknack(&mut self, acknack: &AckNack) -> &mut Self {
        self.submessage(kind::ACKNACK, LITTLE | flag(2, acknack.is_final), |bytes| {
            ends(bytes, acknack.reader, acknack.writer);
            bytes.extend_from_slice(&number_bytes(acknack.set.base));
            set(bytes, &acknack.set);
            bytes.extend_from_slice(&acknack.count.to_le_bytes());
        })
    }

    /// Which fragments of a sample a reader misses.
    pub fn nack_frag(&mut self, nack: &NackFrag) -> &mut Self {
        self.submessage(kind::NACK_FRAG, LITTLE, |bytes| {
            ends(bytes, nack.reader, nack.writer);
            bytes.extend_from_slice(&number_bytes(nack.number));
            bytes.extend_from_slice(&nack.set.base.to_le_bytes());
            set(bytes, &nack.set);
            bytes.extend_from_slice(&nack.count.to_le_bytes());
        })
    }

    /// Which samples a reader need not wait for.
    pub fn gap(&mut self, gap: &Gap) -> &mut Self {
        self.submessage(kind::GAP, LITTLE, |bytes| {
            ends(bytes, gap.reader, gap.writer);
            bytes.extend_from_slice(&number_bytes(gap.start));
            bytes.extend_from_slice(&number_bytes(gap.set.base));
            set(bytes, &gap.set);
        })
    }

    /// A whole sample with a copy of its payload, which is filled up with zeros to a multiple of four bytes.
    pub fn data(&mut self, data: &Data) -> &mut Self {
        let payload_flag = if data.key_only { 8 } else { 4 };
        let flags = inline_flag(&data.inline) | flag(payload_flag, data.payload.is_some());
        let payload = data.payload.as_deref().unwrap_or_default();
        self.submessage(kind::DATA, flags, |bytes| {
            data_head(bytes, data.reader, data.writer, data.number);
            inline(bytes, &data.inline);
            bytes.extend_from_slice(payload);
        })
    }

    /// Fragments of a sample with a copy of their bytes.
    pub fn data_frag(&mut self, frag: &DataFrag) -> &mut Self {
        let flags = inline_flag(&frag.inline) | flag(4, frag.key_only);
        self.submessage(kind::DATA_FRAG, flags, |bytes| {
            frag_head(bytes, frag.reader, frag.writer, frag.number);
            fragments(
                bytes,
                frag.first,
                frag.count,
                frag.fragment_size,
                frag.sample_size,
            );
            inline(bytes, &frag.inline);
            bytes.extend_from_slice(&frag.payload);
        })
    }

    /// The last submessage of the datagram, fragments of a sample, up to their bytes. Those are to be sent right behind the
    /// datagram, and behind them what is returned: at most three zeros, which the submessage's length counts. Fast DDS sends
    /// them too, and Cyclone DDS refuses a last fragment of less than four bytes.
    #[must_use = "the zeros are part of the datagram"]
    pub fn data_frag_head(&mut self, head: &DataFragHead, payload_length: usize) -> &'static [u8] {
        self.head(
            kind::DATA_FRAG,
            inline_flag(&head.inline),
            payload_length,
            |bytes| {
                frag_head(bytes, head.reader, head.writer, head.number);
                fragments(
                    bytes,
                    head.first,
                    head.count,
                    head.fragment_size,
                    head.sample_size,
                );
                inline(bytes, &head.inline);
            },
        )
    }

    /// A submessage with all that belongs to it.
    fn submessage(&mut self, kind: u8, flags: u8, body: impl FnOnce(&mut Vec<u8>)) -> &mut Self {
        let zeros = self.head(kind, flags, 0, body);
        self.bytes.extend_from_slice(zeros);
        self
    }

    /// A submessage behind which so many bytes come, and the zeros that come behind those.
    fn head(
        &mut self,
        kind: u8,
        flags: u8,
        behind: usize,
        body: impl FnOnce(&mut Vec<u8>),
    ) -> &'static [u8] {
        self.bytes.extend_from_slice(&[kind, flags, 0, 0]);
        let begin = self.bytes.len();
        body(&mut self.bytes);
        let length = self.bytes.len() - begin + behind;
        let padded = length.next_multiple_of(4);
        // 0 says "to the end of the datagram": more than 64 kB is in no datagram of UDP, but what there is stays right.
        let told = u16::try_from(padded).unwrap_or(0);
        self.bytes[begin - 2..begin].copy_from_slice(&told.to_le_bytes());
        &ZEROS[..padded - length]
    }
}

fn flag(flag: u8, set: bool) -> u8 {
    if set { flag } else { 0 }
}

fn inline_flag(told: &InlineQos) -> u8 {
    LITTLE | flag(2, *told != InlineQos::default())
}

/// The high half first, each little endian.
pub(super) fn number_bytes(number: SequenceNumber) -> [u8; 8] {
    let (high, low) = ((number.0 >> 32) as u32, number.0 as u32);
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&high.to_le_bytes());
    bytes[4..].copy_from_slice(&low.to_le_bytes());
    bytes
}

fn ends(bytes: &mut Vec<u8>, reader: EntityId, writer: EntityId) {
    bytes.extend_from_slice(&reader.0);
    bytes.extend_from_slice(&writer.0);
}

fn set<N: Copy>(bytes: &mut Vec<u8>, set: &NumberSet<N>) {
    bytes.extend_from_slice(&set.bits.to_le_bytes());
    for word in set.words() {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
}

/// What DATA begins with: no further flags, 16 bytes to the inline QoS.
fn data_head(bytes: &mut Vec<u8>, reader: EntityId, writer: EntityId, number: SequenceNumber) {
    bytes.extend_from_slice(&[0, 0, 16, 0]);
    ends(bytes, reader, writer);
    bytes.extend_from_slice(&number_bytes(number));
}

/// What DATA_FRAG begins with: no further flags, 28 bytes to the inline QoS.
fn frag_head(bytes: &mut Vec<u8>, reader: EntityId, writer: EntityId, number: SequenceNumber) {
    bytes.extend_from_slice(&[0, 0, 28, 0]);
    ends(bytes, reader, writer);
    bytes.extend_from_slice(&number_bytes(number));
}

fn fragments(
    bytes: &mut Vec<u8>,
    first: FragmentNumber,
    count: u16,
    fragment_size: u16,
    sample_size: u32,
) {
    bytes.extend_from_slice(&first.to_le_bytes());
    bytes.extend_from_slice(&count.to_le_bytes());
    bytes.extend_from_slice(&fragment_size.to_le_bytes());
    bytes.extend_from_slice(&sample_size.to_le_bytes());
}

/// The inline QoS, where there is anything in it.
fn inline(bytes: &mut Vec<u8>, told: &InlineQos) {
    if *told == InlineQos::default() {
        return;
    }
    let mut list = ParameterWriter::new(bytes);
    if let Some(related) = &told.related {
        // As Fast DDS does: readers of the standard look for the one, older Fast DDS for the other.
        list.identity(pid::RELATED_SAMPLE_IDENTITY, related);
        list.identity(pid::FAST_DDS_RELATED_SAMPLE_IDENTITY, related);
    }
    if let Some(hash) = &told.key_hash {
        list.raw(pid::KEY_HASH, hash);
    }
    if told.status != 0 {
        list.raw(pid::STATUS_INFO, &told.status.to_be_bytes());
    }
    list.end();
}
