//! Guesses at tokens and passwords: counted by address, or by account, and slowed. Pure: the time is given.
//!
//! An address may send some tokens that are not known; after each further one it waits, twice as long each time up to a bound,
//! and what it sends meanwhile is not looked at. A good token makes nobody a better guesser: only time forgets.

use std::collections::HashMap;
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};

/// Milliseconds since any beginning.
type Millis = u64;

/// Tokens that are not known before an address waits.
pub const FREE: u32 = 10;
/// The first wait, and the longest.
const SHORTEST: Millis = 1_000;
const LONGEST: Millis = 60_000;
/// What an address has guessed is forgotten so long after its last guess.
const FORGOTTEN: Millis = 600_000;
/// Addresses that are told apart. Those beyond are taken for one, so that a great many cannot make one forgotten.
pub const ADDRESSES: usize = 4_096;

/// What came from one address.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Guessed {
    times: u32,
    last: Millis,
}

impl Guessed {
    fn is_forgotten(&self, now: Millis) -> bool {
        now.saturating_sub(self.last) >= FORGOTTEN
    }

    /// How long it still waits.
    fn wait(&self, now: Millis) -> Option<Millis> {
        let beyond = self.times.checked_sub(FREE)?;
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

/// What came from all addresses, or at all accounts.
#[derive(Debug)]
pub struct Guesses<Of: Eq + Hash = Host> {
    by_address: HashMap<Of, Guessed>,
    /// From addresses for which there was no room.
    others: Guessed,
    unknown: u64,
    slowed: u64,
}

impl<Of: Eq + Hash> Default for Guesses<Of> {
    fn default() -> Self {
        Guesses {
            by_address: HashMap::new(),
            others: Guessed::default(),
            unknown: 0,
            slowed: 0,
        }
    }
}

/// What one host has: an IPv4 address, or a network of IPv6, of which it can choose any.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Host(IpAddr);

impl From<IpAddr> for Host {
    fn from(address: IpAddr) -> Host {
        Host(match address.to_canonical() {
            IpAddr::V6(address) => {
                let network = u128::from(address) & (u128::MAX << 64);
                IpAddr::V6(Ipv6Addr::from(network))
            }
            address => address,
        })
    }
}

impl<Of: Eq + Hash> Guesses<Of> {
    /// Whether a token from `address` may be looked at; else for how many milliseconds not, and it is counted as slowed.
    pub fn ask(&mut self, address: impl Into<Of>, now: Millis) -> Result<(), Millis> {
        let known = self.by_address.get(&address.into());
        let full = self.by_address.len() >= ADDRESSES;
        let guessed = match known {
            Some(guessed) => Some(guessed),
            None => full.then_some(&self.others),
        };
        match guessed.and_then(|guessed| guessed.wait(now)) {
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
        let host = address.into();
        if self.by_address.len() >= ADDRESSES && !self.by_address.contains_key(&host) {
            self.by_address
                .retain(|_, guessed| !guessed.is_forgotten(now));
        }
        let full = self.by_address.len() >= ADDRESSES;
        let guessed = match self.by_address.get_mut(&host) {
            Some(guessed) => guessed,
            None if full => &mut self.others,
            None => self.by_address.entry(host).or_default(),
        };
        guessed.add(now);
        guessed.wait(now)
    }

    /// Tokens that were not known, and those that were not looked at.
    pub fn counts(&self) -> (u64, u64) {
        (self.unknown, self.slowed)
    }
}

#[cfg(test)]
mod tests {
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
    fn many_addresses_make_none_forgotten_and_are_slowed_as_one() {
        let mut guesses = Guesses::<Host>::default();
        guess_freely(&mut guesses, "10.0.0.7", 0);
        guesses.failed(address("10.0.0.7"), 0);
        let many = |number: u32| IpAddr::V4((0x0b00_0000 + number).into());
        for number in 0..ADDRESSES as u32 + FREE {
            guesses.failed(many(number), 1);
        }
        assert_eq!(guesses.by_address.len(), ADDRESSES);
        assert!(guesses.ask(address("10.0.0.7"), 2).is_err());
        assert!(guesses.ask(address("192.0.2.1"), 2).is_err(), "one of them");
        assert_eq!(guesses.ask(many(0), 2), Ok(()), "has a place of its own");
        // Who comes when they are forgotten has one, too.
        guesses.failed(address("192.0.2.1"), FORGOTTEN + 2);
        assert_eq!(guesses.by_address.len(), 1);
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
