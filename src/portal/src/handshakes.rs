//! Handshakes of TLS that are under way: each takes memory and a signature of whoever asks, who need not say who that is. How many
//! there are at once is bounded, for each host and for all together.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use access::Host;
use parking_lot::Mutex;

use crate::proxies::Proxies;

/// Handshakes under way at once. A handshake takes some 40 kB and less than a millisecond of a core.
const ALL: usize = 1024;
/// Those of one host. Robots behind one address that all come back at once are more, and come again.
const OF_A_HOST: usize = 128;

/// Those that are under way.
#[derive(Debug, Default)]
pub struct Handshakes {
    under_way: Mutex<UnderWay>,
    refused: AtomicU64,
}

#[derive(Debug, Default)]
struct UnderWay {
    all: usize,
    by_host: HashMap<Host, usize>,
}

/// One handshake; it ends when this is dropped.
#[derive(Debug)]
pub struct Begun {
    handshakes: Arc<Handshakes>,
    host: Option<Host>,
}

impl Handshakes {
    /// Begins one with a client at an address, where there are not too many. This machine, and proxies in front of the portal, are
    /// many clients: of theirs, only all together are counted.
    pub fn begin(self: &Arc<Self>, proxies: &Proxies, from: IpAddr) -> Option<Begun> {
        let is_many = from.to_canonical().is_loopback() || proxies.has(from);
        let host = (!is_many).then(|| Host::from(from));
        let mut under_way = self.under_way.lock();
        let of_host = host.and_then(|host| under_way.by_host.get(&host).copied());
        if under_way.all >= ALL || of_host.is_some_and(|count| count >= OF_A_HOST) {
            self.refused.fetch_add(1, Ordering::Relaxed);
            return None;
        }
        under_way.all += 1;
        if let Some(host) = host {
            *under_way.by_host.entry(host).or_default() += 1;
        }
        Some(Begun {
            handshakes: Arc::clone(self),
            host,
        })
    }

    /// How many were not begun since the daemon started.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}

impl Drop for Begun {
    fn drop(&mut self) {
        let mut under_way = self.handshakes.under_way.lock();
        under_way.all -= 1;
        let Some(host) = self.host else { return };
        if let Some(count) = under_way.by_host.get_mut(&host) {
            *count -= 1;
            if *count == 0 {
                under_way.by_host.remove(&host);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().expect("an address")
    }

    #[test]
    fn one_host_does_not_keep_the_others_out() {
        let handshakes = Arc::new(Handshakes::default());
        let proxies = Proxies::default();
        let begin = |from: &str| handshakes.begin(&proxies, address(from));
        let held: Vec<Begun> = (0..OF_A_HOST)
            .map(|n| begin(&format!("2001:db8::{n:x}")).expect("few"))
            .collect();
        assert!(begin("2001:db8::ffff").is_none(), "the same network");
        assert!(begin("2001:db8:0:1::1").is_some(), "another");
        assert!(begin("192.0.2.1").is_some(), "another");
        assert_eq!(handshakes.refused(), 1);
        drop(held);
        assert!(begin("2001:db8::1").is_some(), "they have ended");
        assert!(handshakes.under_way.lock().by_host.is_empty());
    }

    #[test]
    fn all_together_are_bounded_whoever_they_are() {
        let handshakes = Arc::new(Handshakes::default());
        let proxies = Proxies(vec!["192.0.2.0/24".parse().expect("a network")]);
        let begin = |from: &str| handshakes.begin(&proxies, address(from));
        let mut held: Vec<Begun> = (0..ALL - 1)
            .map(|_| begin("192.0.2.7").expect("a proxy's clients are many"))
            .collect();
        held.push(begin("127.0.0.1").expect("the last"));
        assert!(begin("127.0.0.1").is_none() && begin("198.51.100.1").is_none());
        held.pop();
        assert!(begin("198.51.100.1").is_some());
    }
}
