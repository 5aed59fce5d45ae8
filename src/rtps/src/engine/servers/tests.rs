//! A client in front of a simulated server.

use bytes::Bytes;

use super::*;
use crate::VendorId;
use crate::discovery::EndpointData;
use crate::engine::{BUILTIN, Settings};
use crate::locator::Ports;
use crate::network::InterfaceSet;
use crate::qos::EndpointQos;
use crate::reader::ReaderLimits;
use crate::shared::TopicDescription;
use crate::wire::{DatagramWriter, ReceivedSubmessage, Submessage};

const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);
const SECOND: Duration = Duration::from_secs(1);

fn local_address(port: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], port))
}

fn participant(prefix: GuidPrefix, port: u16) -> ParticipantData {
    let locator = |port: u16| vec![Locator::from((std::net::Ipv4Addr::LOCALHOST, port))];
    ParticipantData {
        prefix,
        vendor: VendorId::FAST_DDS,
        version: [2, 3],
        // Another domain: servers have their own, and Fast DDS 2 does not announce one.
        domain: Some(7),
        name: String::new(),
        user_data: Bytes::new(),
        discovery: locator(port),
        user: locator(port + 1),
        builtin: BUILTIN,
        lease: Some(20 * SECOND),
    }
}

/// A client of the servers at these ports, and the time.
struct ClientWorld {
    now: Instant,
    client: Engine,
}

impl ClientWorld {
    fn with_servers(servers: &[DiscoveryServer]) -> Self {
        let now = Instant::now();
        let own = ParticipantData { vendor: VendorId::OURS, ..participant(GuidPrefix([1; 12]), 7410) };
        let bounds =
            ReaderLimits { max_sample: 1 << 20, budget: budget::Budget::without_limit(), unfinished: 30 * SECOND };
        let settings = Settings {
            own,
            ports: Ports::for_domain(0).expect("a domain"),
            bounds,
            announce_to: Vec::new(),
            servers: servers.to_vec(),
            network: InterfaceSet::new(Vec::new()),
            alone: false,
            predecessors: Vec::new(),
        };
        let client = Engine::new(now, settings);
        Self { now, client }
    }

    /// Lets time pass and returns what the client sends meanwhile, with the destinations.
    fn advance(&mut self, duration: Duration) -> Vec<(SocketAddr, ReceivedSubmessage)> {
        let until = self.now + duration;
        let mut said = Vec::new();
        loop {
            while let Some(datagram) = self.client.transmit(&mut |_, _, _| true) {
                let parts = datagram.parts();
                let bytes: Bytes = parts.iter().flat_map(|part| part.to_vec()).collect();
                let received = wire::parse(&bytes).received;
                said.extend(received.into_iter().map(|it| (datagram.to, it)));
            }
            let next = self.client.tick_at();
            if next > until {
                break;
            }
            self.now = self.now.max(next);
            self.client.tick(self.now);
        }
        self.now = until;
        said
    }

    /// Delivers a datagram to the client.
    fn deliver(&mut self, from: GuidPrefix, write: impl FnOnce(&mut DatagramWriter)) {
        let mut writer = DatagramWriter::new(from);
        write(&mut writer);
        self.client.receive(self.now, HERE, &writer.finish().into());
    }

    /// Has a reader of another participant acknowledge that it knows our writer.
    fn confirm_match(&mut self, ours: Guid, theirs: &EndpointData, count: u32) {
        let acknack = wire::AckNack {
            reader: theirs.guid.entity,
            writer: ours.entity,
            set: SequenceSet::empty(SequenceNumber(1)),
            count,
            is_final: true,
        };
        self.deliver(theirs.guid.prefix, |out| {
            out.acknack(&acknack);
        });
    }

    fn knows(&self, prefix: GuidPrefix) -> bool {
        let discovered = self.client.watch_discovered();
        let discovered = discovered.borrow();
        discovered.participants.contains_key(&prefix)
    }

    fn endpoint_count(&self) -> usize {
        let discovered = self.client.watch_discovered();
        let discovered = discovered.borrow();
        discovered.writers.len() + discovered.readers.len()
    }
}

/// A simulated server.
struct FakeServer {
    prefix: GuidPrefix,
    port: u16,
    counts: u32,
}

impl FakeServer {
    fn new(place: u8) -> Self {
        Self { prefix: discovery_server(place).prefix(), port: discovery_server(place).at.port(), counts: 0 }
    }

    /// Sends a sample as the only one of a built-in writer so far.
    fn send(&mut self, world: &mut ClientWorld, writer: EntityId, number: i64, payload: Bytes) {
        self.send_with_status(world, writer, number, InlineQos::default(), payload);
    }

