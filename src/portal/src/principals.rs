//! Principals: who presents which credential, and what they may do, by the tokens of the configuration and of the
//! database, and by the policy. Changes take effect at once, for open connections as well as for requests.

mod changing;
pub mod identity;
mod pairings;
mod people;
mod provided;
mod recognising;
pub mod refusals;
mod standing;
mod stored;

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use access::GuessLimiter;
use api::Millis;
use parking_lot::{Mutex, RwLock};
use store::{Owner, State};
use tokio::sync::watch;

use crate::tokens::{AuthMessage, Tokens};

use identity::{CallerIdentity, Credential};
pub use people::StartedSession;
pub use recognising::Recogniser;
use refusals::{AuthMessageError, AuthenticationError};
use stored::{KnownAccount, KnownSession, KnownToken};
pub use stored::{SessionLifetimes, StoredPrincipals};

/// Minimum interval at which a token's last use is written.
const USE_INTERVAL: Millis = 60_000;

/// All principals, their credentials and the policy.
pub struct Principals {
    configured: Tokens,
    state: Arc<State>,
    stored: RwLock<StoredPrincipals>,
    guesses: Mutex<GuessLimiter>,
    /// Wrong passwords, by account.
    wrong: Mutex<GuessLimiter<String>>,
    /// Passwords for names without an account, by name. They are slowed in the same way, but kept apart so that they
    /// cannot displace the failures of an account.
    in_vain: Mutex<GuessLimiter<String>>,
    /// Lifetimes of sessions.
    lasting: SessionLifetimes,
    /// Change counter.
    changed: watch::Sender<u64>,
}

impl Principals {
    /// Loads the principals of the configuration and of the database.
    pub fn new(configured: Tokens, state: Arc<State>) -> Result<Principals, store::Error> {
        let principals = Principals {
            stored: RwLock::new(StoredPrincipals::load(&state)?),
            configured,
            state,
            guesses: Mutex::default(),
            wrong: Mutex::default(),
            in_vain: Mutex::default(),
            lasting: SessionLifetimes::default(),
            changed: watch::Sender::new(0),
        };
        principals.release_robots()?;
        Ok(principals)
    }

    /// Sets the lifetimes of sessions.
    pub fn with_session_lifetimes(self, lasting: SessionLifetimes) -> Principals {
        Principals { lasting, ..self }
    }

    /// Releases robot names whose owner no longer exists; otherwise nobody could ever use them again.
    fn release_robots(&self) -> Result<(), store::Error> {
        let mut owners: Vec<Owner> = self.configured.hashes().to_vec();
        let stored = self.stored.read();
        let live = stored.tokens.iter().filter(|known| known.revoked.is_none());
        owners.extend(live.map(KnownToken::owner));
        owners.extend(stored.paired_owners());
        let people = stored.accounts.iter().filter(|known| known.is_live());
        owners.extend(people.map(KnownAccount::owner));
        owners.extend(stored.sessions.values().map(KnownSession::owner));
        drop(stored);
        self.state.release_robots(&owners).map(|_| ())
    }

