//! A datagram's submessages, read in order (8.3.4, 9.4.5).

use bytes::Bytes;

use super::{
    AckNack, Data, DataFrag, Gap, HEADER, Heartbeat, HeartbeatFrag, InlineQos, Input,
    MOST_SUBMESSAGES, NackFrag, Parsed, Received, Submessage, WireError, kind, parameter, pid,
};
use crate::sequence::{NumberSet, SPAN};
use crate::time::WireTime;
use crate::{EntityId, GuidPrefix, SequenceNumber, SequenceSet, VendorId};

/// Reads what a datagram says. Submessages of unknown kinds are passed over; the first that is not as it should be ends the
/// datagram, and what came before it stands (8.3.4.1). Payloads share the datagram's memory.
pub fn parse(datagram: &Bytes) -> Parsed {
    let mut parsed = Parsed::default();
    parsed.fault = read(datagram, &mut parsed.received).err();
    parsed
}

fn read(datagram: &Bytes, received: &mut Vec<Received>) -> Result<(), WireError> {
    let mut input = Input::new(datagram, false);
    let mut said = Said::header(&mut input).ok_or(WireError::NotRtps)?;
    for _ in 0..MOST_SUBMESSAGES {
        if input.left() == 0 {
            return Ok(());
        }
        let (kind, flags, body) = next(&mut input)?;
        if let Some(submessage) = said.submessage(kind, flags, body)? {
            let Said {
                from,
                vendor,
                to,
                written,
            } = said;
            received.push(Received {
                from,
                vendor,
                to,
                written,
                submessage,
            });
        }
    }
    if input.left() == 0 {
        Ok(())
    } else {
        Err(WireError::TooMany)
    }
}

/// The next submessage: its kind, its flags, and what stands behind its header.
fn next<'a>(input: &mut Input<'a>) -> Result<(u8, u8, Input<'a>), WireError> {
    let [kind, flags] = input.array()?;
    input.little = flags & 1 != 0;
    let length = usize::from(input.u16()?);
    let to_the_end = length == 0 && !matches!(kind, kind::PAD | kind::INFO_TS);
    let body = input.part(if to_the_end { input.left() } else { length })?;
    // Each begins at a multiple of four bytes, also behind one whose length is none.
    let filler = input.position().next_multiple_of(4) - input.position();
    input.skip(filler.min(input.left()))?;
    Ok((kind, flags, body))
}

/// What holds for a submessage because of those before it (8.3.4).
#[derive(Clone, Copy)]
struct Said {
    from: GuidPrefix,
    vendor: VendorId,
    to: Option<GuidPrefix>,
    written: Option<WireTime>,
}

impl Said {
    /// By the datagram's header; none where it is not one of RTPS 2.
    fn header(input: &mut Input) -> Option<Self> {
        let [protocol @ .., major, _minor] = input.array::<6>().ok()?;
        let vendor = VendorId(input.array().ok()?);
        let from = input.prefix().ok()?;
        debug_assert_eq!(input.position(), HEADER);
        (protocol == *b"RTPS" && major == 2).then_some(Self {
            from,
            vendor,
            to: None,
            written: None,
        })
    }