    fn send_with_status(
        &mut self,
        world: &mut ClientWorld,
        writer: EntityId,
        number: i64,
        inline: InlineQos,
        payload: Bytes,
    ) {
        self.counts += 1;
        let number = SequenceNumber(number);
        let key_only = inline.status != 0;
        let data = wire::Data { reader: EntityId::UNKNOWN, writer, number, inline, payload: Some(payload), key_only };
        let beat = wire::Heartbeat {
            reader: EntityId::UNKNOWN,
            writer,
            first: number,
            last: number,
            count: self.counts,
            is_final: false,
            liveliness: false,
        };
        world.deliver(self.prefix, |out| {
            out.data(&data);
            out.heartbeat(&beat);
        });
    }

    fn send_participant(&mut self, world: &mut ClientWorld, number: i64, of: &ParticipantData) {
        self.send(world, EntityId::SPDP_WRITER, number, of.to_bytes());
    }

    fn announce_itself(&mut self, world: &mut ClientWorld) {
        let own = participant(self.prefix, self.port);
        self.send_participant(world, 1, &own);
    }

    fn withdraw(&mut self, world: &mut ClientWorld, number: i64, gone: GuidPrefix) {
        let guid = Guid::new(gone, EntityId::PARTICIPANT);
        let inline = InlineQos { status: DISPOSED, key_hash: Some(guid.bytes()), ..InlineQos::default() };
        let key = discovery::key_payload(guid);
        self.send_with_status(world, EntityId::SPDP_WRITER, number, inline, key);
    }

    /// Acknowledges all samples of a built-in writer before this number.
    fn acknowledge(&mut self, world: &mut ClientWorld, writer: EntityId, reader: EntityId, next: i64) {
        self.counts += 1;
        let acknack = wire::AckNack {
            reader,
            writer,
            set: SequenceSet::empty(SequenceNumber(next)),
            count: self.counts,
            is_final: true,
        };
        world.deliver(self.prefix, |out| {
            out.acknack(&acknack);
        });
    }
}

fn discovery_server(place: u8) -> DiscoveryServer {
    DiscoveryServer { place, at: local_address(11811 + u16::from(place)) }
}

fn topic() -> TopicDescription {
    TopicDescription {
        name: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        user_data: Bytes::new(),
    }
}

/// Creates a reader of that topic.
fn reader(prefix: GuidPrefix) -> EndpointData {
    EndpointData {
        guid: Guid::new(prefix, EntityId([0, 0, 1, 4])),
        topic: topic().name,
        type_name: topic().type_name,
        qos: EndpointQos::default(),
        user_data: Bytes::new(),
        unicast: Vec::new(),
        expects_inline_qos: false,
    }
}

/// Returns the samples of built-in writers: entity, number and destination.
fn collect_announcements(said: &[(SocketAddr, ReceivedSubmessage)]) -> Vec<(EntityId, i64, SocketAddr)> {
    let data = said.iter().filter_map(|(to, it)| match &it.submessage {
        Submessage::Data(data) => Some((data.writer, data.number.0, *to)),
        _ => None,
    });
    data.collect()
}

const OTHER: GuidPrefix = GuidPrefix([9; 12]);

#[test]
fn servers_alone_are_told_and_again_until_they_are_there() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0), discovery_server(3)]);
    assert!(world.client.watched_ports().iter().eq([
        &SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 11811),
        &SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 11814),
    ]));
    world.advance(SECOND);
    let said = world.advance(9 * SECOND);
    let told = collect_announcements(&said);
    for server in [local_address(11811), local_address(11814)] {
        let times = told.iter().filter(|(_, _, to)| *to == server).count();
        assert!((15..=25).contains(&times), "{times} times in 9 s");
    }
    assert!(
        told.iter().all(|(writer, number, to)| *writer == EntityId::SPDP_WRITER
            && *number == 1
            && [11811, 11814].contains(&to.port())),
        "{told:?}"
    );
    let (_, first) = &said[0];
    let Submessage::Data(data) = &first.submessage else {
        panic!("{first:?}");
    };
    // A server forwards nothing without the identity of its author: GUID, number and vendor.
    let related = data.inline.related.expect("an identity");
    let own = Guid::new(GuidPrefix([1; 12]), EntityId::SPDP_WRITER);
    assert_eq!((related.writer, related.number), (own, SequenceNumber(1)));
    let payload = data.payload.clone().expect("a payload");
    let told = ParticipantData::from_payload(&payload).expect("a participant");
    assert_eq!(told.vendor, VendorId::FAST_DDS);
    let text = String::from_utf8_lossy(&payload);
    assert!(text.contains("PARTICIPANT_TYPE\0") && text.contains("SUPER_CLIENT\0"));
    // Both servers are there, so announcements become rare.
    for place in [0, 3] {
        FakeServer::new(place).announce_itself(&mut world);
    }
    world.advance(SECOND);
    let often = collect_announcements(&world.advance(9 * SECOND)).len();
    assert!((4..=10).contains(&often), "{often} times in 9 s");
}

