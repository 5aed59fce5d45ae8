//! Datagrams captured in a network namespace, of rclpy 7.1.6 with Fast DDS 2.14.5 (`fast_…`), which appends a
//! vendor-specific submessage to each, and of Cyclone DDS 11.0.1 (`cyclone_…`).

use super::tests::parse_hex;
use super::*;
use crate::discovery::guid_of_key;
use crate::locator::Locator;
use crate::network::{InterfaceAddress, InterfaceSet};
use crate::{DurabilityKind, EndpointData, Guid, HistoryKind, ParticipantData, ReliabilityKind};

/// Returns the address at which such a participant is reached in its network namespace.
fn reachable(told: &[Locator]) -> Option<std::net::SocketAddr> {
    InterfaceSet::new(vec![InterfaceAddress::LOOPBACK]).choose_address(told, None)
}

macro_rules! captured {
    ($name:literal) => {
        read(include_str!(concat!("fixtures/", $name, ".hex")))
    };
}

fn read(text: &str) -> Vec<ReceivedSubmessage> {
    let Parsed { received, fault } = parse(&parse_hex(text));
    assert_eq!(fault, None);
    received
}

/// Returns the first sample.
fn data(received: &[ReceivedSubmessage]) -> &Data {
    let mut submessages = received.iter().map(|received| &received.submessage);
    let Some(Submessage::Data(data)) = submessages.find(|submessage| matches!(submessage, Submessage::Data(_))) else {
        panic!("a sample: {received:?}");
    };
    data
}

fn payload(received: &[ReceivedSubmessage]) -> &Bytes {
    data(received).payload.as_ref().expect("a payload")
}

/// Prefix of the node `one`, which writes and serves.
const ONE: GuidPrefix = GuidPrefix([1, 0x0f, 0x7f, 1, 0xd6, 0x78, 0xb9, 0x36, 0, 0, 0, 0]);
/// Prefix of the node `two`, which reads and calls.
const TWO: GuidPrefix = GuidPrefix([1, 0x0f, 0x7f, 1, 0xfb, 0x78, 0x2e, 0x22, 0, 0, 0, 0]);
const CYCLONE: GuidPrefix = GuidPrefix([1, 0x10, 0x62, 0xb9, 0xfc, 0x44, 0x4f, 0xf0, 0x6f, 0, 0xdd, 0x90]);

#[test]
fn captured_participants_are_parsed() {
    let received = captured!("fast_participant");
    assert_eq!((received[0].from, received[0].to), (ONE, None));
    assert_eq!((data(&received).writer, data(&received).reader), (EntityId::SPDP_WRITER, EntityId::SPDP_READER));
    let told = ParticipantData::from_payload(payload(&received)).expect("a participant");
    assert_eq!((told.prefix, told.vendor, &*told.name), (ONE, VendorId::FAST_DDS, "/"));
    // ROS 2 includes the terminating zero.
    assert_eq!(&told.user_data[..], b"enclave=/;\0");
    assert_eq!(reachable(&told.discovery), Some(([127, 0, 0, 1], 7410).into()));
    assert_eq!(reachable(&told.user), Some(([127, 0, 0, 1], 7411).into()));
    assert_eq!((told.builtin, told.lease.map(|lease| lease.as_secs())), (0xc3f, Some(20)));

    let received = captured!("cyclone_participant");
    let told = ParticipantData::from_payload(payload(&received)).expect("a participant");
    assert_eq!((told.prefix, told.vendor, told.domain), (CYCLONE, VendorId::CYCLONE, Some(0)));
    assert_eq!(reachable(&told.discovery), Some(([127, 0, 0, 1], 7410).into()));
    assert_eq!(told.lease.map(|lease| lease.as_secs()), Some(10));
}

