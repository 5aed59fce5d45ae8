//! Sign-ins under way: in memory, each good once and for ten minutes, of a bounded number.

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use access::{Host, largest_network};
use openidconnect::{Nonce, PkceCodeVerifier};

use crate::Error;

/// How long somebody may take to say to the provider who it is.
const TIME: Duration = Duration::from_secs(600);
/// Sign-ins under way, of all and of one host. The oldest of that host, or of the network that has the most, makes room for a new one.
const MOST: usize = 4096;
const MOST_OF_ONE: usize = 64;

/// A sign-in that waits for its browser to come back.
pub struct Waiting {
    pub browser: String,
    pub from: IpAddr,
    pub nonce: Nonce,
    pub verifier: PkceCodeVerifier,
    pub earlier: Option<String>,
}

/// A sign-in whose browser has come back.
pub struct Started {
    pub(crate) nonce: Nonce,
    pub(crate) verifier: PkceCodeVerifier,
    /// What was said of the browser when it began.
    pub earlier: Option<String>,
}

#[derive(Default)]
pub struct Pending {
    /// By their states.
    all: HashMap<String, (Instant, Waiting)>,
}

impl Pending {
    /// Keeps a sign-in.
    pub fn keep(&mut self, state: String, waiting: Waiting, now: Instant) {
        self.all.retain(|_, (begun, _)| is_good(*begun, now));
        let of = Host::from(waiting.from);
        let hosts = || self.all.values().map(|(_, it)| Host::from(it.from));
        if hosts().filter(|host| *host == of).count() >= MOST_OF_ONE {
            self.forget_oldest(|host| host == of);
        } else if self.all.len() >= MOST {
            let network = largest_network(hosts());
            self.forget_oldest(|host| Some(host.network()) == network);
        }
        self.all.insert(state, (now, waiting));
    }

    fn forget_oldest(&mut self, is_meant: impl Fn(Host) -> bool) {
        let meant = self.all.iter();
        let meant = meant.filter(|(_, (_, it))| is_meant(it.from.into()));
        let oldest = meant.min_by_key(|(_, (begun, _))| *begun);
        if let Some(oldest) = oldest.map(|(state, _)| state.clone()) {
            self.all.remove(&oldest);
        }
    }

    /// What was begun by a state. Whoever comes with it, it is good for nobody any more.
    pub fn take(
        &mut self,
        state: &str,
        browser: Option<&str>,
        now: Instant,
    ) -> Result<Started, Error> {
        let (begun, waiting) = self.all.remove(state).ok_or(Error::UnknownState)?;
        if !is_good(begun, now) {
            return Err(Error::UnknownState);
        }
        if browser != Some(&*waiting.browser) {
            return Err(Error::OtherBrowser);
        }
        Ok(Started {
            nonce: waiting.nonce,
            verifier: waiting.verifier,
            earlier: waiting.earlier,
        })
    }
}

fn is_good(begun: Instant, now: Instant) -> bool {
    now.saturating_duration_since(begun) < TIME
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waiting(from: &str) -> Waiting {
        Waiting {
            browser: "browser".into(),
            from: from.parse().expect("an address"),
            nonce: Nonce::new("nonce".into()),
            verifier: PkceCodeVerifier::new("verifier".into()),
            earlier: None,
        }
    }

    #[test]
    fn a_state_is_good_once_for_its_browser_and_its_time() {
        let (mut pending, now) = (Pending::default(), Instant::now());
        for state in ["a", "b", "c", "d"] {
            pending.keep(state.into(), waiting("192.0.2.1"), now);
        }
        let mine = Some("browser");
        pending.take("a", mine, now).map(|_| ()).expect("begun");
        let wrong = |taken: Result<Started, Error>| taken.map(|_| ()).expect_err("refused");
        assert!(matches!(
            wrong(pending.take("a", mine, now)),
            Error::UnknownState
        ));
        assert!(matches!(
            wrong(pending.take("x", mine, now)),
            Error::UnknownState
        ));
        assert!(matches!(
            wrong(pending.take("b", Some("other"), now)),
            Error::OtherBrowser
        ));
        // Who came with it first has used it up.
        assert!(matches!(
            wrong(pending.take("b", mine, now)),
            Error::UnknownState
        ));
        assert!(matches!(
            wrong(pending.take("c", None, now)),
            Error::OtherBrowser
        ));
        let late = now + TIME;
        assert!(matches!(
            wrong(pending.take("d", mine, late)),
            Error::UnknownState
        ));
    }

    #[test]
    fn whoever_begins_many_pushes_out_its_own() {
        let (mut pending, now) = (Pending::default(), Instant::now());
        pending.keep("other".into(), waiting("192.0.2.9"), now);
        for number in 0..=MOST_OF_ONE as u32 {
            let from = format!("2001:db8::{number:x}");
            let at = now + Duration::from_millis(number.into());
            pending.keep(number.to_string(), waiting(&from), at);
        }
        assert_eq!(pending.all.len(), MOST_OF_ONE + 1);
        assert!(!pending.all.contains_key("0"), "the oldest");
        assert!(pending.all.contains_key("other"));
    }

    #[test]
    fn who_has_a_great_network_takes_no_more_than_there_are_places_and_pushes_out_its_own() {
        let (mut pending, now) = (Pending::default(), Instant::now());
        pending.keep("other".into(), waiting("192.0.2.1"), now);
        for number in 0..MOST + 9 {
            // Each is another host, of one site.
            let from = format!("2001:db8:0:{number:x}::1");
            let at = now + Duration::from_millis(1 + number as u64);
            pending.keep(number.to_string(), waiting(&from), at);
        }
        assert_eq!(pending.all.len(), MOST);
        assert!(pending.all.contains_key("other"));
        assert!(!pending.all.contains_key("0"), "the oldest of its own");
        pending.keep("later".into(), waiting("192.0.2.1"), now + 2 * TIME);
        assert_eq!(pending.all.len(), 1);
    }
}
