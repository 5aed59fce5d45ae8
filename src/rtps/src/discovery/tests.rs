//! Discovery data round-trips; decoding of arbitrary input terminates and keeps no more than it was given.

use std::net::{Ipv4Addr, SocketAddr};

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

use super::*;
use crate::qos::{DurabilityKind, HistoryKind, LivelinessKind, ReliabilityKind, Representations};
use crate::wire::properties::{guid, prefix};
use crate::wire::tests::parse_hex;
use crate::wire::{Data, InlineQos, ParticipantMessage, WireError};
use crate::{EntityId, SequenceNumber};

fn locators() -> impl Strategy<Value = Vec<Locator>> {
    let other = (any::<i32>(), any::<u32>(), any::<[u8; 16]>()).prop_map(|(kind, port, address)| Locator {
        kind,
        port,
        address,
    });
    let udp = (any::<[u8; 4]>(), any::<u16>()).prop_map(|(ip, port)| Locator::from((Ipv4Addr::from(ip), port)));
    vec(prop_oneof![other, udp], 0..4)
}

fn duration() -> impl Strategy<Value = Option<Duration>> {
    option::of((0..i32::MAX as u64, 0..1_000_000_000u32).prop_map(|(seconds, nanos)| Duration::new(seconds, nanos)))
}

fn user_data() -> impl Strategy<Value = Bytes> {
    vec(any::<u8>(), 0..200).prop_map(Bytes::from)
}

fn participant() -> impl Strategy<Value = ParticipantData> {
    let who = (prefix(), any::<[u8; 2]>(), any::<[u8; 2]>(), option::of(any::<u32>()));
    let what = ("[^\0]{0,20}", user_data(), locators(), locators(), any::<u32>(), duration());
    (who, what).prop_map(|((prefix, vendor, version, domain), (name, user_data, discovery, user, builtin, lease))| {
        let vendor = VendorId(vendor);
        ParticipantData { prefix, vendor, version, domain, name, user_data, discovery, user, builtin, lease }
    })
}

fn qos() -> impl Strategy<Value = EndpointQos> {
    let reliability = prop_oneof![Just(ReliabilityKind::BestEffort), Just(ReliabilityKind::Reliable)];
    let durability = prop_oneof![
        Just(DurabilityKind::Volatile),
        Just(DurabilityKind::TransientLocal),
        Just(DurabilityKind::Transient),
        Just(DurabilityKind::Persistent),
    ];
    let history = prop_oneof![(1..=i32::MAX as u32).prop_map(HistoryKind::KeepLast), Just(HistoryKind::KeepAll)];
    let liveliness = prop_oneof![
        Just(LivelinessKind::Automatic),
        Just(LivelinessKind::ManualByParticipant),
        Just(LivelinessKind::ManualByTopic),
    ];
    (reliability, durability, history, duration(), duration(), liveliness, duration(), vec(0u16..3, 0..3)).prop_map(
        |(reliability, durability, history, deadline, lifespan, liveliness, lease, numbers)| EndpointQos {
            representations: Representations::from_numbers(&numbers),
            reliability,
            durability,
            history,
            deadline,
            lifespan,
            liveliness,
            lease,
        },
    )
}

fn endpoint() -> impl Strategy<Value = EndpointData> {
    let name = "[^\0]{0,20}";
    (guid(), name, name, qos(), user_data(), locators(), any::<bool>()).prop_map(
        |(guid, topic, type_name, qos, user_data, unicast, expects_inline_qos)| EndpointData {
            guid,
            topic,
            type_name,
            qos,
            user_data,
            unicast,
            expects_inline_qos,
        },
    )
}

/// Asserts that what is decoded from these bytes is no larger than they are.
fn assert_bounded(payload: &Bytes) {
    if let Ok(read) = ParticipantData::from_payload(payload) {
        assert!(read.user_data.len() <= payload.len());
        // A byte that is not UTF-8 becomes a character of three bytes.
        assert!(read.name.len() <= 3 * payload.len());
        assert!(read.discovery.len() + read.user.len() <= payload.len() / 24);
    }
    if let Ok(read) = EndpointData::from_payload(payload) {
        assert!(read.user_data.len() + read.topic.len() + read.type_name.len() <= payload.len());
        assert!(read.unicast.len() <= payload.len() / 24);
    }
    let _ = ParticipantMessage::from_payload(payload);
    let _ = guid_of_key(&data(Some(payload.clone()), InlineQos::default()));
}