#[test]
fn others_are_known_by_the_server_and_spoken_with_directly() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    let (_, ends) = world.client.add_writer(world.now, &topic(), EndpointQos::default());
    let mut server = FakeServer::new(0);
    server.announce_itself(&mut world);
    let said = collect_announcements(&world.advance(SECOND));
    let to_server = (EntityId::PUBLICATIONS_WRITER, 1, local_address(11811));
    assert!(said.contains(&to_server), "{said:?}");
    server.send_participant(&mut world, 2, &participant(OTHER, 7412));
    let end = reader(OTHER).to_bytes();
    server.send(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    assert!(world.knows(OTHER));
    assert_eq!(ends.borrow().matched.len(), 1);
    let said = world.advance(SECOND);
    // Samples and heartbeats are sent to it directly; it learns of endpoints from the server alone.
    let others = said.iter().filter(|(to, _)| *to != local_address(11811));
    let user_ports: Vec<u16> = others.map(|(to, _)| to.port()).collect();
    assert!(!user_ports.is_empty() && user_ports.iter().all(|port| *port == 7413));
    server.withdraw(&mut world, 3, OTHER);
    assert!(!world.knows(OTHER));
    assert_eq!((ends.borrow().matched.len(), world.endpoint_count()), (0, 0));
}

#[test]
fn participants_that_are_no_servers_are_ignored() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    let mut stranger = FakeServer { prefix: OTHER, port: 7412, counts: 0 };
    stranger.announce_itself(&mut world);
    // Neither is what it says about others or their endpoints.
    stranger.send_participant(&mut world, 2, &participant(GuidPrefix([8; 12]), 7414));
    let end = reader(GuidPrefix([8; 12])).to_bytes();
    stranger.send(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    assert!(!world.knows(OTHER) && !world.knows(GuidPrefix([8; 12])));
    assert_eq!(world.endpoint_count(), 0);
    // A server with another prefix is recognized by its address.
    let mut server = FakeServer { prefix: GuidPrefix([7; 12]), port: 11811, counts: 0 };
    server.announce_itself(&mut world);
    assert!(world.knows(server.prefix));
    // Its endpoints are ignored while the participant is unknown.
    let end = reader(OTHER).to_bytes();
    server.send(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    assert_eq!(world.endpoint_count(), 0);
    server.send_participant(&mut world, 2, &participant(OTHER, 7412));
    assert!(world.knows(OTHER));
}

#[test]
fn a_restarted_server_is_sent_everything_again() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    let mut server = FakeServer::new(0);
    server.announce_itself(&mut world);
    let (ours, ends) = world.client.add_writer(world.now, &topic(), EndpointQos::default());
    server.send_participant(&mut world, 2, &participant(OTHER, 7412));
    let theirs = reader(OTHER);
    server.send(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, theirs.to_bytes());
    world.confirm_match(ours, &theirs, 1);
    world.advance(SECOND);
    let (writer, reader) = ANNOUNCERS[0];
    server.acknowledge(&mut world, writer, reader, 2);
    let ends_told = |said: &[(SocketAddr, ReceivedSubmessage)]| {
        let told = collect_announcements(said);
        told.iter().filter(|(who, ..)| *who == writer).count()
    };
    assert_eq!(ends_told(&world.advance(SECOND)), 0);
    // Another process with the same prefix: it has no data, and its numbers and counts start anew.
    let mut anew = FakeServer::new(0);
    anew.acknowledge(&mut world, writer, reader, 1);
    assert_eq!(ends_told(&world.advance(SECOND)), 1);
    anew.acknowledge(&mut world, writer, reader, 2);
    let third = GuidPrefix([8; 12]);
    anew.send_participant(&mut world, 1, &participant(third, 7416));
    assert!(world.knows(third), "the numbers before do not count");
    // Participants found through the first server are still there.
    assert!(world.knows(OTHER));
    assert_eq!(ends.borrow().matched.len(), 1);
}

#[test]
fn a_server_that_is_gone_takes_nobody_with_it() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    let mut server = FakeServer::new(0);
    server.announce_itself(&mut world);
    server.send_participant(&mut world, 2, &participant(OTHER, 7412));
    // Its farewell, which is out of order, or its lease of 20 s.
    let gone = server.prefix;
    server.withdraw(&mut world, 9, gone);
    assert!(!world.knows(server.prefix) && world.knows(OTHER));
    let mut anew = FakeServer::new(0);
    anew.announce_itself(&mut world);
    assert!(world.knows(server.prefix));
    world.advance(19 * SECOND);
    assert!(world.knows(server.prefix));
    world.advance(5 * SECOND);
    assert!(!world.knows(server.prefix) && world.knows(OTHER));
}

