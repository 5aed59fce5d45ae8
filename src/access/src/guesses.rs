//! Guesses at tokens and passwords: counted by address, or by account, and slowed. Pure: the time is given.
//!
//! An address may send some tokens that are not known; after each further one it waits, twice as long each time up to a bound,
//! and what it sends meanwhile is not looked at. A good token makes nobody a better guesser: only time forgets.
//!
//! An address of IPv6 is one of as many as its owner likes: its networks are counted beside it, of a host (/64), of a site (/48) and of a
//! provider (/32), each of which may guess sixteen times as often as the one within. So nobody fills the table with addresses of one network.
//! Whoever has a great many networks gets the table full, and that holds up nobody: then who has not guessed for the longest time is forgotten.

use std::collections::HashMap;
use std::hash::Hash;

use crate::Host;
use crate::host::{OF_PROVIDER, OF_SITE};

/// Milliseconds since any beginning.
type Millis = u64;

/// Tokens that are not known before an address waits.
pub const FREE: u32 = 10;
/// How many times as many a network may send as one of those within.
const WIDER: u32 = 16;
/// The first wait, and the longest.
const SHORTEST: Millis = 1_000;
const LONGEST: Millis = 60_000;
/// What an address has guessed is forgotten so long after its last guess.
const FORGOTTEN: Millis = 600_000;
/// Addresses and networks, or accounts, that are remembered.
pub const REMEMBERED: usize = 8_192;

/// What came from one address or network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Guessed {
    times: u32,
    last: Millis,
}

impl Guessed {
    fn is_forgotten(&self, now: Millis) -> bool {
        now.saturating_sub(self.last) >= FORGOTTEN
    }

    /// How long it still waits that may send `free` of them before.
    fn wait(&self, free: u32, now: Millis) -> Option<Millis> {
        let beyond = self.times.checked_sub(free)?;
        let whole = SHORTEST
            .checked_shl(beyond.min(32))
            .map_or(LONGEST, |pause| pause.min(LONGEST));
        (self.last + whole)
            .checked_sub(now)
            .filter(|left| *left > 0)
    }

    fn add(&mut self, now: Millis) {
        if self.is_forgotten(now) {
            self.times = 0;
        }
        self.times = self.times.saturating_add(1);
        self.last = now;
    }
}

/// By what guesses are counted.
pub trait Guesser: Eq + Hash + Clone {
    /// Itself, and those of which it is a part, each with how many guesses it may make before it waits.
    fn allowances(&self) -> Vec<(Self, u32)>;
}

/// By an account's name.
impl Guesser for String {
    fn allowances(&self) -> Vec<(String, u32)> {
        vec![(self.clone(), FREE)]
    }
}

impl Guesser for Host {
    fn allowances(&self) -> Vec<(Host, u32)> {
        let mut allowances = vec![(*self, FREE)];
        if self.is_wide() {
            allowances.push((self.within(OF_SITE), FREE * WIDER));
            allowances.push((self.within(OF_PROVIDER), FREE * WIDER * WIDER));
        }
        allowances
    }
}

/// What came from all addresses, or at all accounts.
#[derive(Debug)]
pub struct Guesses<Of: Guesser = Host> {
    remembered: HashMap<Of, Guessed>,
    unknown: u64,
    slowed: u64,
}

impl<Of: Guesser> Default for Guesses<Of> {
    fn default() -> Self {
        Guesses {
            remembered: HashMap::new(),
            unknown: 0,
            slowed: 0,
        }
    }
}

impl<Of: Guesser> Guesses<Of> {
    /// Whether a token from `address` may be looked at; else for how many milliseconds not, and it is counted as slowed.
    pub fn ask(&mut self, address: impl Into<Of>, now: Millis) -> Result<(), Millis> {
        let waits = address
            .into()
            .allowances()
            .into_iter()
            .filter_map(|(of, free)| self.remembered.get(&of)?.wait(free, now));
        match waits.max() {
            None => Ok(()),
            Some(left) => {
                self.slowed += 1;
                Err(left)
            }
        }
    }

    /// Counts a token from `address` that was looked at and is not known; how long the address waits now.
    pub fn failed(&mut self, address: impl Into<Of>, now: Millis) -> Option<Millis> {
        self.unknown += 1;
        let counted = address.into().allowances().into_iter();
        let waits = counted.map(|(of, free)| {
            self.make_room(&of);
            let guessed = self.remembered.entry(of).or_default();
            guessed.add(now);
            guessed.wait(free, now)
        });
        waits.max().flatten()
    }

    /// Forgets who has not guessed for the longest time, where there is no room for another.
    fn make_room(&mut self, newcomer: &Of) {
        if self.remembered.len() < REMEMBERED || self.remembered.contains_key(newcomer) {
            return;
        }
        let oldest = self
            .remembered
            .iter()
            .min_by_key(|(_, guessed)| guessed.last);
        if let Some(oldest) = oldest.map(|(of, _)| of.clone()) {
            self.remembered.remove(&oldest);
        }
    }

