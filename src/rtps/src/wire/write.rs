//! Writing of datagrams: little-endian, with the length of every submessage a multiple of four bytes.

use super::{
    AckNack, Data, DataFrag, Gap, HEADER, Heartbeat, HeartbeatFrag, InlineQos, NackFrag, ParameterWriter, kind, pid,
};
use crate::sequence::NumberSet;
use crate::time::WireTime;
use crate::{EntityId, FragmentNumber, GuidPrefix, SequenceNumber, VendorId};

/// Protocol version that we announce; also that of Fast DDS 2 and Cyclone DDS.
pub(crate) const VERSION: [u8; 2] = [2, 3];

const LITTLE: u8 = 1;

static ZEROS: [u8; 3] = [0; 3];

/// DATA_FRAG without its payload, which is sent after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DataFragHead {
    /// Destination reader; UNKNOWN: all matched readers.
    pub reader: EntityId,
    /// Sending writer.
    pub writer: EntityId,
    /// Sequence number of the sample.
    pub number: SequenceNumber,
    /// Inline QoS. Every fragment has it, because any may be the first to arrive.
    pub inline: InlineQos,
    /// Number of the first fragment; the first of a sample is 1.
    pub first: FragmentNumber,
    /// Number of fragments.
    pub count: u16,
    /// Size of each fragment except the last of the sample, in bytes.
    pub fragment_size: u16,
    /// Size of the complete sample, in bytes.
    pub sample_size: u32,
}

/// A datagram being written.
#[derive(Debug, Clone)]
pub struct DatagramWriter {
    bytes: Vec<u8>,
}

impl DatagramWriter {
    /// Creates a datagram with only the header of a local participant.
    pub fn new(prefix: GuidPrefix) -> Self {
        let mut bytes = Vec::with_capacity(256);
        bytes.extend_from_slice(b"RTPS");
        bytes.extend_from_slice(&VERSION);
        bytes.extend_from_slice(&VendorId::OURS.0);
        bytes.extend_from_slice(&prefix.0);
        Self { bytes }
    }

    /// Returns the bytes of the datagram.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Returns the length in bytes.
    pub fn len(&self) -> usize {
        self.bytes.len()
    }

    /// Returns whether it contains only the header.
    pub fn is_empty(&self) -> bool {
        self.len() == HEADER
    }

    /// Sets the destination of the following submessages; UNKNOWN: everybody.
    pub fn destination(&mut self, prefix: GuidPrefix) -> &mut Self {
        self.submessage(kind::INFO_DST, LITTLE, |bytes| bytes.extend_from_slice(&prefix.0))
    }

    /// Sets the source timestamp of the following samples.
    pub fn timestamp(&mut self, time: WireTime) -> &mut Self {
        self.submessage(kind::INFO_TS, LITTLE, |bytes| {
            bytes.extend_from_slice(&time.seconds.to_le_bytes());
            bytes.extend_from_slice(&time.fraction.to_le_bytes());
        })
    }

    /// Writes the range of samples that a writer has.
    pub fn heartbeat(&mut self, heartbeat: &Heartbeat) -> &mut Self {
        let flags = LITTLE | flag_if(2, heartbeat.is_final) | flag_if(4, heartbeat.liveliness);
        self.submessage(kind::HEARTBEAT, flags, |bytes| {
            write_entities(bytes, heartbeat.reader, heartbeat.writer);
            bytes.extend_from_slice(&number_bytes(heartbeat.first));
            bytes.extend_from_slice(&number_bytes(heartbeat.last));
            bytes.extend_from_slice(&heartbeat.count.to_le_bytes());
        })
    }

    /// Writes the fragments of a sample that a writer has.
    pub fn heartbeat_frag(&mut self, heartbeat: &HeartbeatFrag) -> &mut Self {
        self.submessage(kind::HEARTBEAT_FRAG, LITTLE, |bytes| {
            write_entities(bytes, heartbeat.reader, heartbeat.writer);
            bytes.extend_from_slice(&number_bytes(heartbeat.number));
            bytes.extend_from_slice(&heartbeat.last.to_le_bytes());
            bytes.extend_from_slice(&heartbeat.count.to_le_bytes());
        })
    }

    /// Writes the samples that a reader has received and misses.
    pub fn acknack(&mut self, acknack: &AckNack) -> &mut Self {
        self.submessage(kind::ACKNACK, LITTLE | flag_if(2, acknack.is_final), |bytes| {
            write_entities(bytes, acknack.reader, acknack.writer);
            bytes.extend_from_slice(&number_bytes(acknack.set.base));
            write_set(bytes, &acknack.set);
            bytes.extend_from_slice(&acknack.count.to_le_bytes());
        })
    }

    /// Writes the fragments of a sample that a reader misses.
    pub fn nack_frag(&mut self, nack: &NackFrag) -> &mut Self {
        self.submessage(kind::NACK_FRAG, LITTLE, |bytes| {
            write_entities(bytes, nack.reader, nack.writer);
            bytes.extend_from_slice(&number_bytes(nack.number));
            bytes.extend_from_slice(&nack.set.base.to_le_bytes());
            write_set(bytes, &nack.set);
            bytes.extend_from_slice(&nack.count.to_le_bytes());
        })
    }

    /// Writes the samples that a reader need not wait for.
    pub fn gap(&mut self, gap: &Gap) -> &mut Self {
        self.submessage(kind::GAP, LITTLE, |bytes| {
            write_entities(bytes, gap.reader, gap.writer);
            bytes.extend_from_slice(&number_bytes(gap.start));
            bytes.extend_from_slice(&number_bytes(gap.set.base));
            write_set(bytes, &gap.set);
        })
    }

