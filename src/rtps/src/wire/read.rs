//! Reading of the submessages of a datagram (8.3.4, 9.4.5).

use bytes::Bytes;

use super::{
    AckNack, Data, DataFrag, Gap, HEADER, Heartbeat, HeartbeatFrag, InlineQos, MOST_SUBMESSAGES, NackFrag, Parsed,
    ReceivedSubmessage, Submessage, WireError, WireReader, kind, next_parameter, pid,
};
use crate::sequence::{NumberSet, SPAN};
use crate::time::WireTime;
use crate::{EntityId, GuidPrefix, SequenceNumber, SequenceSet, VendorId};

/// Parses a datagram. Unknown submessages are skipped; the first invalid one ends the datagram, and those before it are
/// valid (8.3.4.1). Payloads share the memory of the datagram.
pub fn parse(datagram: &Bytes) -> Parsed {
    let mut parsed = Parsed::default();
    parsed.fault = read_submessages(datagram, &mut parsed.received).err();
    parsed
}

fn read_submessages(datagram: &Bytes, received: &mut Vec<ReceivedSubmessage>) -> Result<(), WireError> {
    let mut input = WireReader::new(datagram, false);
    let mut said = SubmessageContext::from_header(&mut input).ok_or(WireError::NotRtps)?;
    for _ in 0..MOST_SUBMESSAGES {
        if input.remaining() == 0 {
            return Ok(());
        }
        let (kind, flags, body) = next_submessage(&mut input)?;
        if let Some(submessage) = said.read_submessage(kind, flags, body)? {
            let SubmessageContext { from, vendor, to, written } = said;
            received.push(ReceivedSubmessage { from, vendor, to, written, submessage });
        }
    }
    if input.remaining() == 0 { Ok(()) } else { Err(WireError::TooMany) }
}

/// Reads the next submessage: its id, its flags and its body.
fn next_submessage<'a>(input: &mut WireReader<'a>) -> Result<(u8, u8, WireReader<'a>), WireError> {
    let [kind, flags] = input.array()?;
    input.little = flags & 1 != 0;
    let length = usize::from(input.u16()?);
    let to_the_end = length == 0 && !matches!(kind, kind::PAD | kind::INFO_TS);
    let body = input.split_to(if to_the_end { input.remaining() } else { length })?;
    // Submessages start at multiples of four bytes, also after one without a length.
    let filler = input.position().next_multiple_of(4) - input.position();
    input.skip(filler.min(input.remaining()))?;
    Ok((kind, flags, body))
}

/// Context of a submessage, given by the ones before it (8.3.4).
#[derive(Clone, Copy)]
struct SubmessageContext {
    from: GuidPrefix,
    vendor: VendorId,
    to: Option<GuidPrefix>,
    written: Option<WireTime>,
}

impl SubmessageContext {
    /// Reads the header of a datagram; `None` if it is not RTPS 2.
    fn from_header(input: &mut WireReader) -> Option<Self> {
        let [protocol @ .., major, _minor] = input.array::<6>().ok()?;
        let vendor = VendorId(input.array().ok()?);
        let from = input.prefix().ok()?;
        debug_assert_eq!(input.position(), HEADER);
        (protocol == *b"RTPS" && major == 2).then_some(Self { from, vendor, to: None, written: None })
    }

    /// Reads a submessage. Returns `None` if it only changes the context or is unknown.
    fn read_submessage(&mut self, kind: u8, flags: u8, mut body: WireReader) -> Result<Option<Submessage>, WireError> {
        let input = &mut body;
        match kind {
            kind::INFO_TS => {
                self.written = if flags & 2 != 0 { None } else { Some(input.time()?).filter(|time| *time != NEVER) };
            }
            kind::INFO_SRC => {
                input.skip(4)?;
                let [major, _minor] = input.array()?;
                self.vendor = VendorId(input.array()?);
                self.from = input.prefix()?;
                if major != 2 {
                    return Err(WireError::NotRtps);
                }
                // 8.3.7.9: the timestamp is reset.
                self.written = None;
            }
            kind::INFO_DST => {
                self.to = Some(input.prefix()?).filter(|prefix| *prefix != GuidPrefix::UNKNOWN);
            }
            kind::DATA => return data(flags, input),
            kind::DATA_FRAG => return data_frag(flags, input),
            kind::HEARTBEAT => return heartbeat(flags, input).map(Some),
            kind::HEARTBEAT_FRAG => return heartbeat_frag(input).map(Some),
            kind::ACKNACK => return acknack(flags, input).map(Some),
            kind::NACK_FRAG => return nack_frag(input).map(Some),
            kind::GAP => return gap(input).map(Some),
            _ => {}
        }
        Ok(None)
    }
}

