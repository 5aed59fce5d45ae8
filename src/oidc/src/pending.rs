//! Pending sign-ins, in memory: each is valid once and for ten minutes, and their number is bounded.

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use access::{Host, largest_network};
use openidconnect::{Nonce, PkceCodeVerifier};

use crate::Error;

/// Time a person may take to sign in at the provider.
const SIGN_IN_TIMEOUT: Duration = Duration::from_secs(600);
/// Limits on pending sign-ins, in total and per host. The oldest of that host, or of the network that has the most,
/// is replaced.
const MAX_SIGN_INS: usize = 4096;
const MAX_SIGN_INS_OF_ONE_HOST: usize = 64;

/// A sign-in whose browser has not returned yet.
pub struct PendingSignIn {
    pub browser: String,
    pub from: IpAddr,
    pub nonce: Nonce,
    pub verifier: PkceCodeVerifier,
    pub earlier: Option<String>,
}

/// A sign-in whose browser has returned.
pub struct ReturnedSignIn {
    pub(crate) nonce: Nonce,
    pub(crate) verifier: PkceCodeVerifier,
    /// Value passed to `begin`.
    pub earlier: Option<String>,
}

#[derive(Default)]
pub struct PendingSignIns {
    /// Sign-ins by state.
    all: HashMap<String, (Instant, PendingSignIn)>,
}

impl PendingSignIns {
    /// Adds a sign-in.
    pub fn insert(&mut self, state: String, waiting: PendingSignIn, now: Instant) {
        self.all.retain(|_, (begun, _)| is_fresh(*begun, now));
        let of = Host::from(waiting.from);
        let hosts = || self.all.values().map(|(_, it)| Host::from(it.from));
        if hosts().filter(|host| *host == of).count() >= MAX_SIGN_INS_OF_ONE_HOST {
            self.forget_oldest(|host| host == of);
        } else if self.all.len() >= MAX_SIGN_INS {
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

    /// Removes and returns the sign-in with this state. It is used up even if the caller is refused.
    pub fn take(&mut self, state: &str, browser: Option<&str>, now: Instant) -> Result<ReturnedSignIn, Error> {
        let (begun, waiting) = self.all.remove(state).ok_or(Error::UnknownState)?;
        if !is_fresh(begun, now) {
            return Err(Error::UnknownState);
        }
        if browser != Some(&*waiting.browser) {
            return Err(Error::OtherBrowser);
        }
        Ok(ReturnedSignIn { nonce: waiting.nonce, verifier: waiting.verifier, earlier: waiting.earlier })
    }
}

fn is_fresh(begun: Instant, now: Instant) -> bool {
    now.saturating_duration_since(begun) < SIGN_IN_TIMEOUT
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pending_sign_in(from: &str) -> PendingSignIn {
        PendingSignIn {
            browser: "browser".into(),
            from: from.parse().expect("an address"),
            nonce: Nonce::new("nonce".into()),
            verifier: PkceCodeVerifier::new("verifier".into()),
            earlier: None,
        }
    }

    #[test]
    fn a_state_is_good_once_for_its_browser_and_its_time() {
        let (mut pending, now) = (PendingSignIns::default(), Instant::now());
        for state in ["a", "b", "c", "d"] {
            pending.insert(state.into(), pending_sign_in("192.0.2.1"), now);
        }
        let mine = Some("browser");
        pending.take("a", mine, now).map(|_| ()).expect("begun");
        let wrong = |taken: Result<ReturnedSignIn, Error>| taken.map(|_| ()).expect_err("refused");
        assert!(matches!(wrong(pending.take("a", mine, now)), Error::UnknownState));
        assert!(matches!(wrong(pending.take("x", mine, now)), Error::UnknownState));
        assert!(matches!(wrong(pending.take("b", Some("other"), now)), Error::OtherBrowser));
        // The first caller has used it up.
        assert!(matches!(wrong(pending.take("b", mine, now)), Error::UnknownState));
        assert!(matches!(wrong(pending.take("c", None, now)), Error::OtherBrowser));
        let late = now + SIGN_IN_TIMEOUT;
        assert!(matches!(wrong(pending.take("d", mine, late)), Error::UnknownState));
    }

    #[test]
    fn a_host_that_begins_many_sign_ins_evicts_its_own() {
        let (mut pending, now) = (PendingSignIns::default(), Instant::now());
        pending.insert("other".into(), pending_sign_in("192.0.2.9"), now);
        for number in 0..=MAX_SIGN_INS_OF_ONE_HOST as u32 {
            let from = format!("2001:db8::{number:x}");
            let at = now + Duration::from_millis(number.into());
            pending.insert(number.to_string(), pending_sign_in(&from), at);
        }
        assert_eq!(pending.all.len(), MAX_SIGN_INS_OF_ONE_HOST + 1);
        assert!(!pending.all.contains_key("0"), "the oldest");
        assert!(pending.all.contains_key("other"));
    }

    #[test]
    fn a_large_network_is_bounded_and_evicts_its_own_sign_ins() {
        let (mut pending, now) = (PendingSignIns::default(), Instant::now());
        pending.insert("other".into(), pending_sign_in("192.0.2.1"), now);
        for number in 0..MAX_SIGN_INS + 9 {
            // Each is another host of the same site.
            let from = format!("2001:db8:0:{number:x}::1");
            let at = now + Duration::from_millis(1 + number as u64);
            pending.insert(number.to_string(), pending_sign_in(&from), at);
        }
        assert_eq!(pending.all.len(), MAX_SIGN_INS);
        assert!(pending.all.contains_key("other"));
        assert!(!pending.all.contains_key("0"), "the oldest of its own");
        pending.insert("later".into(), pending_sign_in("192.0.2.1"), now + 2 * SIGN_IN_TIMEOUT);
        assert_eq!(pending.all.len(), 1);
    }
}