    /// Calls `look` with the current credentials.
    pub fn with_recogniser<T>(&self, look: impl FnOnce(Recogniser<'_>) -> T) -> T {
        look(Recogniser {
            tokens: &self.configured,
            stored: &self.stored.read(),
            guesses: &self.guesses,
            lasting: self.lasting,
        })
    }

    /// Returns the limiter that counts wrong passwords for this account name.
    fn failure_counter(&self, account: &str) -> &Mutex<GuessLimiter<String>> {
        if self.has_account(account) { &self.wrong } else { &self.in_vain }
    }

    /// Checks whether a password for this account from this address may be looked at.
    pub fn check_sign_in(&self, account: &str, from: IpAddr, now: Millis) -> Result<(), AuthenticationError> {
        let by_account = self.failure_counter(account).lock().check(account, now);
        let by_address = by_account.and_then(|()| self.guesses.lock().check(from, now));
        by_address.map_err(AuthenticationError::SlowedSignIn)
    }

    /// Records a wrong password.
    pub fn record_wrong_password(&self, account: &str, from: IpAddr, now: Millis) {
        let by_account = self.failure_counter(account).lock().record_failure(account, now);
        let by_address = self.guesses.lock().record_failure(from, now);
        if let Some(wait) = by_account.max(by_address) {
            let seconds = wait.div_ceil(1000);
            tracing::warn!("too many wrong passwords from {from}: none is checked for {seconds} s");
        }
    }

    /// Checks whether a sign-in through the identity provider from this address may proceed.
    pub fn check_provider_sign_in(&self, from: IpAddr, now: Millis) -> Result<(), AuthenticationError> {
        let asked = self.guesses.lock().check(from, now);
        asked.map_err(AuthenticationError::SlowedSignIn)
    }

    /// Records a sign-in through the identity provider that may have been made up.
    pub fn record_failed_sign_in(&self, from: IpAddr, now: Millis) {
        let wait = self.guesses.lock().record_failure(from, now);
        if let Some(wait) = wait {
            let seconds = wait.div_ceil(1000);
            tracing::warn!("too many failed sign-ins from {from}: none is checked for {seconds} s");
        }
    }

    /// Returns the number of wrong passwords since the daemon started, and of those not looked at because of their
    /// account.
    pub fn password_counts(&self) -> (u64, u64) {
        let (wrong, slowed) = self.wrong.lock().counts();
        let (in_vain, in_vain_slowed) = self.in_vain.lock().counts();
        (wrong + in_vain, slowed + in_vain_slowed)
    }

    /// Returns the number of unknown tokens since the daemon started, and of those not looked at.
    pub fn token_counts(&self) -> (u64, u64) {
        self.guesses.lock().counts()
    }

    /// Returns true if no credential was ever created; then this machine's own users need none.
    pub fn has_no_credentials(&self) -> bool {
        self.configured.is_empty() && self.stored.read().is_empty()
    }

    /// Authenticates rosbridge's `auth` message received from an address at `seconds` since 1970.
    pub fn recognise_auth(
        &self,
        message: &AuthMessage,
        from: IpAddr,
        seconds: f64,
    ) -> Result<CallerIdentity, AuthMessageError> {
        let now = (seconds * 1000.0) as Millis;
        let mut refusal = None;
        let identity = self.with_recogniser(|known| {
            known.recognise_with(&message.mac, from, now, || {
                let recognised = known.tokens.recognise_auth(message, seconds);
                recognised.map_err(|why| refusal = Some(why)).ok()
            })
        });
        match identity {
            Ok(identity) => {
                self.record_use(&identity, now);
                Ok(identity)
            }
            // The refusal specific to `auth` messages says more.
            Err(why) => Err(refusal.map_or(why.into(), AuthMessageError::from)),
        }
    }

    /// Records the use of a credential, with a resolution of a minute.
    pub fn record_use(&self, identity: &CallerIdentity, now: Millis) {
        let id = match identity.shown {
            Credential::Stored { id, .. } => id,
            Credential::Certificate { pairing, .. } => {
                return self.record_pairing_use(pairing, now);
            }
            Credential::Session { id } => return self.record_session_use(id, now),
            _ => return,
        };
        let stored = self.stored.read();
        let due = stored.find_token(id).is_some_and(|known| {
            let last = known.last_used.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USE_INTERVAL
                && known.last_used.compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed).is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.record_token_use(id, now) {
            tracing::warn!("cannot store when a token was last used: {error}");
        }
    }

    /// Records the use of a session; on disk with a resolution of a minute.
    fn record_session_use(&self, id: i64, now: Millis) {
        let stored = self.stored.read();
        let due = stored.find_session(id).is_some_and(|known| {
            known.last_used.fetch_max(now, Ordering::Relaxed);
            let last = known.written.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USE_INTERVAL
                && known.written.compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed).is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.record_session_use(id, now) {
            tracing::warn!("cannot store when a session was last used: {error}");
        }
    }
}

#[cfg(test)]
mod tests;
