//! Flow control by the fill level of the receivers' buffers. Peers on this machine have receive buffers of about 200 kB
//! by default, which an image sent at the speed of the loopback device overflows; the excess is lost silently. The
//! kernel reports how much of such a buffer is in use (`NETLINK_SOCK_DIAG`, sock_diag(7)), so it is filled up to a
//! fraction. Where the level is unknown, sending is paced.

use std::collections::{BTreeSet, HashMap};
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use socket2::Socket;

use crate::pace::Pacer;

/// Fraction of a receiver's buffer that is used at most; the rest is left to other senders.
const BUFFER_SHARE: (usize, usize) = (5, 8);
/// Bytes that may be sent without a query after a pause, to a receiver that had room: a small part of any buffer.
const UNQUERIED_BYTES: usize = 8 << 10;
/// Time for which the result of a query is valid.
const RECENT: Duration = Duration::from_millis(1);
/// Time after which a full receiver is queried again.
const LOOK_AGAIN: Duration = Duration::from_micros(60);
/// Overhead of a datagram in the kernel: headers and packet record.
const OVERHEAD: usize = 448;
const RECORD: usize = 256;

/// Estimate of what a receiver can take.
#[derive(Debug, Clone, Copy)]
struct Credit {
    bytes: usize,
    asked: Instant,
    /// The receiver had no room at the last query, so nothing is sent without another one.
    full: bool,
}

/// Flow control for all receivers.
#[derive(Debug)]
pub(crate) struct FlowControl {
    diagnostics: Option<Socket>,
    /// Addresses of this machine except those of the loopback device.
    own: BTreeSet<Ipv4Addr>,
    credits: HashMap<SocketAddr, Credit>,
    pace: Pacer,
    /// Time after which a full receiver is to be queried again; `None` if all had room.
    wait: Option<Duration>,
    answer: Vec<u8>,
}

impl FlowControl {
    /// Creates flow control with a kernel diagnostics socket in the network namespace of the receivers.
    pub fn new(diagnostics: Option<OwnedFd>) -> Self {
        let diagnostics = diagnostics.map(Socket::from);
        if let Some(socket) = &diagnostics {
            // The kernel answers immediately; if it does not, nobody should wait for it.
            let _ = socket.set_read_timeout(Some(Duration::from_millis(100)));
        }
        Self {
            diagnostics,
            own: BTreeSet::new(),
            credits: HashMap::new(),
            pace: Pacer::default(),
            wait: None,
            answer: vec![0; 32 << 10],
        }
    }

    /// Returns whether the kernel can be queried.
    pub fn has_diagnostics(&self) -> bool {
        self.diagnostics.is_some()
    }

    /// Sets the current addresses of this machine.
    pub fn set_local_addresses(&mut self, own: impl Iterator<Item = Ipv4Addr>) {
        self.own = own.collect();
    }

    /// Returns the time after which to query receivers that had no room since the last call.
    pub fn take_wait(&mut self) -> Option<Duration> {
        self.wait.take()
    }

    /// Returns whether a receiver can take a datagram of this length now, and if so counts it as sent. `again`: the
    /// receiver has requested it again.
    pub fn try_reserve(&mut self, now: Instant, to: SocketAddr, length: usize, again: bool) -> bool {
        let wait = match self.local_address(to) {
            Some(at) if self.reserve_credit(now, at, length) => return true,
            Some(_) => LOOK_AGAIN,
            None => match self.pace.try_reserve(now, to, length, again) {
                Ok(()) => return true,
                Err(wait) => wait,
            },
        };
        self.wait = Some(self.wait.map_or(wait, |before| before.min(wait)));
        false
    }

    /// Returns the address of a receiver whose buffer can be queried: one on this machine.
    fn local_address(&self, to: SocketAddr) -> Option<SocketAddrV4> {
        let SocketAddr::V4(at) = to else {
            return None;
        };
        let here = at.ip().is_loopback() || self.own.contains(at.ip());
        (here && self.has_diagnostics()).then_some(at)
    }