    /// Tokens that were not known, and those that were not looked at.
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

    /// As many as are free.
    fn guess_freely(guesses: &mut Guesses, from: &str, now: Millis) {
        for _ in 1..FREE {
            assert_eq!(guesses.failed(address(from), now), None);
        }
    }

    #[test]
    fn waits_grow_up_to_a_bound_and_are_forgotten() {
        let mut guesses = Guesses::<Host>::default();
        let from = address("10.0.0.7");
        guess_freely(&mut guesses, "10.0.0.7", 0);
        let mut now = 0;
        for wait in [
            1_000, 2_000, 4_000, 8_000, 16_000, 32_000, 60_000, 60_000, 60_000,
        ] {
            assert_eq!(guesses.ask(from, now), Ok(()), "{now}");
            assert_eq!(guesses.failed(from, now), Some(wait));
            assert_eq!(guesses.ask(from, now + wait - 1), Err(1));
            now += wait;
        }
        assert_eq!(guesses.ask(from, now), Ok(()));
        assert_eq!(guesses.failed(from, now - 60_000 + FORGOTTEN), None);
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
            let mut guesses = Guesses::<Host>::default();
            guess_freely(&mut guesses, one, 0);
            guesses.failed(address(one), 0);
            let waits = guesses.ask(address(other), 0).is_err();
            assert_eq!(waits, same, "{one} {other}");
        }
    }

    #[test]
    fn who_has_a_network_of_ipv6_is_slowed_and_nobody_else() {
        for (bits, hosts) in [(12, 4_096_u128), (32, 1 << 14)] {
            let mut guesses = Guesses::<Host>::default();
            let base = u128::from("2001:db8::".parse::<Ipv6Addr>().expect("an address"));
            let mut looked_at = 0;
            for number in 0..hosts {
                // As far apart as the network has room for: /52, and all of the provider's /32.
                let from = base + ((number << 64) << (bits - hosts.ilog2()));
                let from = IpAddr::V6(Ipv6Addr::from(from));
                if guesses.ask(from, 1).is_ok() {
                    looked_at += 1;
                    guesses.failed(from, 1);
                }
            }
            let most = if bits == 12 {
                FREE * WIDER
            } else {
                FREE * WIDER * WIDER
            };
            assert_eq!(looked_at, most, "{bits}");
            assert!(guesses.remembered.len() < REMEMBERED);
            for other in ["2001:db9::1", "192.0.2.1"] {
                assert_eq!(guesses.ask(address(other), 2), Ok(()), "{other}");
                assert_eq!(guesses.failed(address(other), 2), None, "{other}");
            }
        }
    }

    #[test]
    fn a_great_many_addresses_hold_up_nobody_and_the_longest_quiet_are_forgotten() {
        let mut guesses = Guesses::<Host>::default();
        let many = |number: u32| IpAddr::V4((0x0b00_0000 + number).into());
        for number in 0..REMEMBERED as u32 {
            guesses.failed(many(number), 1);
        }
        guess_freely(&mut guesses, "10.0.0.7", 2);
        guesses.failed(address("10.0.0.7"), 2);
        for number in 0..REMEMBERED as u32 - 1 {
            guesses.failed(many(1 << 20 | number), 3);
        }
        assert_eq!(guesses.remembered.len(), REMEMBERED);
        assert!(
            guesses.ask(address("10.0.0.7"), 3).is_err(),
            "it has a place"
        );
        // Who was never there is looked at as ever, and slowed as soon as any.
        assert_eq!(guesses.ask(address("192.0.2.1"), 3), Ok(()));
        guess_freely(&mut guesses, "192.0.2.1", 3);
        assert!(guesses.failed(address("192.0.2.1"), 3).is_some());
        assert_eq!(guesses.remembered.len(), REMEMBERED);
    }

    proptest! {
        /// However guesses come, of one address at most so many are looked at as waits leave room for, and nothing is kept beyond
        /// the bound.
        #[test]
        fn no_address_has_more_looked_at_than_its_waits_leave(steps in prop::collection::vec(0u64..5_000, 1..300)) {
            let mut guesses = Guesses::<Host>::default();
            let (mut now, mut looked_at) = (0, 0);
            for step in &steps {
                now += step;
                if guesses.ask(address("10.0.0.7"), now).is_ok() {
                    guesses.failed(address("10.0.0.7"), now);
                    looked_at += 1;
                }
            }
            // 1 + 2 + … + 32 s, then 60 s each; the span here is too short for them to be forgotten.
            let slow = now / LONGEST + 7;
            prop_assert!(looked_at <= u64::from(FREE) + slow || now >= FORGOTTEN, "{} in {} ms", looked_at, now);
            let (unknown, slowed) = guesses.counts();
            prop_assert_eq!((unknown, unknown + slowed), (looked_at, steps.len() as u64));
        }
    }
}
