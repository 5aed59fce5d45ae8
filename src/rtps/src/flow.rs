//! How full the receivers' buffers are. Peers on this machine receive into buffers of some 200 kB by default, which a picture sent
//! at the speed of the loopback device overflows; what does not fit is lost without a word. The kernel tells how much of such a
//! buffer is in use (`NETLINK_SOCK_DIAG`, sock_diag(7)), so that it is filled up to a part, and no further. Where that is not known,
//! a pace is kept.

use std::collections::{BTreeSet, HashMap};
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use socket2::Socket;

use crate::pace::Pace;

/// Of a receiver's buffer so much is used at most; the rest is for others.
const PART: (usize, usize) = (5, 8);
/// What may be sent unasked after a pause, to a receiver that had room: it cannot be much of any buffer.
const UNASKED: usize = 8 << 10;
/// What was asked counts for so long.
const RECENT: Duration = Duration::from_millis(1);
/// A receiver without room is looked at again after this time.
const LOOK_AGAIN: Duration = Duration::from_micros(60);
/// What the kernel adds to a datagram: its own headers and its record of the packet.
const OVERHEAD: usize = 448;
const RECORD: usize = 256;

/// What one receiver can take.
#[derive(Debug, Clone, Copy)]
struct Credit {
    bytes: usize,
    asked: Instant,
    /// It had no room when it was looked at last: nothing is sent unasked.
    full: bool,
}

/// Looks at receivers.
#[derive(Debug)]
pub(crate) struct Flow {
    diagnostics: Option<Socket>,
    /// Addresses of this machine beside the loopback device's.
    own: BTreeSet<Ipv4Addr>,
    credits: HashMap<SocketAddr, Credit>,
    pace: Pace,
    /// When one of those without room is to be looked at again; none where all had room.
    wait: Option<Duration>,
    answer: Vec<u8>,
}

impl Flow {
    /// With a socket of the kernel's diagnostics in the network namespace of the receivers.
    pub fn new(diagnostics: Option<OwnedFd>) -> Self {
        let diagnostics = diagnostics.map(Socket::from);
        if let Some(socket) = &diagnostics {
            // The kernel answers at once; should it not, nobody is to wait for it.
            let _ = socket.set_read_timeout(Some(Duration::from_millis(100)));
        }
        Self {
            diagnostics,
            own: BTreeSet::new(),
            credits: HashMap::new(),
            pace: Pace::default(),
            wait: None,
            answer: vec![0; 32 << 10],
        }
    }

    /// Whether the kernel can be asked.
    pub fn sees(&self) -> bool {
        self.diagnostics.is_some()
    }

    /// These are the addresses of this machine now.
    pub fn set_own(&mut self, own: impl Iterator<Item = Ipv4Addr>) {
        self.own = own.collect();
    }

    /// After which time those are to be looked at again that had no room since this was asked last.
    pub fn take_wait(&mut self) -> Option<Duration> {
        self.wait.take()
    }

    /// Whether a receiver can take a datagram of so many bytes now; it is counted as sent if so. `again` tells that it has
    /// asked for it.
    pub fn room(&mut self, now: Instant, to: SocketAddr, length: usize, again: bool) -> bool {
        let wait = match self.seen(to) {
            Some(at) if self.has_room(now, at, length) => return true,
            Some(_) => LOOK_AGAIN,
            None => match self.pace.room(now, to, length, again) {
                Ok(()) => return true,
                Err(wait) => wait,
            },
        };
        self.wait = Some(self.wait.map_or(wait, |before| before.min(wait)));
        false
    }

    /// The address of a receiver whose buffer can be looked at: one of this machine.
    fn seen(&self, to: SocketAddr) -> Option<SocketAddrV4> {
        let SocketAddr::V4(at) = to else {
            return None;
        };
        let here = at.ip().is_loopback() || self.own.contains(at.ip());
        (here && self.sees()).then_some(at)
    }

    fn has_room(&mut self, now: Instant, address: SocketAddrV4, length: usize) -> bool {
        let to = SocketAddr::V4(address);
        let cost = (length + OVERHEAD).next_power_of_two() + RECORD;
        let credit = self.credits.entry(to).or_insert(Credit {
            bytes: UNASKED,
            asked: now,
            full: false,
        });
        if !credit.full && now.saturating_duration_since(credit.asked) > RECENT {
            *credit = Credit {
                bytes: credit.bytes.max(UNASKED),
                asked: now,
                full: false,
            };
        }
        if credit.bytes >= cost {
            credit.bytes -= cost;
            return true;
        }
        let (queued, buffer) = match self.ask(*address.ip(), address.port()) {
            Ok(Some(told)) => told,
            // Nobody is there, or the kernel does not tell: nothing to wait for.
            Ok(None) | Err(_) => return true,
        };
        let free = (buffer / PART.1 * PART.0).saturating_sub(queued);
        let fits = free >= cost || queued == 0;
        let bytes = free.saturating_sub(if fits { cost } else { 0 });
        self.credits.insert(
            to,
            Credit {
                bytes: if fits { bytes } else { 0 },
                asked: now,
                full: !fits,
            },
        );
        fits
    }

    /// Forgets receivers that nobody sends to.
    pub fn tidy(&mut self, now: Instant) {
        self.pace.tidy(now);
        self.credits.retain(|_, credit| {
            now.saturating_duration_since(credit.asked) < Duration::from_secs(10)
        });
    }

