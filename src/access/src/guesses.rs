//! Rate limiting of guessed tokens and passwords, by address or by account. Pure: the time is passed in.
//!
//! An address may send a number of unknown tokens for free; each further one makes it wait, twice as long each time
//! up to a limit, and what it sends meanwhile is not looked at. A valid token does not reset this: failures only
//! expire.
//!
//! The owner of an IPv6 address can use many others, so its networks are counted as well: the host (/64), the site
//! (/48) and the provider (/32), each of which may fail sixteen times as often as the one within it. So nobody can
//! fill the table with addresses of one network. Somebody with very many networks can, but locks nobody out: the
//! entry whose last failure is oldest is replaced.

use std::collections::HashMap;
use std::hash::Hash;

use crate::Host;
use crate::host::{OF_PROVIDER, OF_SITE};

/// Milliseconds since an arbitrary epoch.
type Millis = u64;

/// Number of failures before an address has to wait.
pub const FREE: u32 = 10;
/// Factor by which a network's allowance exceeds that of a network within it.
const WIDER: u32 = 16;
/// Shortest and longest wait.
const SHORTEST: Millis = 1_000;
const LONGEST: Millis = 60_000;
/// Time after the last failure when an entry expires.
const EXPIRY: Millis = 600_000;
/// Maximum number of entries: addresses and networks, or accounts.
pub const MAX_ENTRIES: usize = 8_192;

/// Failures of one address, network or account.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct FailureRecord {
    times: u32,
    last: Millis,
}

impl FailureRecord {
    fn is_forgotten(&self, now: Millis) -> bool {
        now.saturating_sub(self.last) >= EXPIRY
    }

    /// Returns the remaining wait, given that `free` failures are allowed.
    fn remaining_wait(&self, free: u32, now: Millis) -> Option<Millis> {
        let beyond = self.times.checked_sub(free)?;
        let whole = SHORTEST.checked_shl(beyond.min(32)).map_or(LONGEST, |pause| pause.min(LONGEST));
        (self.last + whole).checked_sub(now).filter(|left| *left > 0)
    }

    fn add(&mut self, now: Millis) {
        if self.is_forgotten(now) {
            self.times = 0;
        }
        self.times = self.times.saturating_add(1);
        self.last = now;
    }
}

/// Source of guesses, by which they are counted.
pub trait GuessSource: Eq + Hash + Clone {
    /// Returns this source and those that contain it, each with the number of failures allowed before it waits.
    fn allowances(&self) -> Vec<(Self, u32)>;
}

/// Guesses for one account are grouped by its name.
impl GuessSource for String {
    fn allowances(&self) -> Vec<(String, u32)> {
        vec![(self.clone(), FREE)]
    }
}

impl GuessSource for Host {
    fn allowances(&self) -> Vec<(Host, u32)> {
        let mut allowances = vec![(*self, FREE)];
        if self.is_ipv6() {
            allowances.push((self.network_with_prefix(OF_SITE), FREE * WIDER));
            allowances.push((self.network_with_prefix(OF_PROVIDER), FREE * WIDER * WIDER));
        }
        allowances
    }
}

/// Rate limiter for guesses, over all addresses or all accounts.
#[derive(Debug)]
pub struct GuessLimiter<S: GuessSource = Host> {
    remembered: HashMap<S, FailureRecord>,
    unknown: u64,
    slowed: u64,
}

impl<S: GuessSource> Default for GuessLimiter<S> {
    fn default() -> Self {
        GuessLimiter { remembered: HashMap::new(), unknown: 0, slowed: 0 }
    }
}

impl<S: GuessSource> GuessLimiter<S> {
    /// Checks whether a token from `address` may be looked at; otherwise returns the milliseconds to wait and counts
    /// the token as slowed.
    pub fn check(&mut self, address: impl Into<S>, now: Millis) -> Result<(), Millis> {
        let waits = address
            .into()
            .allowances()
            .into_iter()
            .filter_map(|(of, free)| self.remembered.get(&of)?.remaining_wait(free, now));
        match waits.max() {
            None => Ok(()),
            Some(left) => {
                self.slowed += 1;
                Err(left)
            }
        }
    }

    /// Records an unknown token from `address` and returns how long that address has to wait now.
    pub fn record_failure(&mut self, address: impl Into<S>, now: Millis) -> Option<Millis> {
        self.unknown += 1;
        let counted = address.into().allowances().into_iter();
        let waits = counted.map(|(of, free)| {
            self.make_room(&of);
            let guessed = self.remembered.entry(of).or_default();
            guessed.add(now);
            guessed.remaining_wait(free, now)
        });
        waits.max().flatten()
    }

    /// Removes the entry whose last failure is oldest if the table is full.
    fn make_room(&mut self, newcomer: &S) {
        if self.remembered.len() < MAX_ENTRIES || self.remembered.contains_key(newcomer) {
            return;
        }
        let oldest = self.remembered.iter().min_by_key(|(_, guessed)| guessed.last);
        if let Some(oldest) = oldest.map(|(of, _)| of.clone()) {
            self.remembered.remove(&oldest);
        }
    }