    /// Writes a complete sample with a copy of its payload, padded with zeros to a multiple of four bytes.
    pub fn data(&mut self, data: &Data) -> &mut Self {
        let payload_flag = if data.key_only { 8 } else { 4 };
        let flags = inline_flag(&data.inline) | flag_if(payload_flag, data.payload.is_some());
        let payload = data.payload.as_deref().unwrap_or_default();
        self.submessage(kind::DATA, flags, |bytes| {
            write_data_header(bytes, data.reader, data.writer, data.number);
            write_inline_qos(bytes, &data.inline);
            bytes.extend_from_slice(payload);
        })
    }

    /// Writes fragments of a sample with a copy of their bytes.
    pub fn data_frag(&mut self, frag: &DataFrag) -> &mut Self {
        let flags = inline_flag(&frag.inline) | flag_if(4, frag.key_only);
        self.submessage(kind::DATA_FRAG, flags, |bytes| {
            write_frag_header(bytes, frag.reader, frag.writer, frag.number);
            write_fragment_info(bytes, frag.first, frag.count, frag.fragment_size, frag.sample_size);
            write_inline_qos(bytes, &frag.inline);
            bytes.extend_from_slice(&frag.payload);
        })
    }

    /// Writes the last submessage of the datagram, fragments of a sample, without their bytes. The bytes must be sent
    /// right after the datagram, followed by the returned padding of at most three zeros, which is part of the
    /// submessage's length. Fast DDS does the same, and Cyclone DDS rejects a last fragment of less than four bytes.
    #[must_use = "the zeros are part of the datagram"]
    pub fn data_frag_head(&mut self, head: &DataFragHead, payload_length: usize) -> &'static [u8] {
        self.submessage_header(kind::DATA_FRAG, inline_flag(&head.inline), payload_length, |bytes| {
            write_frag_header(bytes, head.reader, head.writer, head.number);
            write_fragment_info(bytes, head.first, head.count, head.fragment_size, head.sample_size);
            write_inline_qos(bytes, &head.inline);
        })
    }

    /// Writes a complete submessage.
    fn submessage(&mut self, kind: u8, flags: u8, body: impl FnOnce(&mut Vec<u8>)) -> &mut Self {
        let zeros = self.submessage_header(kind, flags, 0, body);
        self.bytes.extend_from_slice(zeros);
        self
    }

    /// Writes a submessage that is followed by `behind` bytes; returns the padding that must follow those.
    fn submessage_header(
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
        // 0 means "to the end of the datagram": no UDP datagram has more than 64 kB, but the result stays correct.
        let told = u16::try_from(padded).unwrap_or(0);
        self.bytes[begin - 2..begin].copy_from_slice(&told.to_le_bytes());
        &ZEROS[..padded - length]
    }
}

fn flag_if(flag: u8, set: bool) -> u8 {
    if set { flag } else { 0 }
}

fn inline_flag(told: &InlineQos) -> u8 {
    LITTLE | flag_if(2, *told != InlineQos::default())
}

/// The high half first, each little-endian.
pub(super) fn number_bytes(number: SequenceNumber) -> [u8; 8] {
    let (high, low) = ((number.0 >> 32) as u32, number.0 as u32);
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&high.to_le_bytes());
    bytes[4..].copy_from_slice(&low.to_le_bytes());
    bytes
}

fn write_entities(bytes: &mut Vec<u8>, reader: EntityId, writer: EntityId) {
    bytes.extend_from_slice(&reader.0);
    bytes.extend_from_slice(&writer.0);
}

fn write_set<N: Copy>(bytes: &mut Vec<u8>, set: &NumberSet<N>) {
    bytes.extend_from_slice(&set.bits.to_le_bytes());
    for word in set.words() {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
}

/// Writes the header of DATA: no extra flags, 16 bytes to the inline QoS.
fn write_data_header(bytes: &mut Vec<u8>, reader: EntityId, writer: EntityId, number: SequenceNumber) {
    bytes.extend_from_slice(&[0, 0, 16, 0]);
    write_entities(bytes, reader, writer);
    bytes.extend_from_slice(&number_bytes(number));
}

/// Writes the header of DATA_FRAG: no extra flags, 28 bytes to the inline QoS.
fn write_frag_header(bytes: &mut Vec<u8>, reader: EntityId, writer: EntityId, number: SequenceNumber) {
    bytes.extend_from_slice(&[0, 0, 28, 0]);
    write_entities(bytes, reader, writer);
    bytes.extend_from_slice(&number_bytes(number));
}

fn write_fragment_info(bytes: &mut Vec<u8>, first: FragmentNumber, count: u16, fragment_size: u16, sample_size: u32) {
    bytes.extend_from_slice(&first.to_le_bytes());
    bytes.extend_from_slice(&count.to_le_bytes());
    bytes.extend_from_slice(&fragment_size.to_le_bytes());
    bytes.extend_from_slice(&sample_size.to_le_bytes());
}

/// Writes the inline QoS, unless it is empty.
fn write_inline_qos(bytes: &mut Vec<u8>, told: &InlineQos) {
    if *told == InlineQos::default() {
        return;
    }
    let mut list = ParameterWriter::new(bytes);
    if let Some(related) = &told.related {
        // Both, as Fast DDS does: standard readers look for one, older Fast DDS for the other.
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
