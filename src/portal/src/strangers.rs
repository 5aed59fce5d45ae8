//! Strangers: TCP connections that have not authenticated yet. Anybody can open them, and they cost descriptors and
//! memory, so their number is limited per host and in total. A new one is always admitted; if there is no room, the
//! oldest connection of the network that has most is dropped for it.
//!
//! ```text
//!   accepted ──▶ stranger ──▶ admitted (authenticated, or a robot has a lease): no longer counted
//!                   └───────▶ dropped in favour of newer ones; its client reconnects
//! ```
//!
//! A timeout alone would not do. A robot on a bad link needs seconds for a few packets: a ClientHello that is lost
//! twice is retransmitted after 1 s and after 3 s (RFC 6298). So a stranger has the whole timeout
//! `[portal] handshake` while there is room, and less only under pressure. And whoever causes the pressure suffers
//! from it first: as long as one network has more strangers than another, it loses the next one (docs/adr/114).

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use access::Host;
use parking_lot::Mutex;
use tokio_util::sync::CancellationToken;

use crate::proxies::Proxies;

/// Limit on all strangers. One takes about 40 kB during a TLS handshake, and as much again for a request's header.
const ALL: usize = 1024;
/// Limit on the strangers of one host. If more robots behind one address reconnect at once, some have to retry.
const OF_A_HOST: usize = 128;
/// Divisor for the share of descriptors available to strangers; the others are for authenticated robots, servants and
/// files.
const SHARE: u64 = 4;

/// The current strangers.
#[derive(Debug)]
pub struct Strangers {
    /// Strangers by an increasing number: the first is the oldest.
    present: Mutex<BTreeMap<u64, PresentStranger>>,
    most: usize,
    came: AtomicU64,
    dropped: AtomicU64,
}

#[derive(Debug)]
struct PresentStranger {
    host: Host,
    dropped: CancellationToken,
}

/// A connection counted as a stranger until it is admitted or dropped.
#[derive(Debug)]
pub struct Stranger {
    strangers: Arc<Strangers>,
    number: u64,
    dropped: CancellationToken,
}

impl Strangers {
    /// Creates an empty set, for a process that may open this many descriptors.
    pub fn new(descriptors: u64) -> Strangers {
        let share = usize::try_from(descriptors / SHARE).unwrap_or(ALL);
        Strangers {
            present: Mutex::default(),
            most: share.clamp(1, ALL),
            came: AtomicU64::new(0),
            dropped: AtomicU64::new(0),
        }
    }

    /// Registers a connection from an address, dropping another if there is no room. This machine and trusted proxies
    /// stand for many clients, so the limit per host does not apply to them.
    pub fn enter(self: &Arc<Self>, proxies: &Proxies, from: IpAddr) -> Stranger {
        let is_many = from.to_canonical().is_loopback() || proxies.contains(from);
        let host = Host::from(from);
        let number = self.came.fetch_add(1, Ordering::Relaxed);
        let dropped = CancellationToken::new();
        let mut present = self.present.lock();
        let of_host = present.values().filter(|other| other.host == host).count();
        if !is_many && of_host >= OF_A_HOST {
            self.drop_oldest(&mut present, |other| other == host);
        } else if present.len() >= self.most {
            let network = largest_network(&present);
            self.drop_oldest(&mut present, |other| Some(other.network()) == network);
        }
        let newcomer = PresentStranger { host, dropped: dropped.clone() };
        present.insert(number, newcomer);
        Stranger { strangers: Arc::clone(self), number, dropped }
    }

    /// Drops the oldest stranger of the network that has most, because no descriptor is left.
    pub fn make_room(&self) {
        let mut present = self.present.lock();
        let network = largest_network(&present);
        self.drop_oldest(&mut present, |other| Some(other.network()) == network);
    }

