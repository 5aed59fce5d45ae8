//! Who shows which token, and what it may do: the tokens of the configuration and of the database, and the policy. Changes
//! hold at once, for open connections as for requests.

mod changing;
mod pairings;
mod people;
mod provided;
mod recognising;
mod standing;
mod stored;

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use access::{Guesses, Principal};
use api::Millis;
use parking_lot::{Mutex, RwLock};
use store::{Owner, State, TokenHash};
use tokio::sync::watch;

use crate::tokens::{AuthMessage, Tokens};

pub use pairings::{Uncertified, Uncoded};
pub use people::{Begun, Lasting};
use people::{KnownAccount, KnownSession};
pub use recognising::Recognising;
use stored::Known;
pub use stored::Stored;

/// A token's last use is written no more often.
const USED: Millis = 60_000;

/// By what somebody is known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shown {
    /// By nothing: on loopback, on a machine whose operator has named nobody; or not at all.
    Nothing,
    /// By a token of the configuration.
    Configured,
    /// By a token of the database.
    Stored {
        /// Its number.
        id: i64,
        /// The secret's hash: after a rotation it is another.
        hash: TokenHash,
    },
    /// By a certificate in TLS.
    Certificate {
        /// The number of the robot's pairing.
        pairing: i64,
        /// SHA-256 of the key that was paired; none where another authority than the daemon's signs the robot's certificates.
        key: Option<String>,
        /// The certificate's end.
        until: Millis,
    },
    /// By a session of the page.
    Session {
        /// Its number.
        id: i64,
    },
    /// By the kernel, at the daemon's socket.
    User,
}

/// Somebody who has been recognised.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The principal.
    pub principal: Arc<Principal>,
    /// By what.
    pub shown: Shown,
    /// The hash of the token that was shown.
    pub token: Option<TokenHash>,
    /// To whom names of robots are bound that it uses first.
    pub owner: Option<Owner>,
}

impl Identity {
    /// To what its resume tokens are bound: to whoever has a token of the database, whichever its secret is now; else to the token.
    pub fn bound_by(&self) -> Option<String> {
        match &self.shown {
            Shown::Stored { id, .. } => Some(format!("token {id}")),
            Shown::Certificate { pairing, .. } => Some(format!("pairing {pairing}")),
            // Also by that person's next session.
            Shown::Session { .. } => Some(format!("person {}", self.principal.name)),
            _ => self.token.clone(),
        }
    }
}

/// Why a token lets nobody in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Unrecognised {
    /// It was good once.
    #[error("this token was revoked")]
    Revoked,
    /// It was good until its end.
    #[error("this token has expired")]
    Expired,
    /// Nobody has it.
    #[error("this token is not known")]
    Unknown,
    /// It was not looked at.
    #[error("too many tokens that are not known came from this address; none is looked at for {} s", .0.div_ceil(1000))]
    Slowed(Millis),
    /// A password, or what a provider gave a browser, was not looked at.
    #[error(
        "too many sign-ins that failed came from this address, or for this account; none is looked at for {} s",
        .0.div_ceil(1000)
    )]
    SlowedSignIn(Millis),
    /// It was somebody's session, perhaps.
    #[error("this session is over")]
    SessionOver,
}

/// All who are known, and what they may do.
pub struct Principals {
    configured: Tokens,
    state: Arc<State>,
    stored: RwLock<Stored>,
    guesses: Mutex<Guesses>,
    /// Wrong passwords, by account.
    wrong: Mutex<Guesses<String>>,
    /// Passwords for names that are no account's, by name. They are slowed alike, and make nothing of an account's forgotten.
    in_vain: Mutex<Guesses<String>>,
    /// How long sessions last.
    lasting: Lasting,
    /// Grows by one with every change.
    changed: watch::Sender<u64>,
}

impl Principals {
    /// Those of the configuration and of the database.
    pub fn new(configured: Tokens, state: Arc<State>) -> Result<Principals, store::Error> {
        let principals = Principals {
            stored: RwLock::new(Stored::read(&state)?),
            configured,
            state,
            guesses: Mutex::default(),
            wrong: Mutex::default(),
            in_vain: Mutex::default(),
            lasting: Lasting::default(),
            changed: watch::Sender::new(0),
        };
        principals.release_robots()?;
        Ok(principals)
    }

    /// With sessions that last so long.
    pub fn lasting(self, lasting: Lasting) -> Principals {
        Principals { lasting, ..self }
    }

    /// Names of robots that are bound to nobody who is left would be nobody's for ever.
    fn release_robots(&self) -> Result<(), store::Error> {
        let mut owners: Vec<Owner> = self.configured.hashes().to_vec();
        let stored = self.stored.read();
        let live = stored.tokens.iter().filter(|known| known.revoked.is_none());
        owners.extend(live.map(Known::owner));
        owners.extend(stored.paired_owners());
        let people = stored.accounts.iter().filter(|known| known.is_live());
        owners.extend(people.map(KnownAccount::owner));
        owners.extend(stored.sessions.values().map(KnownSession::owner));
        drop(stored);
        self.state.release_robots(&owners).map(|_| ())
    }