fn data(payload: Option<Bytes>, inline: InlineQos) -> Data {
    Data {
        reader: EntityId::UNKNOWN,
        writer: EntityId::PUBLICATIONS_WRITER,
        number: SequenceNumber(1),
        inline,
        payload,
        key_only: true,
    }
}

proptest! {
    #[test]
    fn a_participant_is_read_as_it_told(told in participant()) {
        prop_assert_eq!(ParticipantData::from_payload(&told.to_bytes()), Ok(told));
    }

    #[test]
    fn an_end_is_read_as_it_told(told in endpoint()) {
        let payload = told.to_bytes();
        prop_assert_eq!(guid_of_key(&data(Some(payload.clone()), InlineQos::default())), Some(told.guid));
        prop_assert_eq!(EndpointData::from_payload(&payload), Ok(told));
    }

    #[test]
    fn a_key_names_whom_it_is_of(guid in guid()) {
        let by_payload = data(Some(key_payload(guid)), InlineQos::default());
        prop_assert_eq!(guid_of_key(&by_payload), Some(guid));
        let by_hash = data(None, InlineQos { key_hash: Some(guid.bytes()), ..InlineQos::default() });
        prop_assert_eq!(guid_of_key(&by_hash), Some(guid));
    }

    #[test]
    fn a_participant_says_that_it_is_alive(prefix in prefix(), kind in any::<[u8; 4]>()) {
        let told = ParticipantMessage { prefix, kind };
        prop_assert_eq!(ParticipantMessage::from_payload(&told.to_bytes()), Ok(told));
    }

    #[test]
    fn damaged_payloads_are_read_to_their_end(
        participant in participant(),
        endpoint in endpoint(),
        damage in vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in any::<prop::sample::Index>(),
    ) {
        for whole in [participant.to_bytes(), endpoint.to_bytes()] {
            let mut damaged = whole.to_vec();
            for (at, byte) in &damage {
                let at = at.index(damaged.len());
                damaged[at] = *byte;
            }
            assert_bounded(&damaged.into());
            assert_bounded(&whole.slice(..cut.index(whole.len() + 1)));
        }
    }

    #[test]
    fn any_bytes_are_read_to_their_end(tail in vec(any::<u8>(), 0..200)) {
        assert_bounded(&[vec![0, 3, 0, 0], tail.clone()].concat().into());
        assert_bounded(&[vec![0, 2, 0, 0], tail.clone()].concat().into());
        assert_bounded(&tail.into());
    }
}

const ENDPOINT: &str = "5a00 1000 01100001 02030405 06070809 00001207
    0500 0c00 08000000 72742f63 68617400 0700 0800 04000000 613a3a00";

/// Creates a little-endian parameter list with its sentinel.
fn list(parameters: &str) -> Bytes {
    parse_hex(&format!("00030000 {parameters} 01000000"))
}

#[test]
fn omitted_policies_have_the_defaults_of_dds() {
    let reader = EndpointData::from_payload(&list(ENDPOINT)).expect("a reader");
    assert_eq!((&*reader.topic, &*reader.type_name), ("rt/chat", "a::"));
    let unsaid = EndpointQos {
        reliability: ReliabilityKind::BestEffort,
        durability: DurabilityKind::Volatile,
        history: HistoryKind::KeepLast(1),
        deadline: None,
        lifespan: None,
        liveliness: LivelinessKind::Automatic,
        lease: None,
        representations: Representations::XCDR1,
    };
    assert_eq!((reader.qos, reader.expects_inline_qos), (unsaid, false));
    let writer = EndpointData::from_payload(&list(&ENDPOINT.replace("00001207", "00001203"))).expect("a writer");
    assert_eq!(writer.qos, EndpointQos { reliability: ReliabilityKind::Reliable, ..unsaid });
}

