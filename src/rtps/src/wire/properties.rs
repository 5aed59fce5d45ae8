//! Written datagrams are read unchanged; reading of arbitrary input terminates and yields no more than the datagram.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

use super::*;
use crate::sequence::{NumberSet, SPAN};
use crate::{Guid, SequenceNumber};

pub(crate) fn prefix() -> impl Strategy<Value = GuidPrefix> {
    any::<[u8; 12]>().prop_filter("it is somebody's", |bytes| *bytes != [0; 12]).prop_map(GuidPrefix)
}

pub(crate) fn guid() -> impl Strategy<Value = Guid> {
    (prefix(), any::<[u8; 4]>()).prop_map(|(prefix, entity)| Guid::new(prefix, EntityId(entity)))
}

fn entity() -> impl Strategy<Value = EntityId> {
    any::<[u8; 4]>().prop_map(EntityId)
}

fn number() -> impl Strategy<Value = SequenceNumber> {
    prop_oneof![1i64..1000, 1i64..1 << 62].prop_map(SequenceNumber)
}

fn set<N: Copy + std::fmt::Debug>(base: impl Strategy<Value = N>) -> impl Strategy<Value = NumberSet<N>> {
    (base, 0..=SPAN).prop_flat_map(|(base, bits)| {
        let words = vec(any::<u32>(), bits.div_ceil(32) as usize);
        words.prop_map(move |words| NumberSet::from_words(base, bits, &words).expect("they fit"))
    })
}

fn inline() -> impl Strategy<Value = InlineQos> {
    let related =
        (guid(), any::<i64>()).prop_map(|(writer, number)| SampleIdentity { writer, number: SequenceNumber(number) });
    (option::of(related), 0u32..4, option::of(any::<[u8; 16]>())).prop_map(|(related, status, key_hash)| InlineQos {
        related,
        status,
        key_hash,
    })
}

fn payload() -> impl Strategy<Value = Bytes> {
    vec(any::<u8>(), 0..100).prop_map(Bytes::from)
}

fn data() -> impl Strategy<Value = Submessage> {
    (entity(), entity(), number(), inline(), option::of(payload()), any::<bool>()).prop_map(
        |(reader, writer, number, inline, payload, key_only)| {
            let key_only = key_only && payload.is_some();
            Submessage::Data(Data { reader, writer, number, inline, payload, key_only })
        },
    )
}

fn data_frag() -> impl Strategy<Value = DataFrag> {
    let lengths = (1u32..40, 1u16..5, 1u16..40, any::<prop::sample::Index>());
    (entity(), entity(), number(), inline(), lengths, any::<bool>()).prop_map(
        |(reader, writer, number, inline, (first, count, fragment_size, tail), key_only)| {
            let size = u32::from(fragment_size);
            let begin = (first - 1) * size;
            // The sample ends within or after the last fragment.
            let sample_size = begin + (u32::from(count) - 1) * size + 1 + tail.index(2 * fragment_size as usize) as u32;
            let end = sample_size.min(begin + u32::from(count) * size);
            let payload = (begin..end).map(|at| at as u8).collect();
            DataFrag { reader, writer, number, inline, first, count, fragment_size, sample_size, payload, key_only }
        },
    )
}

fn submessage() -> impl Strategy<Value = Submessage> {
    let beat = (entity(), entity(), number(), 0i64..1000, any::<u32>(), any::<bool>(), any::<bool>()).prop_map(
        |(reader, writer, first, more, count, is_final, liveliness)| {
            let last = SequenceNumber((first.0 - 1 + more).min((1 << 62) - 1));
            Submessage::Heartbeat(Heartbeat { reader, writer, first, last, count, is_final, liveliness })
        },
    );
    let beat_frag =
        (entity(), entity(), number(), 1u32.., any::<u32>()).prop_map(|(reader, writer, number, last, count)| {
            Submessage::HeartbeatFrag(HeartbeatFrag { reader, writer, number, last, count })
        });
    let base = prop_oneof![Just(SequenceNumber(0)), number()];
    let acknack = (entity(), entity(), set(base), any::<u32>(), any::<bool>()).prop_map(
        |(reader, writer, set, count, is_final)| Submessage::AckNack(AckNack { reader, writer, set, count, is_final }),
    );
    let fragments = set(1u32..u32::MAX - SPAN);
    let nack_frag =
        (entity(), entity(), number(), fragments, any::<u32>()).prop_map(|(reader, writer, number, set, count)| {
            Submessage::NackFrag(NackFrag { reader, writer, number, set, count })
        });
    let gap = (entity(), entity(), number(), set(number()))
        .prop_map(|(reader, writer, start, set)| Submessage::Gap(Gap { reader, writer, start, set }));
    prop_oneof![data(), data_frag().prop_map(Submessage::DataFrag), beat, beat_frag, acknack, nack_frag, gap]
}