/// The time value that means unknown (9.3.2.1).
const NEVER: WireTime = WireTime { seconds: u32::MAX, fraction: u32::MAX };

/// Common header of DATA and DATA_FRAG.
struct DataHeader {
    reader: EntityId,
    writer: EntityId,
    number: SequenceNumber,
}

/// Reads the common header. `input` is then positioned at the inline QoS, the returned reader at the other fields
/// before it.
fn read_data_header<'a>(input: &mut WireReader<'a>) -> Result<(DataHeader, WireReader<'a>), WireError> {
    input.skip(2)?;
    // A later version may add fields there, which are skipped.
    let to_inline = usize::from(input.u16()?);
    let mut fixed = input.split_to(to_inline)?;
    let head = DataHeader { reader: fixed.entity()?, writer: fixed.entity()?, number: fixed.sample_number()? };
    Ok((head, fixed))
}

fn data(flags: u8, input: &mut WireReader) -> Result<Option<Submessage>, WireError> {
    // A non-standard payload (flag N) is one of DDS Security.
    if flags & 0x10 != 0 {
        return Ok(None);
    }
    let (DataHeader { reader, writer, number }, _) = read_data_header(input)?;
    let Some(inline) = inline_qos(flags, input)? else {
        return Ok(None);
    };
    // Both flags, data and key, are invalid (8.3.7.2.3).
    let (sample, key_only) = (flags & 4 != 0, flags & 8 != 0);
    if sample && key_only {
        return Err(WireError::Flags(flags));
    }
    let payload = (sample || key_only).then(|| input.to_bytes());
    Ok(Some(Submessage::Data(Data { reader, writer, number, inline, payload, key_only })))
}

fn data_frag(flags: u8, input: &mut WireReader) -> Result<Option<Submessage>, WireError> {
    let (DataHeader { reader, writer, number }, mut fixed) = read_data_header(input)?;
    let (first, count) = (fixed.u32()?, fixed.u16()?);
    let (fragment_size, sample_size) = (fixed.u16()?, fixed.u32()?);
    let length = covered_length(first, count, fragment_size, sample_size).ok_or(WireError::Fragments {
        first,
        count,
        size: fragment_size,
        sample: sample_size,
    })?;
    let Some(inline) = inline_qos(flags, input)? else {
        return Ok(None);
    };
    // The rest of the submessage is padding.
    let payload = input.split_to(length)?.to_bytes();
    let key_only = flags & 4 != 0;
    Ok(Some(Submessage::DataFrag(DataFrag {
        reader,
        writer,
        number,
        inline,
        first,
        count,
        fragment_size,
        sample_size,
        payload,
        key_only,
    })))
}

/// Returns the number of bytes of these fragments; `None` if they are not within the sample.
fn covered_length(first: u32, count: u16, fragment_size: u16, sample_size: u32) -> Option<usize> {
    let size = u64::from(fragment_size);
    let before = u64::from(first.checked_sub(1)?) * size;
    let last = before + u64::from(count.checked_sub(1)?) * size;
    let end = (last + size).min(u64::from(sample_size));
    // The last fragment must begin within the sample, which also excludes empty fragments and samples.
    if last >= end {
        return None;
    }
    usize::try_from(end - before).ok()
}