    /// Returns the number of unknown tokens and of tokens not looked at.
    pub fn counts(&self) -> (u64, u64) {
        (self.unknown, self.slowed)
    }
}

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv6Addr};

    use proptest::prelude::*;

    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().expect("an address")
    }

    /// Fails as often as allowed, less once.
    fn guess_freely(guesses: &mut GuessLimiter, from: &str, now: Millis) {
        for _ in 1..FREE {
            assert_eq!(guesses.record_failure(address(from), now), None);
        }
    }

    #[test]
    fn waits_grow_up_to_a_bound_and_are_forgotten() {
        let mut guesses = GuessLimiter::<Host>::default();
        let from = address("10.0.0.7");
        guess_freely(&mut guesses, "10.0.0.7", 0);
        let mut now = 0;
        for wait in [1_000, 2_000, 4_000, 8_000, 16_000, 32_000, 60_000, 60_000, 60_000] {
            assert_eq!(guesses.check(from, now), Ok(()), "{now}");
            assert_eq!(guesses.record_failure(from, now), Some(wait));
            assert_eq!(guesses.check(from, now + wait - 1), Err(1));
            now += wait;
        }
        assert_eq!(guesses.check(from, now), Ok(()));
        assert_eq!(guesses.record_failure(from, now - 60_000 + EXPIRY), None);
        assert_eq!(guesses.counts(), (u64::from(FREE) + 9, 9));
    }

    #[test]
    fn addresses_of_one_host_are_one_and_others_are_not_held_up() {
        for (one, other, same) in [
            ("10.0.0.7", "10.0.0.8", false),
            ("10.0.0.7", "::ffff:10.0.0.7", true),
            ("2001:db8::1", "2001:db8::ffff:1", true),
            ("2001:db8::1", "2001:db8:0:1::1", false),
        ] {
            let mut guesses = GuessLimiter::<Host>::default();
            guess_freely(&mut guesses, one, 0);
            guesses.record_failure(address(one), 0);
            let waits = guesses.check(address(other), 0).is_err();
            assert_eq!(waits, same, "{one} {other}");
        }
    }

    #[test]
    fn who_has_a_network_of_ipv6_is_slowed_and_nobody_else() {
        for (bits, hosts) in [(12, 4_096_u128), (32, 1 << 14)] {
            let mut guesses = GuessLimiter::<Host>::default();
            let base = u128::from("2001:db8::".parse::<Ipv6Addr>().expect("an address"));
            let mut looked_at = 0;
            for number in 0..hosts {
                // Spread over the whole network: /52, or the provider's entire /32.
                let from = base + ((number << 64) << (bits - hosts.ilog2()));
                let from = IpAddr::V6(Ipv6Addr::from(from));
                if guesses.check(from, 1).is_ok() {
                    looked_at += 1;
                    guesses.record_failure(from, 1);
                }
            }
            let most = if bits == 12 { FREE * WIDER } else { FREE * WIDER * WIDER };
            assert_eq!(looked_at, most, "{bits}");
            assert!(guesses.remembered.len() < MAX_ENTRIES);
            for other in ["2001:db9::1", "192.0.2.1"] {
                assert_eq!(guesses.check(address(other), 2), Ok(()), "{other}");
                assert_eq!(guesses.record_failure(address(other), 2), None, "{other}");
            }
        }
    }

    #[test]
    fn a_great_many_addresses_hold_up_nobody_and_the_longest_quiet_are_forgotten() {
        let mut guesses = GuessLimiter::<Host>::default();
        let many = |number: u32| IpAddr::V4((0x0b00_0000 + number).into());
        for number in 0..MAX_ENTRIES as u32 {
            guesses.record_failure(many(number), 1);
        }
        guess_freely(&mut guesses, "10.0.0.7", 2);
        guesses.record_failure(address("10.0.0.7"), 2);
        for number in 0..MAX_ENTRIES as u32 - 1 {
            guesses.record_failure(many(1 << 20 | number), 3);
        }
        assert_eq!(guesses.remembered.len(), MAX_ENTRIES);
        assert!(guesses.check(address("10.0.0.7"), 3).is_err(), "it has a place");
        // A new address is looked at immediately and slowed as soon as any other.
        assert_eq!(guesses.check(address("192.0.2.1"), 3), Ok(()));
        guess_freely(&mut guesses, "192.0.2.1", 3);
        assert!(guesses.record_failure(address("192.0.2.1"), 3).is_some());
        assert_eq!(guesses.remembered.len(), MAX_ENTRIES);
    }

    proptest! {
        /// Whatever the timing, an address gets no more guesses than its waits allow, and the table stays bounded.
        #[test]
        fn no_address_has_more_looked_at_than_its_waits_leave(steps in prop::collection::vec(0u64..5_000, 1..300)) {
            let mut guesses = GuessLimiter::<Host>::default();
            let (mut now, mut looked_at) = (0, 0);
            for step in &steps {
                now += step;
                if guesses.check(address("10.0.0.7"), now).is_ok() {
                    guesses.record_failure(address("10.0.0.7"), now);
                    looked_at += 1;
                }
            }
            // 1 + 2 + … + 32 s, then 60 s each; the span is too short for failures to expire.
            let slow = now / LONGEST + 7;
            prop_assert!(looked_at <= u64::from(FREE) + slow || now >= EXPIRY, "{} in {} ms", looked_at, now);
            let (unknown, slowed) = guesses.counts();
            prop_assert_eq!((unknown, unknown + slowed), (looked_at, steps.len() as u64));
        }
    }
}
