//! Peers that lie, leave gaps and never finish what they begin.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};

use budget::Budget;
use ros_bus::net::HostSockets;
use ros_bus::{Digest, FailureReason, JoinOptions, QosProfile, ServiceHandler, ServiceType};
use ros_message::schema::Registry;
use rtps::wire::{Data, DataFrag, DatagramWriter, Heartbeat, InlineQos};
use rtps::{
    Config, EndpointData, EndpointQos, EntityId, Guid, GuidPrefix, HistoryKind, Participant, ParticipantData,
    SequenceNumber, TopicDescription, VendorId,
};

use super::*;
use crate::place::BusSockets;
use crate::{Ros2Bus, entities};

/// The forged writer.
const WRITER: EntityId = EntityId([0, 0, 1, 3]);
const LIMIT: usize = 1 << 20;

fn topic_named(name: &str, type_name: &str) -> TopicDescription {
    TopicDescription { name: name.to_owned(), type_name: type_name.to_owned(), user_data: Bytes::new() }
}

/// A hand-made participant, which receives and answers nothing.
struct Forger {
    prefix: GuidPrefix,
    socket: UdpSocket,
    /// Addresses of the bus for discovery, and for samples.
    discovery: SocketAddr,
    user: SocketAddr,
}

impl Forger {
    /// Announces itself to a bus with a reliable writer of `/chat`; `seen_by` knows the bus's address.
    fn with_a_writer(bus: &Ros2Bus, seen_by: &Ros2Bus, domain: u16) -> Self {
        let known = seen_by.inner.discovery();
        let there = &known.participants[&bus.guid().prefix];
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
        let at = socket.local_addr().expect("its address");
        let forger = Self {
            prefix: GuidPrefix([0xbd; 12]),
            discovery: there.discovery[0].udp_address().expect("an address"),
            user: there.user[0].udp_address().expect("an address"),
            socket,
        };
        let here = vec![(Ipv4Addr::LOCALHOST, at.port()).into()];
        let told = ParticipantData {
            prefix: forger.prefix,
            vendor: VendorId::FAST_DDS,
            version: [2, 3],
            domain: Some(domain.into()),
            name: String::new(),
            user_data: Bytes::new(),
            discovery: here.clone(),
            user: here,
            builtin: 0x3f,
            lease: None,
        };
        forger.data(forger.discovery, EntityId::SPDP_WRITER, 1, told.to_bytes());
        forger.begins(forger.discovery, EntityId::PUBLICATIONS_WRITER);
        let end = EndpointData {
            guid: Guid::new(forger.prefix, WRITER),
            topic: "rt/chat".to_owned(),
            type_name: "std_msgs::msg::dds_::String_".to_owned(),
            qos: EndpointQos { history: HistoryKind::KeepLast(10), ..EndpointQos::default() },
            user_data: Bytes::new(),
            unicast: Vec::new(),
            expects_inline_qos: false,
        };
        let writer = EntityId::PUBLICATIONS_WRITER;
        forger.data(forger.discovery, writer, 1, end.to_bytes());
        forger
    }

    fn send(&self, to: SocketAddr, datagram: DatagramWriter) {
        self.socket.send_to(&datagram.finish(), to).expect("sending");
    }

    fn data(&self, to: SocketAddr, writer: EntityId, number: i64, payload: Bytes) {
        let mut datagram = DatagramWriter::new(self.prefix);
        datagram.data(&Data {
            reader: EntityId::UNKNOWN,
            writer,
            number: SequenceNumber(number),
            inline: InlineQos::default(),
            payload: Some(payload),
            key_only: false,
        });
        self.send(to, datagram);
    }

    /// Sends the first fragment of a sample of about a gigabyte.
    fn fragment(&self, number: i64) {
        let mut datagram = DatagramWriter::new(self.prefix);
        datagram.data_frag(&DataFrag {
            reader: EntityId::UNKNOWN,
            writer: WRITER,
            number: SequenceNumber(number),
            inline: InlineQos::default(),
            first: 1,
            count: 1,
            fragment_size: 60_000,
            sample_size: 60_000_000,
            payload: vec![0; 60_000].into(),
            key_only: false,
        });
        self.send(self.user, datagram);
    }

    /// Announces that a writer has no samples yet, and begins with 1.
    fn begins(&self, to: SocketAddr, writer: EntityId) {
        let mut datagram = DatagramWriter::new(self.prefix);
        datagram.heartbeat(&Heartbeat {
            reader: EntityId::UNKNOWN,
            writer,
            first: SequenceNumber(1),
            last: SequenceNumber(0),
            count: 1,
            is_final: true,
            liveliness: false,
        });
        self.send(to, datagram);
    }
}

