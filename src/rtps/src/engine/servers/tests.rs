//! A client before a server that is made by hand: what it is told, and what it says.

use bytes::Bytes;

use super::*;
use crate::VendorId;
use crate::discovery::EndpointData;
use crate::engine::{BUILTIN, Settings};
use crate::locator::Ports;
use crate::network::Network;
use crate::participant::Topic;
use crate::qos::EndpointQos;
use crate::reader::Bounds;
use crate::wire::{DatagramWriter, Received, Submessage};

const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);
const SECOND: Duration = Duration::from_secs(1);

fn at(port: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], port))
}

fn participant(prefix: GuidPrefix, port: u16) -> ParticipantData {
    let locator = |port: u16| vec![Locator::from((std::net::Ipv4Addr::LOCALHOST, port))];
    ParticipantData {
        prefix,
        vendor: VendorId::FAST_DDS,
        version: [2, 3],
        // Of another domain: servers have one of their own, and Fast DDS 2 tells none.
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
struct World {
    now: Instant,
    client: Engine,
}

impl World {
    fn of(servers: &[DiscoveryServer]) -> Self {
        let now = Instant::now();
        let own = ParticipantData {
            vendor: VendorId::OURS,
            ..participant(GuidPrefix([1; 12]), 7410)
        };
        let bounds = Bounds {
            max_sample: 1 << 20,
            budget: budget::Budget::unlimited(),
            unfinished: 30 * SECOND,
        };
        let settings = Settings {
            own,
            ports: Ports::of(0).expect("a domain"),
            bounds,
            announce_to: Vec::new(),
            servers: servers.to_vec(),
            network: Network::new(Vec::new()),
            alone: false,
            predecessors: Vec::new(),
        };
        let client = Engine::new(now, settings);
        Self { now, client }
    }

    /// What the client says meanwhile, and where to.
    fn pass(&mut self, duration: Duration) -> Vec<(SocketAddr, Received)> {
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

    /// Says something to the client.
    fn say(&mut self, from: GuidPrefix, write: impl FnOnce(&mut DatagramWriter)) {
        let mut writer = DatagramWriter::new(from);
        write(&mut writer);
        self.client.receive(self.now, HERE, &writer.finish().into());
    }

    fn knows(&self, prefix: GuidPrefix) -> bool {
        let discovered = self.client.discovered();
        let discovered = discovered.borrow();
        discovered.participants.contains_key(&prefix)
    }

    fn ends(&self) -> usize {
        let discovered = self.client.discovered();
        let discovered = discovered.borrow();
        discovered.writers.len() + discovered.readers.len()
    }
}

/// The server's part of what is said.
struct Server {
    prefix: GuidPrefix,
    port: u16,
    counts: u32,
}

impl Server {
    fn new(place: u8) -> Self {
        Self {
            prefix: named(place).prefix(),
            port: named(place).at.port(),
            counts: 0,
        }
    }

    /// One of its announcers has said nothing but this by now.
    fn says(&mut self, world: &mut World, writer: EntityId, number: i64, payload: Bytes) {
        self.says_with(world, writer, number, InlineQos::default(), payload);
    }

    fn says_with(
        &mut self,
        world: &mut World,
        writer: EntityId,
        number: i64,
        inline: InlineQos,
        payload: Bytes,
    ) {
        self.counts += 1;
        let number = SequenceNumber(number);
        let key_only = inline.status != 0;
        let data = wire::Data {
            reader: EntityId::UNKNOWN,
            writer,
            number,
            inline,
            payload: Some(payload),
            key_only,
        };
        let beat = wire::Heartbeat {
            reader: EntityId::UNKNOWN,
            writer,
            first: number,
            last: number,
            count: self.counts,
            is_final: false,
            liveliness: false,
        };
        world.say(self.prefix, |out| {
            out.data(&data);
            out.heartbeat(&beat);
        });
    }

    fn tells(&mut self, world: &mut World, number: i64, of: &ParticipantData) {
        self.says(world, EntityId::SPDP_WRITER, number, of.to_bytes());
    }

    fn announces_itself(&mut self, world: &mut World) {
        let own = participant(self.prefix, self.port);
        self.tells(world, 1, &own);
    }

    fn takes_back(&mut self, world: &mut World, number: i64, gone: GuidPrefix) {
        let guid = Guid::new(gone, EntityId::PARTICIPANT);
        let inline = InlineQos {
            status: DISPOSED,
            key_hash: Some(guid.bytes()),
            ..InlineQos::default()
        };
        let key = discovery::key(guid);
        self.says_with(world, EntityId::SPDP_WRITER, number, inline, key);
    }

    /// Its reader has all before this number of what our announcer has said.
    fn acknowledges(&mut self, world: &mut World, writer: EntityId, reader: EntityId, next: i64) {
        self.counts += 1;
        let acknack = wire::AckNack {
            reader,
            writer,
            set: SequenceSet::empty(SequenceNumber(next)),
            count: self.counts,
            is_final: true,
        };
        world.say(self.prefix, |out| {
            out.acknack(&acknack);
        });
    }
}

fn named(place: u8) -> DiscoveryServer {
    DiscoveryServer {
        place,
        at: at(11811 + u16::from(place)),
    }
}

fn topic() -> Topic {
    Topic {
        name: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        user_data: Bytes::new(),
    }
}

/// A reader of that topic.
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

/// What our announcers have said: who, the number, and to whom.
fn announced(said: &[(SocketAddr, Received)]) -> Vec<(EntityId, i64, SocketAddr)> {
    let data = said.iter().filter_map(|(to, it)| match &it.submessage {
        Submessage::Data(data) => Some((data.writer, data.number.0, *to)),
        _ => None,
    });
    data.collect()
}

const OTHER: GuidPrefix = GuidPrefix([9; 12]);

#[test]
fn servers_alone_are_told_and_again_until_they_are_there() {
    let mut world = World::of(&[named(0), named(3)]);
    assert!(world.client.ports_to_look_at().iter().eq([
        &SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 11811),
        &SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 11814),
    ]));
    world.pass(SECOND);
    let said = world.pass(9 * SECOND);
    let told = announced(&said);
    for server in [at(11811), at(11814)] {
        let times = told.iter().filter(|(_, _, to)| *to == server).count();
        assert!((15..=25).contains(&times), "{times} times in 9 s");
    }
    assert!(
        told.iter()
            .all(|(writer, number, to)| *writer == EntityId::SPDP_WRITER
                && *number == 1
                && [11811, 11814].contains(&to.port())),
        "{told:?}"
    );
    let (_, first) = &said[0];
    let Submessage::Data(data) = &first.submessage else {
        panic!("{first:?}");
    };
    // What a server passes on nothing without: whose it is, by name, number and implementation.
    let related = data.inline.related.expect("an identity");
    let own = Guid::new(GuidPrefix([1; 12]), EntityId::SPDP_WRITER);
    assert_eq!((related.writer, related.number), (own, SequenceNumber(1)));
    let payload = data.payload.clone().expect("a payload");
    let told = ParticipantData::from_payload(&payload).expect("a participant");
    assert_eq!(told.vendor, VendorId::FAST_DDS);
    let text = String::from_utf8_lossy(&payload);
    assert!(text.contains("PARTICIPANT_TYPE\0") && text.contains("SUPER_CLIENT\0"));
    // Both are there: then seldom.
    for place in [0, 3] {
        Server::new(place).announces_itself(&mut world);
    }
    world.pass(SECOND);
    let often = announced(&world.pass(9 * SECOND)).len();
    assert!((4..=10).contains(&often), "{often} times in 9 s");
}

#[test]
fn others_are_known_by_the_server_and_spoken_with_directly() {
    let mut world = World::of(&[named(0)]);
    let (_, ends) = world
        .client
        .add_writer(world.now, &topic(), EndpointQos::default());
    let mut server = Server::new(0);
    server.announces_itself(&mut world);
    let said = announced(&world.pass(SECOND));
    let to_server = (EntityId::PUBLICATIONS_WRITER, 1, at(11811));
    assert!(said.contains(&to_server), "{said:?}");
    server.tells(&mut world, 2, &participant(OTHER, 7412));
    let end = reader(OTHER).to_bytes();
    server.says(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    assert!(world.knows(OTHER));
    assert_eq!(ends.borrow().matched.len(), 1);
    let said = world.pass(SECOND);
    // It is sent samples where its ends receive, and asked there; of ends it hears by the server alone.
    let others = said.iter().filter(|(to, _)| *to != at(11811));
    let user_ports: Vec<u16> = others.map(|(to, _)| to.port()).collect();
    assert!(!user_ports.is_empty() && user_ports.iter().all(|port| *port == 7413));
    server.takes_back(&mut world, 3, OTHER);
    assert!(!world.knows(OTHER));
    assert_eq!((ends.borrow().matched.len(), world.ends()), (0, 0));
}

#[test]
fn whoever_is_no_server_is_not_heard() {
    let mut world = World::of(&[named(0)]);
    let mut stranger = Server {
        prefix: OTHER,
        port: 7412,
        counts: 0,
    };
    stranger.announces_itself(&mut world);
    // Nor what it says of others, nor of their ends.
    stranger.tells(&mut world, 2, &participant(GuidPrefix([8; 12]), 7414));
    let end = reader(GuidPrefix([8; 12])).to_bytes();
    stranger.says(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    assert!(!world.knows(OTHER) && !world.knows(GuidPrefix([8; 12])));
    assert_eq!(world.ends(), 0);
    // A server of a name of its own is known by its address.
    let mut server = Server {
        prefix: GuidPrefix([7; 12]),
        port: 11811,
        counts: 0,
    };
    server.announces_itself(&mut world);
    assert!(world.knows(server.prefix));
    // What it says of ends of whom it has not told is not kept.
    let end = reader(OTHER).to_bytes();
    server.says(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    assert_eq!(world.ends(), 0);
    server.tells(&mut world, 2, &participant(OTHER, 7412));
    assert!(world.knows(OTHER));
}

#[test]
fn a_server_begun_anew_is_told_all_again() {
    let mut world = World::of(&[named(0)]);
    let mut server = Server::new(0);
    server.announces_itself(&mut world);
    let (_, ends) = world
        .client
        .add_writer(world.now, &topic(), EndpointQos::default());
    server.tells(&mut world, 2, &participant(OTHER, 7412));
    let end = reader(OTHER).to_bytes();
    server.says(&mut world, EntityId::SUBSCRIPTIONS_WRITER, 1, end);
    world.pass(SECOND);
    let (writer, reader) = ANNOUNCERS[0];
    server.acknowledges(&mut world, writer, reader, 2);
    let ends_told = |said: &[(SocketAddr, Received)]| {
        let told = announced(said);
        told.iter().filter(|(who, ..)| *who == writer).count()
    };
    assert_eq!(ends_told(&world.pass(SECOND)), 0);
    // Another process has its name: it has nothing, and its own numbers and counts begin anew.
    let mut anew = Server::new(0);
    anew.acknowledges(&mut world, writer, reader, 1);
    assert_eq!(ends_told(&world.pass(SECOND)), 1);
    anew.acknowledges(&mut world, writer, reader, 2);
    let third = GuidPrefix([8; 12]);
    anew.tells(&mut world, 1, &participant(third, 7416));
    assert!(world.knows(third), "the numbers before do not count");
    // Who was found by the first is there still.
    assert!(world.knows(OTHER));
    assert_eq!(ends.borrow().matched.len(), 1);
}

#[test]
fn a_server_that_is_gone_takes_nobody_with_it() {
    let mut world = World::of(&[named(0)]);
    let mut server = Server::new(0);
    server.announces_itself(&mut world);
    server.tells(&mut world, 2, &participant(OTHER, 7412));
    // Its last word, which is not in order, or its lease of 20 s.
    let gone = server.prefix;
    server.takes_back(&mut world, 9, gone);
    assert!(!world.knows(server.prefix) && world.knows(OTHER));
    let mut anew = Server::new(0);
    anew.announces_itself(&mut world);
    assert!(world.knows(server.prefix));
    world.pass(19 * SECOND);
    assert!(world.knows(server.prefix));
    world.pass(5 * SECOND);
    assert!(!world.knows(server.prefix) && world.knows(OTHER));
}

#[test]
fn whoever_has_gone_with_the_server_is_missed_when_it_does_not_answer() {
    let mut world = World::of(&[named(0)]);
    let (ours, _) = world
        .client
        .add_writer(world.now, &topic(), EndpointQos::default());
    let mut server = Server::new(0);
    server.announces_itself(&mut world);
    server.tells(&mut world, 2, &participant(OTHER, 7412));
    let theirs = reader(OTHER);
    server.says(
        &mut world,
        EntityId::SUBSCRIPTIONS_WRITER,
        1,
        theirs.to_bytes(),
    );
    let mut count = 0;
    let mut answer = |world: &mut World| {
        count += 1;
        let acknack = wire::AckNack {
            reader: theirs.guid.entity,
            writer: ours.entity,
            set: SequenceSet::empty(SequenceNumber(1)),
            count,
            is_final: true,
        };
        world.say(OTHER, |out| {
            out.acknack(&acknack);
        });
    };
    // As long as it answers it is there, whatever has become of the server.
    answer(&mut world);
    let mut times = 0;
    for _ in 0..20 {
        let said = world.pass(4 * SECOND);
        let mut said = said.iter();
        let is_asked = said.any(|(to, it)| {
            let Submessage::Heartbeat(beat) = &it.submessage else {
                return false;
            };
            *to == at(7413) && beat.writer == ours.entity && !beat.is_final
        });
        if is_asked {
            times += 1;
            answer(&mut world);
        }
    }
    assert!(times >= 10, "{times} times in 80 s");
    assert!(world.knows(OTHER) && !world.knows(server.prefix));
    world.pass(20 * SECOND);
    assert!(
        world.knows(OTHER),
        "a server would have said so first: its lease is 20 s"
    );
    world.pass(20 * SECOND);
    assert!(!world.knows(OTHER));
}

#[test]
fn leaving_is_said_to_servers() {
    let mut world = World::of(&[named(0)]);
    Server::new(0).announces_itself(&mut world);
    world.pass(SECOND);
    world.client.close(world.now);
    let said = world.pass(Duration::ZERO);
    let last = said.iter().find_map(|(to, it)| match &it.submessage {
        Submessage::Data(data) if data.inline.status != 0 => Some((to, data)),
        _ => None,
    });
    let (to, data) = last.expect("a last word");
    assert_eq!((*to, data.writer), (at(11811), EntityId::SPDP_WRITER));
    let own = Guid::new(GuidPrefix([1; 12]), EntityId::PARTICIPANT);
    assert_eq!(discovery::guid_of_key(data), Some(own));
    assert!(data.inline.related.is_some());
}

#[test]
fn a_server_has_the_name_of_its_place() {
    let name = format!("{:?}", named(3).prefix());
    assert_eq!(name, "4453035f4550524f53494d41");
}
