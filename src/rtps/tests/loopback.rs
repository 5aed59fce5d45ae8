//! Participants of this process on the loopback device.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use rtps::{
    Config, DurabilityKind, EndpointQos, HistoryKind, NetworkNamespace, Participant, ReceivedSample, ReliabilityKind,
    Sink, TopicDescription,
};
use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;
use tokio::sync::mpsc;

/// The network namespace of this process.
struct TestNamespace;

#[async_trait]
impl NetworkNamespace for TestNamespace {
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM.nonblocking(), None)?;
        socket.set_reuse_address(shared)?;
        socket.set_recv_buffer_size(4 << 20)?;
        socket.bind(&address.into())?;
        UdpSocket::from_std(socket.into())
    }

    async fn open_diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        // AF_NETLINK and NETLINK_SOCK_DIAG.
        let socket = Socket::new(Domain::from(16), Type::DGRAM, Some(Protocol::from(4)))?;
        Ok(Some(socket.into()))
    }
}

/// Forwards samples to a channel.
struct SampleForwarder(mpsc::UnboundedSender<ReceivedSample>);

impl Sink for SampleForwarder {
    fn on_sample(&self, sample: ReceivedSample) {
        let _ = self.0.send(sample);
    }
}

fn sample_channel() -> (Arc<SampleForwarder>, mpsc::UnboundedReceiver<ReceivedSample>) {
    let (sender, receiver) = mpsc::unbounded_channel();
    (Arc::new(SampleForwarder(sender)), receiver)
}

/// Returns a domain that no other test of this process uses.
fn domain() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    100 + (std::process::id() % 16) as u16 * 8 + NEXT.fetch_add(1, Ordering::Relaxed)
}

async fn join(domain: u16) -> Participant {
    Participant::join(Arc::new(TestNamespace), Config::new(domain, "test")).await.expect("a participant")
}

fn topic(name: &str) -> TopicDescription {
    TopicDescription {
        name: format!("rt/{name}"),
        type_name: "std_msgs::msg::dds_::String_".into(),
        user_data: Bytes::new(),
    }
}

fn qos(reliability: ReliabilityKind, depth: u32) -> EndpointQos {
    EndpointQos { reliability, history: HistoryKind::KeepLast(depth), ..EndpointQos::default() }
}

fn payload(mark: u8, length: usize) -> Bytes {
    let mut bytes = vec![mark; length];
    bytes[..4].copy_from_slice(&[0, 1, 0, 0]);
    bytes.into()
}

/// Long enough for everything here, even on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

async fn next(samples: &mut mpsc::UnboundedReceiver<ReceivedSample>) -> ReceivedSample {
    let next = tokio::time::timeout(PATIENCE, samples.recv()).await;
    next.expect("a sample in time").expect("a reader that lives")
}

#[tokio::test]
async fn a_participant_that_comes_later_is_heard() {
    let domain = domain();
    let early = join(domain).await;
    let writer = early.writer(
        topic("chatter"),
        EndpointQos { durability: DurabilityKind::TransientLocal, ..qos(ReliabilityKind::Reliable, 5) },
    );
    writer.write(payload(1, 100));
    let late = join(domain).await;
    let (sink, mut samples) = sample_channel();
    let reader = late.reader(
        topic("chatter"),
        EndpointQos { durability: DurabilityKind::TransientLocal, ..qos(ReliabilityKind::Reliable, 5) },
        sink,
    );
    let sample = next(&mut samples).await;
    assert_eq!((sample.payload[4], sample.writer), (1, writer.guid()));
    let mut ends = writer.watch_matches();
    let confirmed = ends.wait_for(|ends| ends.confirmed == [reader.guid()]);
    tokio::time::timeout(PATIENCE, confirmed).await.expect("in time").expect("a writer that lives");
    late.close().await;
    let left = ends.wait_for(|ends| ends.matched.is_empty());
    tokio::time::timeout(PATIENCE, left).await.expect("in time").expect("a writer that lives");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_samples_come_whole_both_ways() {
    let domain = domain();
    let (one, other) = (join(domain).await, join(domain).await);
    for reliability in [ReliabilityKind::Reliable, ReliabilityKind::BestEffort] {
        let name = format!("image_{reliability}");
        let (sink, mut samples) = sample_channel();
        let reader = other.reader(topic(&name), qos(reliability, 5), sink);
        let writer = one.writer(topic(&name), qos(reliability, 5));
        let (mut ends, mut back) = (writer.watch_matches(), reader.watch_matches());
        tokio::time::timeout(PATIENCE, ends.wait_for(|ends| ends.confirmed.len() == 1))
            .await
            .expect("in time")
            .expect("a writer");
        tokio::time::timeout(PATIENCE, back.wait_for(|ends| ends.confirmed.len() == 1))
            .await
            .expect("in time")
            .expect("a reader");
        for mark in 0..20 {
            let sent = payload(mark, 6_220_804);
            writer.write(sent.clone());
            let sample = next(&mut samples).await;
            assert!(sample.payload == sent, "sample {mark} differs");
        }
    }
}

#[tokio::test]
async fn a_receiver_with_a_small_buffer_loses_nothing() {
    let domain = domain();
    let sender = join(domain).await;
    let receiver =
        Participant::join(Arc::new(SmallBufferNamespace), Config::new(domain, "small")).await.expect("a participant");
    let (sink, mut samples) = sample_channel();
    let reader = receiver.reader(topic("image"), qos(ReliabilityKind::BestEffort, 5), sink);
    let writer = sender.writer(topic("image"), qos(ReliabilityKind::BestEffort, 5));
    let (mut ends, mut back) = (writer.watch_matches(), reader.watch_matches());
    tokio::time::timeout(PATIENCE, ends.wait_for(|ends| ends.matched.len() == 1))
        .await
        .expect("in time")
        .expect("a writer");
    tokio::time::timeout(PATIENCE, back.wait_for(|ends| ends.matched.len() == 1))
        .await
        .expect("in time")
        .expect("a reader");
    let begin = Instant::now();
    for mark in 0..20 {
        writer.write(payload(mark, 921_604));
        assert_eq!(next(&mut samples).await.payload[4], mark);
    }
    println!("20 samples of 0.9 MB in {:?}", begin.elapsed());
}

/// This process's network namespace, with the kernel's default receive buffers.
struct SmallBufferNamespace;

#[async_trait]
impl NetworkNamespace for SmallBufferNamespace {
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        let socket = TestNamespace.bind_udp(address, shared).await?;
        socket2::SockRef::from(&socket).set_recv_buffer_size(106_496)?;
        Ok(socket)
    }
}