#[test]
fn whoever_has_gone_with_the_server_is_missed_when_it_does_not_answer() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    let (ours, _) = world.client.add_writer(world.now, &topic(), EndpointQos::default());
    let mut server = FakeServer::new(0);
    server.announce_itself(&mut world);
    server.send_participant(&mut world, 2, &participant(OTHER, 7412));
    let theirs = reader(OTHER);
    server.send(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, theirs.to_bytes());
    let mut count = 0;
    let mut answer = |world: &mut ClientWorld| {
        count += 1;
        world.confirm_match(ours, &theirs, count);
    };
    // As long as it answers it is alive, whatever happens to the server.
    answer(&mut world);
    let mut times = 0;
    for _ in 0..20 {
        let said = world.advance(4 * SECOND);
        let mut said = said.iter();
        let is_asked = said.any(|(to, it)| {
            let Submessage::Heartbeat(beat) = &it.submessage else {
                return false;
            };
            *to == local_address(7413) && beat.writer == ours.entity && !beat.is_final
        });
        if is_asked {
            times += 1;
            answer(&mut world);
        }
    }
    assert!(times >= 10, "{times} times in 80 s");
    assert!(world.knows(OTHER) && !world.knows(server.prefix));
    world.advance(20 * SECOND);
    assert!(world.knows(OTHER), "a server would have said so first: its lease is 20 s");
    world.advance(20 * SECOND);
    assert!(!world.knows(OTHER));
}

#[test]
fn an_endpoint_is_announced_again_until_the_other_side_knows_it() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    let (ours, _) = world.client.add_writer(world.now, &topic(), EndpointQos::default());
    let mut server = FakeServer::new(0);
    server.announce_itself(&mut world);
    let (writer, reader_of_it) = ANNOUNCERS[0];
    // The server acknowledges whatever it is told, and forwards nothing.
    let mut told = Vec::new();
    let mut serve = |world: &mut ClientWorld, server: &mut FakeServer, duration: u32| {
        let before = told.len();
        for _ in 0..duration * 4 {
            let said = collect_announcements(&world.advance(SECOND / 4));
            told.extend(said.into_iter().filter(|(who, ..)| *who == writer).map(|(_, number, _)| number));
            let next = told.iter().max().map_or(1, |number| number + 1);
            server.acknowledge(world, writer, reader_of_it, next);
        }
        told[before..].to_vec()
    };
    assert_eq!(serve(&mut world, &mut server, 8), [1], "nobody has such a topic");
    server.send_participant(&mut world, 2, &participant(OTHER, 7412));
    let theirs = reader(OTHER);
    server.send(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, theirs.to_bytes());
    let again = serve(&mut world, &mut server, 16);
    assert!((2..=4).contains(&again.len()) && again.is_sorted(), "{again:?}");
    // A server of Fast DDS compares the bytes, and ignores what is the same; others read the same.
    let repeated = theirs.to_bytes_again(1);
    assert!(repeated != theirs.to_bytes() && repeated != theirs.to_bytes_again(2));
    assert_eq!(EndpointData::from_payload(&repeated).expect("an endpoint"), theirs);
    world.confirm_match(ours, &theirs, 1);
    assert_eq!(serve(&mut world, &mut server, 64), [], "it has confirmed the match");
}

#[test]
fn leaving_is_said_to_servers() {
    let mut world = ClientWorld::with_servers(&[discovery_server(0)]);
    FakeServer::new(0).announce_itself(&mut world);
    world.advance(SECOND);
    world.client.close(world.now);
    let said = world.advance(Duration::ZERO);
    let last = said.iter().find_map(|(to, it)| match &it.submessage {
        Submessage::Data(data) if data.inline.status != 0 => Some((to, data)),
        _ => None,
    });
    let (to, data) = last.expect("a last word");
    assert_eq!((*to, data.writer), (local_address(11811), EntityId::SPDP_WRITER));
    let own = Guid::new(GuidPrefix([1; 12]), EntityId::PARTICIPANT);
    assert_eq!(discovery::guid_of_key(data), Some(own));
    assert!(data.inline.related.is_some());
}

#[test]
fn a_server_has_the_name_of_its_place() {
    let name = format!("{:?}", discovery_server(3).prefix());
    assert_eq!(name, "4453035f4550524f53494d41");
}
