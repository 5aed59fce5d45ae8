//! Datagrams byte by byte, as laid out in the specification.

use super::*;
use crate::Guid;

/// Parses pairs of hexadecimal digits; white space is ignored.
pub(crate) fn parse_hex(text: &str) -> Bytes {
    let digits: String = text.split_whitespace().collect();
    let pairs = (0..digits.len()).step_by(2).map(|at| &digits[at..at + 2]);
    pairs.map(|pair| u8::from_str_radix(pair, 16).expect("two digits")).collect()
}

/// Header of a participant of Fast DDS.
const HEAD: &str = "52545053 0203 010f 010f1122 33445566 00000000";
const FROM: GuidPrefix = GuidPrefix([1, 15, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0, 0, 0, 0]);
const READER: EntityId = EntityId([0, 0, 5, 4]);
const WRITER: EntityId = EntityId([0, 0, 4, 3]);
/// Little-endian: numbers 1 to 7, count 3.
const HEARTBEAT: &str = "0701 1c00 00000504 00000403 00000000 01000000 00000000 07000000 03000000";

fn heartbeat() -> Heartbeat {
    Heartbeat {
        reader: READER,
        writer: WRITER,
        first: SequenceNumber(1),
        last: SequenceNumber(7),
        count: 3,
        is_final: false,
        liveliness: false,
    }
}

fn parse_submessages(submessages: &str) -> Parsed {
    parse(&parse_hex(&format!("{HEAD} {submessages}")))
}

fn parse_single(submessages: &str) -> Submessage {
    let Parsed { mut received, fault } = parse_submessages(submessages);
    assert_eq!((received.len(), fault), (1, None));
    received.remove(0).submessage
}

fn fault(submessages: &str) -> Option<WireError> {
    let Parsed { received, fault } = parse_submessages(&format!("{HEARTBEAT} {submessages}"));
    assert_eq!(received[0].submessage, Submessage::Heartbeat(heartbeat()), "what is before a fault stands");
    fault
}

#[test]
fn a_sample_comes_with_what_was_said_before_it() {
    let parsed = parse_submessages(&format!(
        "0e01 0c00 0a0b0c0d 00000000 00000001
         0901 0800 78563412 00000080
         1505 2400 0000 1000 00000504 00000403 00000000 07000000 00010000 06000000 48656c6c 6f000000
         {HEARTBEAT}"
    ));
    let data = Data {
        reader: READER,
        writer: WRITER,
        number: SequenceNumber(7),
        inline: InlineQos::default(),
        payload: Some(parse_hex("00010000 06000000 48656c6c 6f000000")),
        key_only: false,
    };
    let received = |submessage| ReceivedSubmessage {
        from: FROM,
        vendor: VendorId::FAST_DDS,
        to: Some(GuidPrefix([10, 11, 12, 13, 0, 0, 0, 0, 0, 0, 0, 1])),
        written: Some(WireTime { seconds: 0x1234_5678, fraction: 1 << 31 }),
        submessage,
    };
    assert_eq!(parsed.received, [received(Submessage::Data(data)), received(Submessage::Heartbeat(heartbeat()))]);
    assert_eq!(parsed.fault, None);
}

#[test]
fn context_submessages_can_be_reset() {
    let parsed = parse_submessages(&format!(
        "0e01 0c00 0a0b0c0d 00000000 00000001 0901 0800 78563412 00000080
         0e01 0c00 00000000 00000000 00000000 0903 0000 {HEARTBEAT}
         0901 0800 ffffffff ffffffff {HEARTBEAT}
         0901 0800 78563412 00000080 0c01 1400 00000000 0203 0110 0110aaaa bbbbcccc dddddddd {HEARTBEAT}"
    ));
    let [first, second, third] = &parsed.received[..] else {
        panic!("three heartbeats: {parsed:?}");
    };
    assert_eq!((first.to, first.written), (None, None));
    assert_eq!((second.to, second.written, second.vendor), (None, None, VendorId::FAST_DDS));
    assert_eq!((third.vendor, third.written), (VendorId::CYCLONE, None));
    assert_eq!(third.from.0[..4], [1, 16, 0xaa, 0xaa]);
}

#[test]
fn the_other_byte_order_is_read() {
    let big = "0700 001c 00000504 00000403 00000000 00000001 00000000 00000007 00000003";
    assert_eq!(parse_single(big), Submessage::Heartbeat(heartbeat()));
    let Submessage::AckNack(acknack) =
        parse_single("0602 001c 00000504 00000403 00000000 00000005 00000003 a0000000 00000002")
    else {
        panic!("an acknowledgement");
    };
    assert_eq!(acknack.set.iter().map(|number| number.0).collect::<Vec<_>>(), [5, 7]);
    assert_eq!((acknack.set.base, acknack.count, acknack.is_final), (SequenceNumber(5), 2, true));
}