    fn reserve_credit(&mut self, now: Instant, address: SocketAddrV4, length: usize) -> bool {
        let to = SocketAddr::V4(address);
        let cost = (length + OVERHEAD).next_power_of_two() + RECORD;
        let credit = self.credits.entry(to).or_insert(Credit { bytes: UNQUERIED_BYTES, asked: now, full: false });
        if !credit.full && now.saturating_duration_since(credit.asked) > RECENT {
            *credit = Credit { bytes: credit.bytes.max(UNQUERIED_BYTES), asked: now, full: false };
        }
        if credit.bytes >= cost {
            credit.bytes -= cost;
            return true;
        }
        let (queued, buffer) = match self.query_buffer(*address.ip(), address.port()) {
            Ok(Some(told)) => told,
            // Nobody is there, or the kernel does not answer: nothing to wait for.
            Ok(None) | Err(_) => return true,
        };
        let free = (buffer / BUFFER_SHARE.1 * BUFFER_SHARE.0).saturating_sub(queued);
        let fits = free >= cost || queued == 0;
        let bytes = free.saturating_sub(if fits { cost } else { 0 });
        self.credits.insert(to, Credit { bytes: if fits { bytes } else { 0 }, asked: now, full: !fits });
        fits
    }

    /// Forgets receivers to which nothing was sent recently.
    pub fn remove_expired(&mut self, now: Instant) {
        self.pace.remove_expired(now);
        self.credits.retain(|_, credit| now.saturating_duration_since(credit.asked) < Duration::from_secs(10));
    }

    /// Queries the bytes in use and the size of the receive buffer of the socket bound there; `None` if there is no
    /// socket.
    fn query_buffer(&mut self, ip: Ipv4Addr, port: u16) -> io::Result<Option<(usize, usize)>> {
        let Some(socket) = &mut self.diagnostics else {
            return Ok(None);
        };
        socket.write_all(&encode_request(ip, port))?;
        let length = socket.read(&mut self.answer)?;
        let mut found = None;
        for (kind, body) in split_messages(&self.answer[..length]) {
            if kind == SOCK_DIAG_BY_FAMILY {
                found = parse_buffer_usage(body);
            }
        }
        Ok(found)
    }

    /// Returns the addresses on this machine at which a UDP socket is bound. They are queried one by one: for a list of
    /// all sockets the kernel would walk a table of thousands of rows.
    pub fn find_bound(
        &mut self,
        addresses: impl IntoIterator<Item = SocketAddrV4>,
    ) -> io::Result<BTreeSet<SocketAddrV4>> {
        let mut bound = BTreeSet::new();
        for at in addresses {
            if self.query_buffer(*at.ip(), at.port())?.is_some() {
                bound.insert(at);
            }
        }
        Ok(bound)
    }
}

const SOCK_DIAG_BY_FAMILY: u16 = 20;
const NLM_F_REQUEST: u16 = 1;
const INET_DIAG_SKMEMINFO: u8 = 7;

/// Encodes `struct nlmsghdr` and `struct inet_diag_req_v2` for the socket that receives at this address.
fn encode_request(ip: Ipv4Addr, port: u16) -> Vec<u8> {
    const LENGTH: u32 = 16 + 56;
    let mut bytes = Vec::with_capacity(LENGTH as usize);
    bytes.extend(LENGTH.to_ne_bytes());
    bytes.extend(SOCK_DIAG_BY_FAMILY.to_ne_bytes());
    bytes.extend(NLM_F_REQUEST.to_ne_bytes());
    bytes.extend([0; 8]);
    // AF_INET, IPPROTO_UDP, requested extensions, padding; any state.
    bytes.extend([2, 17, 1 << (INET_DIAG_SKMEMINFO - 1), 0]);
    bytes.extend(u32::MAX.to_ne_bytes());
    // Source and destination port. For a single UDP socket, the kernel uses the destination as the socket's own
    // address.
    bytes.extend(0u16.to_be_bytes());
    bytes.extend(port.to_be_bytes());
    for address in [Ipv4Addr::LOCALHOST, ip] {
        bytes.extend(address.octets());
        bytes.extend([0; 12]);
    }
    // No interface; any cookie.
    bytes.extend(0u32.to_ne_bytes());
    bytes.extend([0xff; 8]);
    bytes
}