    /// Bytes in use in the buffer of the socket that is bound there, and the buffer's size; none where there is no socket.
    fn ask(&mut self, ip: Ipv4Addr, port: u16) -> io::Result<Option<(usize, usize)>> {
        let Some(socket) = &mut self.diagnostics else {
            return Ok(None);
        };
        socket.write_all(&request(ip, port))?;
        let length = socket.read(&mut self.answer)?;
        let mut found = None;
        for (kind, body) in messages(&self.answer[..length]) {
            if kind == SOCK_DIAG_BY_FAMILY {
                found = filled(body);
            }
        }
        Ok(found)
    }

    /// At which of these addresses of this machine a socket of UDP receives. One is asked for after the other: a list of all
    /// sockets costs the kernel a walk through a table of thousands of rows.
    pub fn bound(
        &mut self,
        addresses: impl IntoIterator<Item = SocketAddrV4>,
    ) -> io::Result<BTreeSet<SocketAddrV4>> {
        let mut bound = BTreeSet::new();
        for at in addresses {
            if self.ask(*at.ip(), at.port())?.is_some() {
                bound.insert(at);
            }
        }
        Ok(bound)
    }
}

const SOCK_DIAG_BY_FAMILY: u16 = 20;
const NLM_F_REQUEST: u16 = 1;
const INET_DIAG_SKMEMINFO: u8 = 7;

/// `struct nlmsghdr` and `struct inet_diag_req_v2`: of the socket to which datagrams for this address go.
fn request(ip: Ipv4Addr, port: u16) -> Vec<u8> {
    const LENGTH: u32 = 16 + 56;
    let mut bytes = Vec::with_capacity(LENGTH as usize);
    bytes.extend(LENGTH.to_ne_bytes());
    bytes.extend(SOCK_DIAG_BY_FAMILY.to_ne_bytes());
    bytes.extend(NLM_F_REQUEST.to_ne_bytes());
    bytes.extend([0; 8]);
    // AF_INET, IPPROTO_UDP, what is to be told beside, padding; any state.
    bytes.extend([2, 17, 1 << (INET_DIAG_SKMEMINFO - 1), 0]);
    bytes.extend(u32::MAX.to_ne_bytes());
    // Source port and destination port. For one socket of UDP, the kernel takes the destination for the socket's own address.
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

/// The messages of an answer: kind and body.
fn messages(mut bytes: &[u8]) -> impl Iterator<Item = (u16, &[u8])> {
    std::iter::from_fn(move || {
        let length = u32::from_ne_bytes(bytes.get(..4)?.try_into().ok()?) as usize;
        let kind = u16::from_ne_bytes(bytes.get(4..6)?.try_into().ok()?);
        let body = bytes.get(16..length)?;
        bytes = bytes.get(length.next_multiple_of(4)..).unwrap_or_default();
        Some((kind, body))
    })
}

/// Of `struct inet_diag_msg` and its attributes: bytes in use and the size of the buffer.
fn filled(body: &[u8]) -> Option<(usize, usize)> {
    const MESSAGE: usize = 72;
    let number = |bytes: &[u8], at: usize| {
        Some(u32::from_ne_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize)
    };
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
        attributes = attributes
            .get(length.next_multiple_of(4)..)
            .unwrap_or_default();
    }
    None
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use socket2::{Domain, Protocol, Type};

    use super::*;

    fn flow() -> Flow {
        // AF_NETLINK and NETLINK_SOCK_DIAG.
        let socket = Socket::new(Domain::from(16), Type::DGRAM, Some(Protocol::from(4)))
            .expect("a socket of diagnostics");
        Flow::new(Some(socket.into()))
    }

    #[test]
    fn a_receiver_that_does_not_read_is_sent_no_more_than_it_can_take() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a sender");
        let to = receiver.local_addr().expect("its address");
        let mut flow = flow();
        let datagram = [7; 16_000];
        let mut sent = 0;
        while flow.room(Instant::now(), to, datagram.len(), false) {
            sender.send_to(&datagram, to).expect("sending");
            sent += 1;
            assert!(sent < 10_000, "never refused");
        }
        assert!(sent >= 2, "{sent} datagrams");
        receiver
            .set_nonblocking(true)
            .expect("a receiver that does not wait");
        let mut buffer = [0; 65_536];
        let came = (0..)
            .take_while(|_| receiver.recv(&mut buffer).is_ok())
            .count();
        assert_eq!(came, sent, "all that was sent has come");
        assert!(
            flow.room(Instant::now(), to, datagram.len(), false),
            "there is room again"
        );
    }

    #[test]
    fn a_receiver_that_was_full_is_looked_at_however_long_ago_that_was() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a sender");
        let to = receiver.local_addr().expect("its address");
        let (mut flow, mut now) = (flow(), Instant::now());
        let datagram = [7; 1000];
        while flow.room(now, to, datagram.len(), false) {
            sender.send_to(&datagram, to).expect("sending");
        }
        for _ in 0..100 {
            now += 2 * RECENT;
            assert!(
                !flow.room(now, to, datagram.len(), false),
                "it is still full"
            );
        }
    }

    #[test]
    fn bound_ports_are_told_and_gone_ones_are_not() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let port = receiver.local_addr().expect("its address").port();
        let at = SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
        let mut flow = flow();
        assert_eq!(flow.bound([at]).expect("ports"), BTreeSet::from([at]));
        drop(receiver);
        assert_eq!(flow.bound([at]).expect("ports"), BTreeSet::new());
    }

    #[test]
    fn nobody_waits_for_a_receiver_that_is_not_there() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a receiver");
        let to = receiver.local_addr().expect("its address");
        drop(receiver);
        let mut flow = flow();
        assert!((0..1000).all(|_| flow.room(Instant::now(), to, 16_000, false)));
    }
}