#[test]
fn a_reply_names_its_request_by_either_parameter() {
    let identity = "010faaaa bbbbcccc 00000000 00001204 00000000 09000000";
    let reply = |length: &str, inline: &str| {
        parse_single(&format!(
            "1507 {length} 0000 1000 00000504 00000403 00000000 01000000 {inline} 01000000 00010000 2a000000"
        ))
    };
    let both = format!("8300 1800 {identity} 0f80 1800 {identity}");
    let forms = [
        reply("5800", &both),
        reply("3c00", &format!("8300 1800 {identity}")),
        reply("3c00", &format!("0f80 1800 {identity}")),
    ];
    for form in forms {
        let Submessage::Data(data) = form else { panic!("a sample: {form:?}") };
        let writer = Guid::from(<[u8; 16]>::try_from(&parse_hex(identity)[..16]).expect("sixteen bytes"));
        assert_eq!(data.inline.related, Some(SampleIdentity { writer, number: SequenceNumber(9) }));
        assert_eq!(data.payload, Some(parse_hex("00010000 2a000000")));
    }
}

#[test]
fn a_request_whose_client_does_not_know_its_number_says_so() {
    let request = "1507 3400 0000 1000 00000504 00000403 00000000 01000000
        0f80 1800 010faaaa bbbbcccc 00000000 00001204 ffffffff 00000000 01000000";
    let Submessage::Data(data) = parse_single(request) else { panic!("a sample") };
    assert_eq!(data.inline.related.map(|related| related.number), Some(SequenceNumber::UNKNOWN));
    assert_eq!(data.payload, Some(Bytes::new()));
}

#[test]
fn an_instance_that_is_no_more_is_named_by_its_key() {
    let gone = "1503 3400 0000 1000 000003c7 000003c2 00000000 02000000
        7000 1000 010f1122 33445566 00000000 00001203 7100 0400 00000003 01000000";
    let Submessage::Data(data) = parse_single(gone) else { panic!("a sample") };
    assert!(data.inline.is_gone());
    assert_eq!(data.inline.status, InlineQos::DISPOSED | InlineQos::UNREGISTERED);
    assert_eq!(data.payload, None);
    let guid = Guid::new(FROM, EntityId([0, 0, 0x12, 3]));
    assert_eq!(crate::discovery::guid_of_key(&data), Some(guid));
}

#[test]
fn fragments_are_exactly_their_bytes() {
    let frag = |first: &str, payload: &str| {
        parse_submessages(&format!(
            "1601 2800 0000 1c00 00000504 00000403 00000000 07000000 {first} 0100 0800 0d000000 {payload}"
        ))
    };
    let last = frag("02000000", "66676869 6a000000");
    let Some(Submessage::DataFrag(read)) = last.received.first().map(|received| &received.submessage) else {
        panic!("a fragment: {last:?}");
    };
    assert_eq!((read.first, read.count, read.fragment_size, read.sample_size), (2, 1, 8, 13));
    assert_eq!((read.offset(), &read.payload[..]), (8, &b"fghij"[..]));
    // The sample has two fragments; and the second is too short for its announced length.
    let outside = WireError::Fragments { first: 3, count: 1, size: 8, sample: 13 };
    assert_eq!(frag("03000000", "66676869 6a000000").fault, Some(outside));
    assert!(matches!(frag("00000000", "66676869 6a000000").fault, Some(WireError::Fragments { first: 0, .. })));
    // A fragment that would begin at the end of the sample is empty.
    let behind = "1601 2400 0000 1c00 00000504 00000403 00000000 07000000 03000000 0100 0800 10000000 66676869";
    assert!(matches!(parse_submessages(behind).fault, Some(WireError::Fragments { first: 3, .. })));
    let short = "1601 2400 0000 1c00 00000504 00000403 00000000 07000000 01000000 0100 0800 0d000000 66676869";
    assert_eq!(parse_submessages(short).fault, Some(WireError::Short));
}

#[test]
fn a_length_of_zero_is_the_rest_of_the_datagram_but_for_padding_and_no_time() {
    let parsed = parse_submessages(&format!("0101 0000 0903 0000 {}", HEARTBEAT.replacen("1c00", "0000", 1)));
    assert_eq!((parsed.received.len(), parsed.fault), (1, None));
    let data = "1505 0000 0000 1000 00000504 00000403 00000000 07000000 00010000 2a";
    let Submessage::Data(data) = parse_single(data) else { panic!("a sample") };
    assert_eq!(data.payload, Some(parse_hex("00010000 2a")));
}

