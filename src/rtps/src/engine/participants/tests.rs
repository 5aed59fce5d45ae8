//! The limits on the numbers of participants and endpoints.

use std::net::IpAddr;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;

use super::super::Settings;
use super::super::discovering::{BUILTIN, MOST_ENDS};
use super::*;
use crate::locator::Ports;
use crate::network::InterfaceSet;
use crate::qos::EndpointQos;
use crate::reader::ReaderLimits;
use crate::wire::{Data, DatagramWriter, Heartbeat, InlineQos};
use crate::{SequenceNumber, VendorId};

const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

fn participant(number: u16) -> ParticipantData {
    let at = |port: u16| vec![Locator::from((std::net::Ipv4Addr::LOCALHOST, port))];
    let mut prefix = [1; 12];
    prefix[..2].copy_from_slice(&number.to_be_bytes());
    ParticipantData {
        prefix: GuidPrefix(prefix),
        vendor: VendorId::OURS,
        version: [2, 3],
        domain: Some(0),
        name: String::new(),
        user_data: Bytes::new(),
        discovery: at(10_000 + 2 * number),
        user: at(10_001 + 2 * number),
        builtin: BUILTIN,
        lease: Some(Duration::from_secs(10)),
    }
}

fn engine(now: Instant) -> Engine {
    let bounds = ReaderLimits {
        max_sample: 16 << 20,
        budget: Budget::new("samples", 1 << 20),
        unfinished: Duration::from_secs(30),
    };
    Engine::new(
        now,
        Settings {
            own: participant(0),
            ports: Ports::for_domain(0).expect("a domain"),
            bounds,
            announce_to: Vec::new(),
            servers: Vec::new(),
            network: InterfaceSet::new(Vec::new()),
            alone: false,
            predecessors: Vec::new(),
        },
    )
}

/// Delivers a sample of a built-in writer.
fn deliver_announcement(engine: &mut Engine, now: Instant, whose: u16, writer: EntityId, number: i64, payload: Bytes) {
    let mut datagram = DatagramWriter::new(participant(whose).prefix);
    datagram.data(&Data {
        reader: EntityId::UNKNOWN,
        writer,
        number: SequenceNumber(number),
        inline: InlineQos::default(),
        payload: Some(payload),
        key_only: false,
    });
    engine.receive(now, HERE, &datagram.finish().into());
}

fn join_participant(engine: &mut Engine, now: Instant, whose: u16) {
    let told = participant(whose).to_bytes();
    deliver_announcement(engine, now, whose, EntityId::SPDP_WRITER, 1, told);
}

#[test]
fn one_participant_too_many_is_not_heard_until_another_goes() {
    let now = Instant::now();
    let mut engine = engine(now);
    for whose in 1..=257 {
        join_participant(&mut engine, now, whose);
    }
    let there = |engine: &Engine| engine.watch_discovered().borrow().participants.len();
    let hears = |engine: &Engine, whose: u16| {
        let discovered = engine.watch_discovered().borrow().clone();
        discovered.participants.contains_key(&participant(whose).prefix)
    };
    assert_eq!(MOST_PARTICIPANTS, 256);
    assert_eq!(there(&engine), 256);
    assert!(hears(&engine, 256) && !hears(&engine, 257));
    engine.remove_participant(participant(7).prefix);
    join_participant(&mut engine, now, 257);
    assert_eq!(there(&engine), 256);
    assert!(hears(&engine, 257));
}

/// Creates a writer of a participant.
fn endpoint(whose: u16, number: u32, user_data: &'static [u8]) -> EndpointData {
    EndpointData {
        guid: Guid::new(participant(whose).prefix, EntityId::user_writer(number)),
        topic: format!("rt/topic_{number}"),
        type_name: "std_msgs::msg::dds_::String_".into(),
        qos: EndpointQos::default(),
        user_data: Bytes::from_static(user_data),
        unicast: Vec::new(),
        expects_inline_qos: false,
    }
}

#[test]
fn one_end_too_many_is_not_heard_and_those_that_are_can_change() {
    let now = Instant::now();
    let mut engine = engine(now);
    join_participant(&mut engine, now, 1);
    let mut datagram = DatagramWriter::new(participant(1).prefix);
    datagram.heartbeat(&Heartbeat {
        reader: EntityId::UNKNOWN,
        writer: EntityId::PUBLICATIONS_WRITER,
        first: SequenceNumber(1),
        last: SequenceNumber(0),
        count: 1,
        is_final: true,
        liveliness: false,
    });
    engine.receive(now, HERE, &datagram.finish().into());
    let mut number = 0;
    let mut tells = |engine: &mut Engine, told: EndpointData| {
        number += 1;
        let writer = EntityId::PUBLICATIONS_WRITER;
        deliver_announcement(engine, now, 1, writer, number, told.to_bytes());
    };
    assert_eq!(MOST_ENDS, 16_384);
    // Publishing takes longer with every endpoint, so only the last few are published.
    for number in 1..MOST_ENDS as u32 - 1 {
        let told = Arc::new(endpoint(1, number, b""));
        engine.discovered.writers.insert(told.guid, told);
    }
    for number in MOST_ENDS as u32 - 1..=MOST_ENDS as u32 + 1 {
        tells(&mut engine, endpoint(1, number, b""));
    }
    let discovered = engine.watch_discovered().borrow().clone();
    assert_eq!(discovered.writers.len(), MOST_ENDS);
    let last = endpoint(1, MOST_ENDS as u32, b"").guid;
    let beyond = endpoint(1, MOST_ENDS as u32 + 1, b"").guid;
    assert!(discovered.writers.contains_key(&last) && !discovered.writers.contains_key(&beyond));
    tells(&mut engine, endpoint(1, MOST_ENDS as u32, b"changed"));
    let discovered = engine.watch_discovered().borrow().clone();
    assert_eq!(discovered.writers[&last].user_data, "changed");
}

#[test]
fn an_end_with_a_name_or_user_data_without_end_is_not_heard() {
    let mut told = endpoint(1, 1, b"");
    told.topic = "x".repeat(1024);
    assert_eq!(EndpointData::from_payload(&told.to_bytes()), Ok(told.clone()));
    told.topic.push('x');
    assert!(EndpointData::from_payload(&told.to_bytes()).is_err());
    let told = endpoint(1, 1, &[0; 1025]);
    assert!(EndpointData::from_payload(&told.to_bytes()).is_err());
}
