use std::task::Waker;
use std::time::Duration;

use ros::bus::{SerializedMessage as BusMessage, WireType};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use rosbridge::Compression;
use tokio::io::DuplexStream;
use tokio::net::TcpListener;

use super::*;
use crate::sample::TopicTypes;
use crate::sample::{EncodedFrame, TopicSample};
use crate::shared::BridgeShared;
use crate::topic_queue::SubscriptionOptions;
use crate::{BridgeOptions, SessionOptions};

/// Creates a connection that only the test polls, without pings of its own, and the client's end.
async fn connection(options: SessionOptions) -> (BridgeConnection<DuplexStream>, DuplexStream) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions { uri: format!("http://{address}/"), ..MasterOptions::default() });
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let bus = Ros1Bus::connect(Arc::new(HostSockets), address, "/bridge").await.unwrap();
    let quiet =
        BridgeOptions { ping_interval: Duration::ZERO, idle_timeout: Duration::ZERO, ..BridgeOptions::default() };
    let shared = BridgeShared::new(bus, Arc::new(Registry::new()), quiet);
    let client = shared.client_for(&options).unwrap();
    let (ours, theirs) = tokio::io::duplex(1 << 20);
    let socket = WebSocket::new(ours, b"", 1 << 20, 1 << 20);
    let number = client.outbox.attach();
    (
        BridgeConnection::new(
            socket,
            EarlyMessages::with_budget(&budget::Budget::without_limit()),
            client,
            number,
            &budget::Budget::without_limit(),
        ),
        theirs,
    )
}

fn step(connection: &mut BridgeConnection<DuplexStream>) {
    let step = connection.step(&mut Context::from_waker(Waker::noop()));
    assert!(step.is_pending(), "the connection ends");
}

fn sample() -> Arc<TopicSample> {
    let wire_type = WireType::with_name("a/B");
    let message = BusMessage {
        bytes: vec![0; 8].into(),
        wire_type: Arc::new(wire_type),
        publisher: "/p".into(),
        latching: false,
    };
    let types = TopicTypes::new(Arc::new(Registry::new()));
    Arc::new(TopicSample::new(message, false, Arc::new(types), &BridgeOptions::default()).unwrap())
}

#[tokio::test]
async fn what_a_throttle_rate_holds_back_wakes_the_connection_when_it_is_due() {
    let (mut connection, _client) = connection(SessionOptions::default()).await;
    let outbox = connection.client.outbox.clone();
    let wishes = SubscriptionOptions {
        throttle_rate: Duration::from_secs(300),
        queue_length: 2,
        fragment_size: None,
        compression: Compression::CborRaw,
    };
    let key = outbox.add_topic("/t".into(), wishes);
    for _ in 0..10 {
        outbox.push_sample(key, sample(), false);
    }
    step(&mut connection);
    let due = outbox.next_due();
    assert!(due.is_some(), "one of them waits");
    assert_eq!(connection.timer_at, due);
}

#[tokio::test]
async fn an_answer_is_asked_about_when_its_patience_is_over() {
    let options = SessionOptions { resume: Some("secret".to_owned()), ..SessionOptions::default() };
    let (mut connection, _client) = connection(options).await;
    let answer = |size: usize| EncodedFrame { format: Format::Cbor, bytes: vec![0; size].into() };
    connection.client.send_frame(answer(10), None, true);
    step(&mut connection);
    let due = connection.acks.ping_due();
    assert!(due.is_some(), "nothing has asked about it yet");
    assert_eq!(connection.timer_at, due);
}