#[test]
fn unknown_submessages_are_skipped() {
    let parsed = parse_submessages("8001 0600 010203040506 0000 0f01 0400 00000000 3101 0000");
    assert_eq!(parsed, Parsed::default());
    let parsed = parse_submessages(&format!("8001 0600 010203040506 0000 {HEARTBEAT}"));
    assert_eq!((parsed.received.len(), parsed.fault), (1, None));
    // Additional fields before the inline QoS, and an unknown parameter.
    let data = "1507 3400 0000 1400 00000504 00000403 00000000 07000000 deadbeef
        00800400 01020304 7100 0400 00000001 01000000 00010000 2a000000";
    let Submessage::Data(data) = parse_single(data) else { panic!("a sample") };
    assert_eq!((data.inline.status, data.payload), (1, Some(parse_hex("00010000 2a000000"))));
}

#[test]
fn a_sample_with_something_that_must_be_understood_and_is_not_is_left_out() {
    let data = "1507 2800 0000 1000 00000504 00000403 00000000 07000000 00c00400 01020304 01000000 00010000 2a000000";
    let parsed = parse_submessages(&format!("{data} {HEARTBEAT}"));
    assert_eq!((parsed.received.len(), parsed.fault), (1, None));
    assert_eq!(parsed.received[0].submessage, Submessage::Heartbeat(heartbeat()));
}

#[test]
fn a_fault_ends_the_datagram() {
    // 257 bits; a base below the minimum; an invalid number; longer than the datagram; no sentinel.
    let ends = "00000504 00000403";
    assert_eq!(fault(&format!("0601 4000 {ends} 00000000 01000000 01010000")), Some(WireError::Short));
    let words = "00000000".repeat(9);
    assert_eq!(
        fault(&format!("0601 3c00 {ends} 00000000 01000000 01010000 {words} 01000000")),
        Some(WireError::Set(257))
    );
    // High enough for additions to overflow.
    assert_eq!(
        fault(&format!("0701 1c00 {ends} 00000000 01000000 00000040 00000000 03000000")),
        Some(WireError::Number(1 << 62))
    );
    assert_eq!(fault(&format!("0601 1800 {ends} ffffffff ffffffff 00000000 01000000")), Some(WireError::Number(-1)));
    assert_eq!(
        fault(&format!("0701 1c00 {ends} 00000000 00000000 00000000 07000000 03000000")),
        Some(WireError::Number(0))
    );
    assert_eq!(
        fault(&format!("0701 1c00 {ends} 00000000 05000000 00000000 03000000 03000000")),
        Some(WireError::Number(3))
    );
    assert_eq!(
        fault(&format!("1503 1c00 0000 1000 {ends} 00000000 01000000 7100 0400 00000001")),
        Some(WireError::Short)
    );
    assert_eq!(fault(&format!("150d 1800 0000 1000 {ends} 00000000 01000000 00010000")), Some(WireError::Flags(13)));
    assert_eq!(fault("15"), Some(WireError::Short));
    assert_eq!(
        fault(&format!("1201 1c00 {ends} 00000000 01000000 00000000 00000000 01000000")),
        Some(WireError::Set(0))
    );
}

#[test]
fn other_protocols_are_rejected() {
    for other in [
        "",
        "52545053 0203",
        "52545058 0203 010f 010f1122 33445566 00000000",
        "52545053 0103 010f 010f1122 33445566 00000000",
    ] {
        assert_eq!(parse(&parse_hex(other)), Parsed { received: Vec::new(), fault: Some(WireError::NotRtps) });
    }
}

#[test]
fn the_number_of_submessages_is_limited() {
    let many = |count| parse_submessages(&"0101 0000".repeat(count)).fault;
    assert_eq!((many(MOST_SUBMESSAGES), many(MOST_SUBMESSAGES + 1)), (None, Some(WireError::TooMany)));
}

#[test]
fn written_datagrams_follow_the_specification() {
    let mut writer = DatagramWriter::new(FROM);
    assert!(writer.is_empty());
    let request = SampleIdentity { writer: Guid::new(FROM, EntityId([0, 0, 0x12, 4])), number: SequenceNumber(9) };
    let inline = InlineQos { related: Some(request), ..InlineQos::default() };
    let head = DataFragHead {
        reader: READER,
        writer: WRITER,
        number: SequenceNumber(7),
        inline,
        first: 2,
        count: 1,
        fragment_size: 8,
        sample_size: 13,
    };
    writer.destination(GuidPrefix([9; 12])).heartbeat(&heartbeat());
    let zeros = writer.data_frag_head(&head, 5);
    let sent = [&writer.finish()[..], b"fghij", zeros].concat();
    let identity = "010f1122 33445566 00000000 00001204 00000000 09000000";
    let expected = parse_hex(&format!(
        "52545053 0203 cafe 010f1122 33445566 00000000
         0e01 0c00 09090909 09090909 09090909
         {HEARTBEAT}
         1603 6400 0000 1c00 00000504 00000403 00000000 07000000 02000000 0100 0800 0d000000
         8300 1800 {identity} 0f80 1800 {identity} 01000000 66676869 6a000000"
    ));
    assert_eq!(sent, expected);
    assert_eq!(zeros.len(), 3);
}