/// Splits an answer into messages: type and body.
fn split_messages(mut bytes: &[u8]) -> impl Iterator<Item = (u16, &[u8])> {
    std::iter::from_fn(move || {
        let length = u32::from_ne_bytes(bytes.get(..4)?.try_into().ok()?) as usize;
        let kind = u16::from_ne_bytes(bytes.get(4..6)?.try_into().ok()?);
        let body = bytes.get(16..length)?;
        bytes = bytes.get(length.next_multiple_of(4)..).unwrap_or_default();
        Some((kind, body))
    })
}

/// Parses `struct inet_diag_msg` and its attributes: bytes in use and size of the buffer.
fn parse_buffer_usage(body: &[u8]) -> Option<(usize, usize)> {
    const MESSAGE: usize = 72;
    let number = |bytes: &[u8], at: usize| Some(u32::from_ne_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize);
    let queued = number(body, 56)?;
    let mut attributes = body.get(MESSAGE..)?;
    while attributes.len() >= 4 {
        let length = usize::from(u16::from_ne_bytes([attributes[0], attributes[1]]));
        let kind = u16::from_ne_bytes([attributes[2], attributes[3]]);
        let value = attributes.get(4..length)?;
        if kind == u16::from(INET_DIAG_SKMEMINFO) {
            // SK_MEMINFO_RMEM_ALLOC, SK_MEMINFO_RCVBUF.
            return Some((queued, number(value, 4)?));
        }
        attributes = attributes.get(length.next_multiple_of(4)..).unwrap_or_default();
    }
    None
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use socket2::{Domain, Protocol, Type};

    use super::*;

    fn flow() -> FlowControl {
        // AF_NETLINK and NETLINK_SOCK_DIAG.
        let socket =
            Socket::new(Domain::from(16), Type::DGRAM, Some(Protocol::from(4))).expect("a socket of diagnostics");
        FlowControl::new(Some(socket.into()))
    }

    #[test]
    fn a_receiver_that_does_not_read_is_sent_no_more_than_it_can_take() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a sender");
        let to = receiver.local_addr().expect("its address");
        let mut flow = flow();
        let datagram = [7; 16_000];
        let mut sent = 0;
        while flow.try_reserve(Instant::now(), to, datagram.len(), false) {
            sender.send_to(&datagram, to).expect("sending");
            sent += 1;
            assert!(sent < 10_000, "never refused");
        }
        assert!(sent >= 2, "{sent} datagrams");
        receiver.set_nonblocking(true).expect("a receiver that does not wait");
        let mut buffer = [0; 65_536];
        let came = (0..).take_while(|_| receiver.recv(&mut buffer).is_ok()).count();
        assert_eq!(came, sent, "all that was sent has come");
        assert!(flow.try_reserve(Instant::now(), to, datagram.len(), false), "there is room again");
    }

    #[test]
    fn a_receiver_that_was_full_is_looked_at_however_long_ago_that_was() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a sender");
        let to = receiver.local_addr().expect("its address");
        let (mut flow, mut now) = (flow(), Instant::now());
        let datagram = [7; 1000];
        while flow.try_reserve(now, to, datagram.len(), false) {
            sender.send_to(&datagram, to).expect("sending");
        }
        for _ in 0..100 {
            now += 2 * RECENT;
            assert!(!flow.try_reserve(now, to, datagram.len(), false), "it is still full");
        }
    }

    #[test]
    fn bound_ports_are_told_and_gone_ones_are_not() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let port = receiver.local_addr().expect("its address").port();
        let at = SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
        let mut flow = flow();
        assert_eq!(flow.find_bound([at]).expect("ports"), BTreeSet::from([at]));
        drop(receiver);
        assert_eq!(flow.find_bound([at]).expect("ports"), BTreeSet::new());
    }

    #[test]
    fn nobody_waits_for_a_receiver_that_is_not_there() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let to = receiver.local_addr().expect("its address");
        drop(receiver);
        let mut flow = flow();
        assert!((0..1000).all(|_| flow.try_reserve(Instant::now(), to, 16_000, false)));
    }
}