#[test]
fn omitted_participant_parameters_have_defaults() {
    let told = ParticipantData::from_payload(&list("5000 1000 01100001 02030405 06070809 000001c1")).expect("one");
    assert_eq!(told.prefix.0, [1, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
    assert_eq!((told.builtin, told.lease), (0x3f, Some(Duration::from_secs(100))));
    assert_eq!((told.domain, &*told.name, told.discovery.len()), (None, "", 0));
}

#[test]
fn the_other_byte_order_is_read() {
    let told = parse_hex(
        "00020000 0015 0004 02020000 0016 0004 01100000 0050 0010 01100001 02030405 06070809 000001c1
         0032 0018 00000001 00001cf2 00000000 00000000 00000000 7f000001 0002 0008 0000000a 80000000
         0058 0004 00000c3f 002c 0010 0000000b 656e636c 6176653d 2f3b3b00 0001 0000",
    );
    let told = ParticipantData::from_payload(&told).expect("a participant");
    assert_eq!((told.version, told.vendor, told.builtin), ([2, 2], VendorId::CYCLONE, 0xc3f));
    assert_eq!(told.discovery[0].udp_address(), Some(SocketAddr::from(([127, 0, 0, 1], 7410))));
    assert_eq!(told.lease, Some(Duration::from_millis(10_500)));
    assert_eq!(&told.user_data[..], b"enclave=/;;");
}

#[test]
fn unknown_parameters_that_must_be_understood_are_an_error() {
    let unknown = |parameter: &str| EndpointData::from_payload(&list(&format!("{ENDPOINT} {parameter}"))).err();
    assert_eq!(unknown("0080 0400 00000000"), None);
    assert_eq!(unknown("0042 0400 00000000"), Some(WireError::NotUnderstood(0x4200)));
    // Reliability of kind 7; missing sentinel; missing topic; another serialization.
    assert_eq!(unknown("1a00 0c00 07000000 00000000 00000000"), Some(WireError::Value(0x1a)));
    let cut = EndpointData::from_payload(&parse_hex(&format!("00030000 {ENDPOINT}")));
    assert_eq!(cut, Err(WireError::Short));
    let nameless = EndpointData::from_payload(&list(&ENDPOINT[..45]));
    assert_eq!(nameless, Err(WireError::Missing(0x05)));
    let plain = EndpointData::from_payload(&parse_hex("00010000 01000000"));
    assert_eq!(plain, Err(WireError::Serialization(1)));
}

#[test]
fn a_participant_with_a_domain_tag_is_rejected() {
    let participant = "5000 1000 01100001 02030405 06070809 000001c1";
    let tagged = |tag: &str| ParticipantData::from_payload(&list(&format!("{participant} 1440 0800 {tag}"))).err();
    assert_eq!(tagged("01000000 00000000"), None);
    assert_eq!(tagged("03000000 61620000"), Some(WireError::NotUnderstood(0x4014)));
}

#[test]
fn locators_are_kept_up_to_a_number() {
    let locator = Locator::from((Ipv4Addr::LOCALHOST, 7411));
    let told = ParticipantData {
        prefix: GuidPrefix([1; 12]),
        vendor: VendorId::OURS,
        version: [2, 3],
        domain: None,
        name: String::new(),
        user_data: Bytes::new(),
        discovery: vec![locator; 40],
        user: Vec::new(),
        builtin: 0,
        lease: None,
    };
    let read = ParticipantData::from_payload(&told.to_bytes()).expect("a participant");
    assert_eq!(read.discovery.len(), participant::MOST_LOCATORS);
}

#[test]
fn values_too_long_for_a_parameter_are_omitted() {
    let told = |length| ParticipantData {
        prefix: GuidPrefix([1; 12]),
        vendor: VendorId::OURS,
        version: [2, 3],
        domain: None,
        name: "n".repeat(length),
        user_data: Bytes::from(vec![7; length]),
        discovery: Vec::new(),
        user: Vec::new(),
        builtin: 0,
        lease: None,
    };
    let read = |told: &ParticipantData| ParticipantData::from_payload(&told.to_bytes()).expect("a participant");
    assert_eq!(read(&told(65_527)), told(65_527));
    assert_eq!(read(&told(65_529)), told(0));
}