#[tokio::test]
async fn what_waits_for_what_never_comes_costs_no_more_than_the_budget() {
    let budget = Budget::new("samples", LIMIT);
    let options = JoinOptions { budget: budget.clone(), ..JoinOptions::in_domain(domain(90), "/one") };
    let joined = Ros2Bus::connect(Arc::new(HostSockets), options).await;
    let (one, two) = (joined.expect("a bus"), join(90, "/two").await);
    let qos = QosProfile::keep_last(10);
    let mut heard = one.subscribe("/chat", string(), qos).await.unwrap();
    let good = two.advertise("/chat", string(), qos).await.unwrap();
    expect_connected(good.matched_subscribers(), 1).await;
    let forger = Forger::with_a_writer(&one, &two, domain(90));
    wait_for_matched(heard.matched.clone(), |matched| matched.peers.len() == 2).await;
    forger.begins(forger.user, WRITER);
    let pause = || tokio::time::sleep(Duration::from_millis(2));
    // Number 1 never arrives. Some of these may be lost in transit.
    for number in 2..=200 {
        if number % 10 == 0 {
            forger.fragment(number);
        } else {
            forger.data(forger.user, WRITER, number, vec![0; 60_000].into());
        }
        pause().await;
    }
    assert!(budget.refusal_count() > 100, "{budget:?}");
    assert!((LIMIT / 2..=LIMIT).contains(&budget.used_bytes()), "{budget:?}");
    good.publish(numbered_message(7));
    assert_eq!(next(&mut heard).await.bytes, numbered_message(7));
    // The forger's samples are dropped with the forger.
    drop(forger);
    let gone = wait_for_matched(heard.matched.clone(), |matched| matched.peers.len() == 1).await;
    assert_eq!(gone.peers.len(), 1);
    assert_eq!(budget.used_bytes(), 0);
}

#[tokio::test]
async fn nodes_that_tell_nonsense_of_themselves_harm_nobody() {
    let one = join(91, "/one").await;
    let place = Arc::new(BusSockets(Arc::new(HostSockets)));
    let liar = Participant::join(place, Config::new(domain(91), "liar")).await;
    let liar = liar.expect("a participant");
    let tells = liar.writer(entities::topic(), entities::qos());
    let chats = liar.writer(topic_named("rt/chat", "std_msgs::msg::dds_::String_"), EndpointQos::default());
    let asks = liar.writer(topic_named("rq/echoRequest", "tests::srv::dds_::Echo_Request_"), EndpointQos::default());
    let registry = Registry::for_version(RosVersion::Two);
    let text = "string data\n---\nstring data\n";
    registry.insert("tests/srv/Echo", text).unwrap();
    let of = ServiceType::from_service(&registry.service("tests/srv/Echo").unwrap());
    let _serving = one.serve("/echo", of, Arc::new(Echo)).await.unwrap();
    let mut heard = one.subscribe("/chat", string(), QosProfile::keep_last(100)).await.unwrap();
    expect_connected(heard.matched.clone(), 1).await;
    let nonsense = [
        Bytes::new(),
        Bytes::from_static(&[0]),
        Bytes::from_static(&[0, 1, 0]),
        Bytes::from_static(&[0, 1, 0, 0]),
        Bytes::from_static(&[0xff; 64]),
        Bytes::from_static(&[0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff]),
        Bytes::from(vec![1; 100_000]),
    ];
    for bytes in nonsense {
        tells.write(bytes.clone());
        chats.write(bytes.clone());
        asks.write(bytes);
    }
    let two = join(91, "/two").await;
    let good = two.advertise("/chat", string(), QosProfile::keep_last(10));
    let good = good.await.unwrap();
    expect_connected(good.matched_subscribers(), 1).await;
    good.publish(numbered_message(7));
    while next(&mut heard).await.bytes != numbered_message(7) {}
    let mut graph = two.graph();
    let served = graph.wait_for(|graph| graph.services.contains_key("/echo"));
    timeout(LONG, served).await.expect("in time").expect("open");
    let answer = two.call_typed("/echo", &Digest::any(), numbered_message(8), LONG).await;
    assert_eq!(answer.unwrap(), numbered_message(8));
}

struct Echo;

#[async_trait::async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(request)
    }
}
