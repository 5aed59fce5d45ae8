//! RTPS datagrams, and the discovery data of participants and endpoints.

use std::fmt::Debug;

use ::rtps::wire::{self, Data, DatagramWriter, ParticipantMessage, ReceivedSubmessage, Submessage, WireError};
use ::rtps::{EndpointData, ParticipantData};
use bytes::Bytes;

/// A datagram. Whatever is read is written again, one submessage per datagram, and must be read as the same.
pub fn datagram(data: &[u8]) {
    let datagram = Bytes::copy_from_slice(data);
    let parsed = wire::parse(&datagram);
    assert!(parsed.received.len() <= wire::MOST_SUBMESSAGES);
    let payloads: usize = parsed.received.iter().map(payload_length).sum();
    assert!(payloads <= data.len(), "payloads that are not of the datagram");
    for received in parsed.received {
        let again = wire::parse(&encode_submessage(&received).into());
        assert_eq!(again.fault, None, "{received:?}");
        let [again] = <[ReceivedSubmessage; 1]>::try_from(again.received).expect("one");
        assert_eq!((again.to, again.written), (received.to, received.written));
        assert_eq!(again.submessage, pad_payload(received.submessage));
    }
}

/// The payload of a discovery sample. Whatever is read is written again and must be read as the same.
pub fn discovery(data: &[u8]) {
    let payload = Bytes::copy_from_slice(data);
    check_round_trip(&payload, ParticipantData::from_payload, ParticipantData::to_bytes);
    check_round_trip(&payload, EndpointData::from_payload, EndpointData::to_bytes);
    check_round_trip(&payload, ParticipantMessage::from_payload, ParticipantMessage::to_bytes);
}

/// Length above which a value that was read can be too long for a parameter when it is written.
const MAX_VALUE_LENGTH: usize = 16 << 10;

fn check_round_trip<T: PartialEq + Debug>(
    payload: &Bytes,
    read: fn(&Bytes) -> Result<T, WireError>,
    write: fn(&T) -> Bytes,
) {
    match read(payload) {
        Ok(told) if payload.len() <= MAX_VALUE_LENGTH => assert_eq!(read(&write(&told)), Ok(told)),
        Ok(_) => {}
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

fn payload_length(received: &ReceivedSubmessage) -> usize {
    match &received.submessage {
        Submessage::Data(data) => data.payload.as_ref().map_or(0, Bytes::len),
        Submessage::DataFrag(frag) => frag.payload.len(),
        _ => 0,
    }
}

fn encode_submessage(received: &ReceivedSubmessage) -> Vec<u8> {
    let mut writer = DatagramWriter::new(received.from);
    if let Some(to) = received.to {
        writer.destination(to);
    }
    if let Some(time) = received.written {
        writer.timestamp(time);
    }
    match &received.submessage {
        Submessage::Data(data) => writer.data(data),
        Submessage::DataFrag(frag) => writer.data_frag(frag),
        Submessage::Heartbeat(beat) => writer.heartbeat(beat),
        Submessage::HeartbeatFrag(beat) => writer.heartbeat_frag(beat),
        Submessage::AckNack(acknack) => writer.acknack(acknack),
        Submessage::NackFrag(nack) => writer.nack_frag(nack),
        Submessage::Gap(gap) => writer.gap(gap),
    };
    writer.finish()
}

/// Pads the payload of a sample to a multiple of four bytes, as writing does.
fn pad_payload(mut submessage: Submessage) -> Submessage {
    if let Submessage::Data(Data { payload: Some(payload), .. }) = &mut submessage {
        let mut bytes = payload.to_vec();
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        *payload = bytes.into();
    }
    submessage
}
