//! A participant whose process has ended disappears immediately if somebody reports it.

use std::net::{Ipv4Addr, SocketAddr};
use std::os::unix::net::UnixDatagram;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Poll;

use async_trait::async_trait;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;
use tokio::time::timeout;

use super::*;
use crate::{Config, NetworkNamespace, Participant};

/// The network namespace of this process.
struct HostNamespace;

#[async_trait]
impl NetworkNamespace for HostNamespace {
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM.nonblocking(), None)?;
        socket.set_reuse_address(shared)?;
        socket.bind(&address.into())?;
        UdpSocket::from_std(socket.into())
    }

    async fn open_diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        // AF_NETLINK and NETLINK_SOCK_DIAG.
        let socket = Socket::new(Domain::from(16), Type::DGRAM, Some(Protocol::from(4)))?;
        Ok(Some(socket.into()))
    }
}

const HOUR: Duration = Duration::from_secs(3600);
/// Only limits the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(60);

/// Returns a domain that no other test of this process uses; those of `tests/loopback.rs` are higher.
fn domain() -> u16 {
    (std::process::id() % 90) as u16
}

/// Between UDP sockets on one machine there is always room: what a receiver does not accept is lost.
#[tokio::test]
async fn room_for_a_datagram_is_awaited_until_its_receiver_has_taken_some() {
    let (sender, receiver) = UnixDatagram::pair().expect("two sockets");
    sender.set_nonblocking(true).expect("it does not block");
    let mut sent = 0;
    while sender.send(&[0; 512]).is_ok() {
        sent += 1;
    }
    let mut room = std::pin::pin!(wait_writable(&sender));
    let at_once = std::future::poll_fn(|context| Poll::Ready(room.as_mut().poll(context)));
    assert!(at_once.await.is_pending(), "there is none");
    for _ in 0..sent {
        receiver.recv(&mut [0; 512]).expect("a datagram");
    }
    timeout(PATIENCE, room).await.expect("in time");
    sender.send(&[0; 512]).expect("there is room");
}

async fn join() -> Participant {
    // At a well-known port, where others detect it.
    let config = Config { well_known: true, ..Config::new(domain(), "test") };
    Participant::join_with_port_interval(Arc::new(HostNamespace), config, HOUR).await.expect("a participant")
}

#[tokio::test]
async fn who_is_killed_is_gone_at_once_when_somebody_says_so() {
    let (here, killed) = (join().await, join().await);
    let prefix = killed.guid().prefix;
    let mut discovered = here.watch_discovered();
    let known = discovered.wait_for(|all| all.participants.contains_key(&prefix));
    let at = {
        let known = timeout(PATIENCE, known).await.expect("in time");
        let known = known.expect("it runs");
        known.participants[&prefix].discovery[0].udp_address().expect("an address")
    };
    // Its sockets are closed without a farewell.
    drop(killed);
    let at = SocketAddr::from((Ipv4Addr::UNSPECIFIED, at.port()));
    let closed = async {
        while std::net::UdpSocket::bind(at).is_err() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    timeout(PATIENCE, closed).await.expect("its port is free");
    let there = || here.watch_discovered().borrow().participants.contains_key(&prefix);
    assert!(there(), "nobody has looked");
    here.check_ports();
    assert!(!there());
}

#[tokio::test]
async fn other_tasks_get_their_turns_while_a_socket_fills_as_fast_as_it_is_read() {
    const TURNS: usize = 100;
    let (other, flooded) = (join().await, join().await);
    let prefix = flooded.guid().prefix;
    let to = {
        let mut discovered = other.watch_discovered();
        let known = discovered.wait_for(|all| all.participants.contains_key(&prefix));
        let known = timeout(PATIENCE, known).await.expect("in time");
        known.expect("it runs").participants[&prefix].user[0].udp_address().expect("an address")
    };
    let is_served = Arc::new(AtomicBool::new(false));
    // Long datagrams take their reader longer than their senders.
    let flooding = || {
        let is_served = Arc::clone(&is_served);
        std::thread::spawn(move || {
            let socket = std::net::UdpSocket::bind("127.0.0.1:0").expect("a socket");
            let deadline = Instant::now() + PATIENCE;
            while !is_served.load(Ordering::Relaxed) && Instant::now() < deadline {
                let _ = socket.send_to(&[0; 60_000], to);
            }
        })
    };
    let senders = [(); 4].map(|()| flooding());
    let begun = Instant::now();
    for _ in 0..TURNS {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    is_served.store(true, Ordering::Relaxed);
    let took = begun.elapsed();
    for sender in senders {
        sender.join().expect("it sends");
    }
    assert!(took < PATIENCE / 2, "{TURNS} turns took {took:?}");
}