fn heartbeat(flags: u8, input: &mut WireReader) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let (first, last) = (input.sample_number()?, input.number_at_least(0)?);
    if last.next() < first {
        return Err(WireError::Number(last.0));
    }
    let (is_final, liveliness) = (flags & 2 != 0, flags & 4 != 0);
    Ok(Submessage::Heartbeat(Heartbeat { reader, writer, first, last, count: input.u32()?, is_final, liveliness }))
}

fn heartbeat_frag(input: &mut WireReader) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let (number, last, count) = (input.sample_number()?, input.u32()?, input.u32()?);
    if last == 0 {
        return Err(WireError::Fragments { first: 1, count: 0, size: 0, sample: 0 });
    }
    Ok(Submessage::HeartbeatFrag(HeartbeatFrag { reader, writer, number, last, count }))
}

fn acknack(flags: u8, input: &mut WireReader) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let set = sequence_set(input, 0)?;
    Ok(Submessage::AckNack(AckNack { reader, writer, set, count: input.u32()?, is_final: flags & 2 != 0 }))
}

fn nack_frag(input: &mut WireReader) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let number = input.sample_number()?;
    let base = input.u32()?;
    let set = number_set(base, input)?;
    if base == 0 || set.bits > 0 && base.checked_add(set.bits - 1).is_none() {
        return Err(WireError::Set(set.bits));
    }
    Ok(Submessage::NackFrag(NackFrag { reader, writer, number, set, count: input.u32()? }))
}

fn gap(input: &mut WireReader) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let start = input.sample_number()?;
    Ok(Submessage::Gap(Gap { reader, writer, start, set: sequence_set(input, 1)? }))
}

/// Reads a set of sequence numbers whose base is at least `least`.
fn sequence_set(input: &mut WireReader, least: i64) -> Result<SequenceSet, WireError> {
    number_set(input.number_at_least(least)?, input)
}

/// Reads a set after its base: the number of bits and the words.
fn number_set<N: Copy>(base: N, input: &mut WireReader) -> Result<NumberSet<N>, WireError> {
    let bits = input.u32()?;
    if bits > SPAN {
        return Err(WireError::Set(bits));
    }
    let mut words = [0; (SPAN / 32) as usize];
    let words = &mut words[..bits.div_ceil(32) as usize];
    for word in words.iter_mut() {
        *word = input.u32()?;
    }
    NumberSet::from_words(base, bits, words).ok_or(WireError::Set(bits))
}

/// Reads the inline QoS if the flags announce it. Returns `None` if it contains an unknown parameter that must be
/// understood, in which case the sample must not be used.
fn inline_qos(flags: u8, input: &mut WireReader) -> Result<Option<InlineQos>, WireError> {
    let mut inline = InlineQos::default();
    if flags & 2 == 0 {
        return Ok(Some(inline));
    }
    loop {
        match next_parameter(input, &INLINE) {
            Ok(None) => return Ok(Some(inline)),
            Ok(Some((number, value))) => inline.set_parameter(number, value)?,
            Err(WireError::NotUnderstood(_)) => return Ok(None),
            Err(error) => return Err(error),
        }
    }
}

const INLINE: [u16; 4] =
    [pid::RELATED_SAMPLE_IDENTITY, pid::FAST_DDS_RELATED_SAMPLE_IDENTITY, pid::STATUS_INFO, pid::KEY_HASH];

impl InlineQos {
    /// Sets one of these parameters.
    pub(super) fn set_parameter(&mut self, number: u16, mut value: WireReader) -> Result<(), WireError> {
        match number {
            pid::RELATED_SAMPLE_IDENTITY => self.related = Some(value.identity()?),
            // Redundant if the standard parameter is present.
            pid::FAST_DDS_RELATED_SAMPLE_IDENTITY => self.related = self.related.or(Some(value.identity()?)),
            // The flags are in the last byte, in either byte order (9.6.4.9).
            pid::STATUS_INFO => self.status = u32::from_be_bytes(value.array()?),
            pid::KEY_HASH => self.key_hash = Some(value.array()?),
            _ => {}
        }
        Ok(())
    }
}