    fn drop_oldest(&self, present: &mut BTreeMap<u64, PresentStranger>, is_meant: impl Fn(Host) -> bool) {
        let oldest = present.iter().find(|(_, other)| is_meant(other.host));
        let Some(number) = oldest.map(|(number, _)| *number) else {
            return;
        };
        if let Some(oldest) = present.remove(&number) {
            oldest.dropped.cancel();
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Returns the number of strangers dropped since the daemon started.
    pub fn dropped_count(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Returns the number of strangers.
    pub fn count(&self) -> usize {
        self.present.lock().len()
    }
}

/// Returns the network with the most strangers.
fn largest_network(present: &BTreeMap<u64, PresentStranger>) -> Option<Host> {
    access::largest_network(present.values().map(|stranger| stranger.host))
}

impl Stranger {
    /// Ends the count of this connection as a stranger, because it is authenticated.
    pub fn admit(&self) {
        self.strangers.present.lock().remove(&self.number);
    }

    /// Waits until the connection is to be dropped, which never happens once it is admitted.
    pub async fn wait_until_dropped(&self) {
        self.dropped.cancelled().await;
    }
}

impl Drop for Stranger {
    fn drop(&mut self) {
        self.admit();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DESCRIPTORS: u64 = 1 << 19;

    fn enter(strangers: &Arc<Strangers>, from: &str) -> Stranger {
        let proxies = Proxies(vec!["192.0.2.0/24".parse().expect("a network")]);
        strangers.enter(&proxies, from.parse().expect("an address"))
    }

    /// Returns the positions in `held` of those that were dropped.
    fn dropped_positions(held: &[Stranger]) -> Vec<usize> {
        let dropped = held.iter().enumerate();
        dropped.filter(|(_, stranger)| stranger.dropped.is_cancelled()).map(|(place, _)| place).collect()
    }

    #[test]
    fn a_host_that_has_too_many_loses_its_oldest_and_no_other_does() {
        let strangers = Arc::new(Strangers::new(DESCRIPTORS));
        let mut held = vec![enter(&strangers, "198.51.100.1")];
        held.extend((0..OF_A_HOST).map(|n| enter(&strangers, &format!("2001:db8::{n:x}"))));
        assert_eq!(dropped_positions(&held), [0; 0]);
        held.push(enter(&strangers, "2001:db8::ffff"));
        held.push(enter(&strangers, "2001:db8:0:1::1"));
        assert_eq!(dropped_positions(&held), [1], "the oldest of the same host");
        assert_eq!((strangers.dropped_count(), strangers.count()), (1, OF_A_HOST + 2));
        drop(held);
        assert_eq!(strangers.count(), 0);
    }

    #[test]
    fn eight_hosts_that_say_nothing_keep_nobody_out_and_end_nobody_elses() {
        let strangers = Arc::new(Strangers::new(DESCRIPTORS));
        let robot = enter(&strangers, "203.0.113.9");
        let silent: Vec<Stranger> = (0..4 * ALL).map(|n| enter(&strangers, &format!("198.51.100.{}", n % 8))).collect();
        let others = [robot, enter(&strangers, "203.0.113.10")];
        assert_eq!(dropped_positions(&others), [0; 0]);
        assert_eq!(strangers.count(), ALL);
        assert_eq!(dropped_positions(&silent).len(), 4 * ALL - (ALL - others.len()));
    }

    #[test]
    fn who_has_a_great_network_has_no_more_than_its_share() {
        let strangers = Arc::new(Strangers::new(DESCRIPTORS));
        let robot = enter(&strangers, "2001:db8:1::1");
        // Each is another host.
        let silent: Vec<Stranger> = (0..2 * ALL).map(|n| enter(&strangers, &format!("2001:db8:2:{n:x}::1"))).collect();
        assert_eq!(dropped_positions(&[robot]), [0; 0]);
        assert_eq!(dropped_positions(&silent).len(), ALL + 1);
    }

    #[test]
    fn all_together_are_bounded_whoever_they_are() {
        // The usual default limit of a shell.
        let strangers = Arc::new(Strangers::new(1024));
        let held: Vec<Stranger> =
            (0..1_100).map(|n| enter(&strangers, if n % 2 == 0 { "127.0.0.1" } else { "192.0.2.7" })).collect();
        assert_eq!(strangers.count(), 1024 / SHARE as usize);
        let left = held.last().expect("one");
        assert!(!left.dropped.is_cancelled(), "the newest stays");
        strangers.make_room();
        assert_eq!(strangers.count(), 1024 / SHARE as usize - 1);
    }

    #[tokio::test]
    async fn who_is_known_is_not_dropped_and_makes_room() {
        let strangers = Arc::new(Strangers::new(DESCRIPTORS));
        let known = enter(&strangers, "198.51.100.1");
        known.admit();
        let held: Vec<Stranger> = (0..=OF_A_HOST).map(|_| enter(&strangers, "198.51.100.1")).collect();
        assert_eq!(dropped_positions(&held), [0]);
        held[0].wait_until_dropped().await;
        assert!(!known.dropped.is_cancelled());
    }
}