#[test]
fn captured_endpoints_are_parsed() {
    let told = |received: Vec<ReceivedSubmessage>| EndpointData::from_payload(payload(&received)).expect("an end");
    let writer = told(captured!("fast_writer"));
    assert_eq!((&*writer.topic, &*writer.type_name), ("rt/big", "std_msgs::msg::dds_::String_"));
    assert!(writer.guid.prefix == TWO && writer.guid.entity.is_writer());
    assert_eq!((writer.qos.reliability, writer.qos.durability), (ReliabilityKind::Reliable, DurabilityKind::Volatile));
    let hash = b"typehash=RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18;";
    assert_eq!(&writer.user_data[..], hash);
    assert_eq!(reachable(&writer.unicast), Some(([127, 0, 0, 1], 7413).into()));

    let reader = told(captured!("fast_reader"));
    assert_eq!((&*reader.topic, reader.guid.entity), ("rt/chatter", EntityId([0, 0, 0x13, 4])));
    assert!(!reader.expects_inline_qos);

    let writer = told(captured!("cyclone_writer"));
    assert_eq!((&*writer.topic, writer.guid), ("rt/chatter", Guid::new(CYCLONE, EntityId([0, 0, 2, 3]))));
    assert_eq!(
        (writer.qos.durability, writer.qos.history),
        (DurabilityKind::TransientLocal, HistoryKind::KeepLast(10))
    );
    assert!(writer.unicast.is_empty());
}

#[test]
fn captured_liveliness_is_parsed() {
    // In the datagram of its writer, after the announcement.
    let received = captured!("cyclone_writer");
    let Some(ReceivedSubmessage { submessage: Submessage::Data(data), .. }) = received.get(1) else {
        panic!("a sample: {received:?}");
    };
    assert_eq!((data.writer, data.reader), (EntityId::LIVELINESS_WRITER, EntityId::LIVELINESS_READER));
    let told = ParticipantMessage::from_payload(data.payload.as_ref().expect("a payload"));
    assert_eq!(told, Ok(ParticipantMessage { prefix: CYCLONE, kind: ParticipantMessage::AUTOMATIC }));
}

#[test]
fn a_captured_sample_is_parsed() {
    let received = captured!("fast_sample");
    assert_eq!((received[0].from, received[0].to), (ONE, Some(TWO)));
    assert_eq!(data(&received).number, SequenceNumber(4));
    assert_eq!(&payload(&received)[..], b"\0\x01\0\0\x06\0\0\0Hello\0\0\0");
}

#[test]
fn a_captured_fragment_is_parsed() {
    let received = captured!("fast_last_fragment");
    let Submessage::DataFrag(frag) = &received[0].submessage else { panic!("a fragment") };
    assert_eq!((frag.first, frag.count, frag.fragment_size, frag.sample_size), (2, 1, 824, 1620));
    assert_eq!((frag.offset(), frag.payload.len()), (824, 796));
    assert!(frag.payload.ends_with(b"ijk\0"));
}

#[test]
fn a_captured_acknack_is_parsed() {
    let received = captured!("fast_acknack");
    let Submessage::AckNack(acknack) = &received[0].submessage else { panic!("an acknowledgement") };
    assert_eq!((acknack.set.base, acknack.set.bits, acknack.is_final), (SequenceNumber(1), 12, false));
    assert_eq!(acknack.set.iter().count(), 12);
}

#[test]
fn a_captured_request_and_its_reply_are_parsed() {
    // Both contain the client's reader; only the reply knows the number of the request.
    let client = Guid::new(TWO, EntityId([0, 0, 0x14, 4]));
    let request = captured!("fast_request");
    let related = data(&request).inline.related;
    assert_eq!(related, Some(SampleIdentity { writer: client, number: SequenceNumber::UNKNOWN }));
    assert_eq!((data(&request).number, payload(&request).len()), (SequenceNumber(1), 8));
    let reply = captured!("fast_reply");
    let related = data(&reply).inline.related;
    assert_eq!(related, Some(SampleIdentity { writer: client, number: SequenceNumber(1) }));
}

#[test]
fn captured_disposals_are_parsed() {
    let gone = |received: Vec<ReceivedSubmessage>| {
        assert_eq!(data(&received).inline.status, InlineQos::DISPOSED | InlineQos::UNREGISTERED);
        guid_of_key(data(&received)).expect("it names whom it is of")
    };
    assert_eq!(gone(captured!("fast_withdrawn")), Guid::new(TWO, EntityId([0, 0, 4, 3])));
    assert_eq!(gone(captured!("fast_gone")), Guid::new(TWO, EntityId::PARTICIPANT));
    // One contains only the key hash, the other only the key.
    let received = captured!("cyclone_gone");
    assert!(data(&received).key_only && data(&received).inline.key_hash.is_none());
    assert_eq!(gone(received), Guid::new(CYCLONE, EntityId([0, 0, 2, 3])));
}