    /// Reads a submessage. None where it only says something of those behind it, or is not known.
    fn submessage(
        &mut self,
        kind: u8,
        flags: u8,
        mut body: Input,
    ) -> Result<Option<Submessage>, WireError> {
        let input = &mut body;
        match kind {
            kind::INFO_TS => {
                self.written = if flags & 2 != 0 {
                    None
                } else {
                    Some(input.time()?).filter(|time| *time != NEVER)
                };
            }
            kind::INFO_SRC => {
                input.skip(4)?;
                let [major, _minor] = input.array()?;
                self.vendor = VendorId(input.array()?);
                self.from = input.prefix()?;
                if major != 2 {
                    return Err(WireError::NotRtps);
                }
                // 8.3.7.9: what was said of the time is forgotten.
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

/// How a sender says that it does not know the time (9.3.2.1).
const NEVER: WireTime = WireTime {
    seconds: u32::MAX,
    fraction: u32::MAX,
};

/// What DATA and DATA_FRAG begin with.
struct Head {
    reader: EntityId,
    writer: EntityId,
    number: SequenceNumber,
}

/// Reads it. `input` is left at the inline QoS, the second at what else stands before that.
fn head<'a>(input: &mut Input<'a>) -> Result<(Head, Input<'a>), WireError> {
    input.skip(2)?;
    // A later version may put more there; it is passed over.
    let to_inline = usize::from(input.u16()?);
    let mut fixed = input.part(to_inline)?;
    let head = Head {
        reader: fixed.entity()?,
        writer: fixed.entity()?,
        number: fixed.sample()?,
    };
    Ok((head, fixed))
}

fn data(flags: u8, input: &mut Input) -> Result<Option<Submessage>, WireError> {
    // A payload of another form (flag N) is one of RTPS's security.
    if flags & 0x10 != 0 {
        return Ok(None);
    }
    let (
        Head {
            reader,
            writer,
            number,
        },
        _,
    ) = head(input)?;
    let Some(inline) = inline(flags, input)? else {
        return Ok(None);
    };
    // Both flags, sample and key, is what there must not be (8.3.7.2.3).
    let (sample, key_only) = (flags & 4 != 0, flags & 8 != 0);
    if sample && key_only {
        return Err(WireError::Flags(flags));
    }
    let payload = (sample || key_only).then(|| input.shared());
    Ok(Some(Submessage::Data(Data {
        reader,
        writer,
        number,
        inline,
        payload,
        key_only,
    })))
}

fn data_frag(flags: u8, input: &mut Input) -> Result<Option<Submessage>, WireError> {
    let (
        Head {
            reader,
            writer,
            number,
        },
        mut fixed,
    ) = head(input)?;
    let (first, count) = (fixed.u32()?, fixed.u16()?);
    let (fragment_size, sample_size) = (fixed.u16()?, fixed.u32()?);
    let length = covered(first, count, fragment_size, sample_size).ok_or(WireError::Fragments {
        first,
        count,
        size: fragment_size,
        sample: sample_size,
    })?;
    let Some(inline) = inline(flags, input)? else {
        return Ok(None);
    };
    // What is behind them fills the submessage up.
    let payload = input.part(length)?.shared();
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

/// How many bytes of a sample these fragments are; none where they are not all in it.
fn covered(first: u32, count: u16, fragment_size: u16, sample_size: u32) -> Option<usize> {
    let size = u64::from(fragment_size);
    let before = u64::from(first.checked_sub(1)?) * size;
    let last = before + u64::from(count.checked_sub(1)?) * size;
    let end = (last + size).min(u64::from(sample_size));
    // The last one must begin within the sample. Pieces or samples of no bytes are out by this as well.
    if last >= end {
        return None;
    }
    usize::try_from(end - before).ok()
}

fn heartbeat(flags: u8, input: &mut Input) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let (first, last) = (input.sample()?, input.number_from(0)?);
    if last.next() < first {
        return Err(WireError::Number(last.0));
    }
    let (is_final, liveliness) = (flags & 2 != 0, flags & 4 != 0);
    Ok(Submessage::Heartbeat(Heartbeat {
        reader,
        writer,
        first,
        last,
        count: input.u32()?,
        is_final,
        liveliness,
    }))
}

fn heartbeat_frag(input: &mut Input) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let (number, last, count) = (input.sample()?, input.u32()?, input.u32()?);
    if last == 0 {
        return Err(WireError::Fragments {
            first: 1,
            count: 0,
            size: 0,
            sample: 0,
        });
    }
    Ok(Submessage::HeartbeatFrag(HeartbeatFrag {
        reader,
        writer,
        number,
        last,
        count,
    }))
}

fn acknack(flags: u8, input: &mut Input) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let set = numbers(input, 0)?;
    Ok(Submessage::AckNack(AckNack {
        reader,
        writer,
        set,
        count: input.u32()?,
        is_final: flags & 2 != 0,
    }))
}

fn nack_frag(input: &mut Input) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let number = input.sample()?;
    let base = input.u32()?;
    let set = set(base, input)?;
    if base == 0 || set.bits > 0 && base.checked_add(set.bits - 1).is_none() {
        return Err(WireError::Set(set.bits));
    }
    Ok(Submessage::NackFrag(NackFrag {
        reader,
        writer,
        number,
        set,
        count: input.u32()?,
    }))
}

fn gap(input: &mut Input) -> Result<Submessage, WireError> {
    let (reader, writer) = (input.entity()?, input.entity()?);
    let start = input.sample()?;
    Ok(Submessage::Gap(Gap {
        reader,
        writer,
        start,
        set: numbers(input, 1)?,
    }))
}

/// A set of numbers of samples whose base is at least this.
fn numbers(input: &mut Input, least: i64) -> Result<SequenceSet, WireError> {
    set(input.number_from(least)?, input)
}

/// What stands behind a set's base: how many bits, and their words.
fn set<N: Copy>(base: N, input: &mut Input) -> Result<NumberSet<N>, WireError> {
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

/// The inline QoS where the flags say that there is one. None where it has something that is to be understood and is not:
/// the sample must then not be used.
fn inline(flags: u8, input: &mut Input) -> Result<Option<InlineQos>, WireError> {
    let mut inline = InlineQos::default();
    if flags & 2 == 0 {
        return Ok(Some(inline));
    }
    loop {
        match parameter(input, &INLINE) {
            Ok(None) => return Ok(Some(inline)),
            Ok(Some((number, value))) => inline.take(number, value)?,
            Err(WireError::NotUnderstood(_)) => return Ok(None),
            Err(error) => return Err(error),
        }
    }
}

const INLINE: [u16; 4] = [
    pid::RELATED_SAMPLE_IDENTITY,
    pid::FAST_DDS_RELATED_SAMPLE_IDENTITY,
    pid::STATUS_INFO,
    pid::KEY_HASH,
];

impl InlineQos {
    /// Takes one of those parameters.
    pub(super) fn take(&mut self, number: u16, mut value: Input) -> Result<(), WireError> {
        match number {
            pid::RELATED_SAMPLE_IDENTITY => self.related = Some(value.identity()?),
            // Beside the standard's it says the same.
            pid::FAST_DDS_RELATED_SAMPLE_IDENTITY => {
                self.related = self.related.or(Some(value.identity()?))
            }
            // The bits of the last byte, whatever the byte order (9.6.4.9).
            pid::STATUS_INFO => self.status = u32::from_be_bytes(value.array()?),
            pid::KEY_HASH => self.key_hash = Some(value.array()?),
            _ => {}
        }
        Ok(())
    }
}