/// Generates the submessages of one datagram, each with its context.
fn received_submessages() -> impl Strategy<Value = Vec<ReceivedSubmessage>> {
    let time = (any::<u32>(), 0..u32::MAX).prop_map(|(seconds, fraction)| WireTime { seconds, fraction });
    let one = (option::of(prefix()), option::of(time), submessage());
    (prefix(), vec(one, 0..8)).prop_map(|(from, said)| {
        let (mut to, mut written) = (None, None);
        let said = said.into_iter().map(|(destination, time, submessage)| {
            to = destination.or(to);
            written = time.or(written);
            ReceivedSubmessage { from, vendor: VendorId::OURS, to, written, submessage }
        });
        said.collect()
    })
}

fn write(received: &[ReceivedSubmessage]) -> Bytes {
    let mut writer = DatagramWriter::new(received.first().map_or(GuidPrefix([1; 12]), |first| first.from));
    for ReceivedSubmessage { to, written, submessage, .. } in received {
        if let Some(to) = to {
            writer.destination(*to);
        }
        if let Some(written) = written {
            writer.timestamp(*written);
        }
        match submessage {
            Submessage::Data(data) => writer.data(data),
            Submessage::DataFrag(frag) => writer.data_frag(frag),
            Submessage::Heartbeat(beat) => writer.heartbeat(beat),
            Submessage::HeartbeatFrag(beat) => writer.heartbeat_frag(beat),
            Submessage::AckNack(acknack) => writer.acknack(acknack),
            Submessage::NackFrag(nack) => writer.nack_frag(nack),
            Submessage::Gap(gap) => writer.gap(gap),
        };
    }
    writer.finish().into()
}

/// Pads a payload to a multiple of four bytes, as the writer does.
fn pad_payload(mut received: ReceivedSubmessage) -> ReceivedSubmessage {
    if let Submessage::Data(Data { payload: Some(payload), .. }) = &mut received.submessage {
        let mut bytes = payload.to_vec();
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        *payload = bytes.into();
    }
    received
}

fn payload_length(received: &ReceivedSubmessage) -> usize {
    match &received.submessage {
        Submessage::Data(data) => data.payload.as_ref().map_or(0, Bytes::len),
        Submessage::DataFrag(frag) => frag.payload.len(),
        _ => 0,
    }
}

fn assert_bounded(datagram: &Bytes) -> Parsed {
    let parsed = parse(datagram);
    assert!(parsed.received.len() <= MOST_SUBMESSAGES);
    assert!(parsed.received.iter().map(payload_length).sum::<usize>() <= datagram.len());
    parsed
}

proptest! {
    #[test]
    fn what_is_written_is_read(said in received_submessages()) {
        let parsed = parse(&write(&said));
        prop_assert_eq!(parsed.fault, None);
        prop_assert_eq!(parsed.received, said.into_iter().map(pad_payload).collect::<Vec<_>>());
    }

    #[test]
    fn a_head_is_that_of_what_is_written_whole(frag in data_frag(), from in prefix()) {
        let told = DataFragHead {
            reader: frag.reader,
            writer: frag.writer,
            number: frag.number,
            inline: frag.inline,
            first: frag.first,
            count: frag.count,
            fragment_size: frag.fragment_size,
            sample_size: frag.sample_size,
        };
        let mut head = DatagramWriter::new(from);
        let zeros = head.data_frag_head(&told, frag.payload.len());
        let sent = [&head.finish()[..], &frag.payload, zeros].concat();
        let submessage = Submessage::DataFrag(DataFrag { key_only: false, ..frag });
        let whole = ReceivedSubmessage { from, vendor: VendorId::OURS, to: None, written: None, submessage };
        prop_assert_eq!(Bytes::from(sent), write(&[whole]));
    }

    #[test]
    fn what_is_cut_off_takes_nothing_from_what_is_before_it(said in received_submessages(),
        at in any::<prop::sample::Index>()) {
        let whole = write(&said);
        let cut = whole.slice(..at.index(whole.len() + 1));
        let parsed = assert_bounded(&cut);
        prop_assert!(parse(&whole).received.starts_with(&parsed.received));
    }

    #[test]
    fn any_bytes_are_read_to_their_end(tail in vec(any::<u8>(), 0..300)) {
        let header = DatagramWriter::new(GuidPrefix([1; 12])).finish();
        assert_bounded(&[header, tail.clone()].concat().into());
        assert_bounded(&tail.into());
    }

    #[test]
    fn damaged_datagrams_are_read_to_their_end(
        said in received_submessages(),
        damage in vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut bytes = write(&said).to_vec();
        for (at, byte) in damage {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        assert_bounded(&bytes.into());
    }
}