    /// Calls `look` with what is known now.
    pub fn with<T>(&self, look: impl FnOnce(Recognising<'_>) -> T) -> T {
        look(Recognising {
            tokens: &self.configured,
            stored: &self.stored.read(),
            guesses: &self.guesses,
            lasting: self.lasting,
        })
    }

    /// Where wrong passwords for an account of that name are counted.
    fn wrong_at(&self, account: &str) -> &Mutex<Guesses<String>> {
        if self.has_account(account) {
            &self.wrong
        } else {
            &self.in_vain
        }
    }

    /// Whether a password may be looked at that came from an address, for an account of that name.
    pub fn may_try(&self, account: &str, from: IpAddr, now: Millis) -> Result<(), Unrecognised> {
        let by_account = self.wrong_at(account).lock().ask(account, now);
        let by_address = by_account.and_then(|()| self.guesses.lock().ask(from, now));
        by_address.map_err(Unrecognised::SlowedSignIn)
    }

    /// Counts a password that was looked at and is wrong.
    pub fn wrong_password(&self, account: &str, from: IpAddr, now: Millis) {
        let by_account = self.wrong_at(account).lock().failed(account, now);
        let by_address = self.guesses.lock().failed(from, now);
        if let Some(wait) = by_account.max(by_address) {
            let seconds = wait.div_ceil(1000);
            tracing::warn!("wrong passwords come from {from}: for {seconds} s none is looked at");
        }
    }

    /// Whether what comes from an address with an answer of an identity provider may be looked at.
    pub fn may_come(&self, from: IpAddr, now: Millis) -> Result<(), Unrecognised> {
        let asked = self.guesses.lock().ask(from, now);
        asked.map_err(Unrecognised::SlowedSignIn)
    }

    /// Counts an answer of an identity provider that was looked at and is made up, perhaps.
    pub fn mistaken_sign_in(&self, from: IpAddr, now: Millis) {
        let wait = self.guesses.lock().failed(from, now);
        if let Some(wait) = wait {
            let seconds = wait.div_ceil(1000);
            tracing::warn!(
                "sign-ins that fail come from {from}: for {seconds} s none is looked at"
            );
        }
    }

    /// Passwords since the daemon started that were wrong, and those that were not looked at for their account's sake.
    pub fn mistaken(&self) -> (u64, u64) {
        let (wrong, slowed) = self.wrong.lock().counts();
        let (in_vain, in_vain_slowed) = self.in_vain.lock().counts();
        (wrong + in_vain, slowed + in_vain_slowed)
    }

    /// Tokens since the daemon started that were not known, and those that were not looked at.
    pub fn guessed(&self) -> (u64, u64) {
        self.guesses.lock().counts()
    }

    /// Whether nobody was ever named: then this machine's own users need no token.
    pub fn names_nobody(&self) -> bool {
        self.configured.is_empty() && self.stored.read().is_empty()
    }

    /// Who is meant by rosbridge's `auth` message that came from an address, at `seconds` since 1970.
    pub fn recognise_auth(
        &self,
        message: &AuthMessage,
        from: IpAddr,
        seconds: f64,
    ) -> Result<Identity, String> {
        let now = (seconds * 1000.0) as Millis;
        let mut refusal = None;
        let identity = self.with(|known| {
            known.by(&message.mac, from, now, || {
                let recognised = known.tokens.recognise_auth(message, seconds);
                recognised.map_err(|why| refusal = Some(why)).ok()
            })
        });
        match identity {
            Ok(identity) => {
                self.note_use(&identity, now);
                Ok(identity)
            }
            // What is expected of such a message says more.
            Err(why) => Err(refusal.map_or_else(|| why.to_string(), |refusal| refusal.to_string())),
        }
    }

    /// Remembers that a token was shown, to the minute.
    pub fn note_use(&self, identity: &Identity, now: Millis) {
        let id = match identity.shown {
            Shown::Stored { id, .. } => id,
            Shown::Certificate { pairing, .. } => return self.note_pairing(pairing, now),
            Shown::Session { id } => return self.note_session(id, now),
            _ => return,
        };
        let stored = self.stored.read();
        let due = stored.of_id(id).is_some_and(|known| {
            let last = known.last_used.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USED
                && known
                    .last_used
                    .compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed)
                    .is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.token_used(id, now) {
            tracing::warn!("when a token was used last cannot be written: {error}");
        }
    }

    /// Remembers that a session was shown; on the disk, to the minute.
    fn note_session(&self, id: i64, now: Millis) {
        let stored = self.stored.read();
        let due = stored.session_of_id(id).is_some_and(|known| {
            known.last_used.fetch_max(now, Ordering::Relaxed);
            let last = known.written.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USED
                && known
                    .written
                    .compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed)
                    .is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.session_used(id, now) {
            tracing::warn!("when a session was used last cannot be written: {error}");
        }
    }
}

#[cfg(test)]
mod tests;
