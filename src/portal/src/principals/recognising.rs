//! Recognising tokens: first those of the database, then those of the configuration, for which guesses are slowed.

use std::net::IpAddr;
use std::sync::Arc;

use access::{GuessLimiter, Principal};
use api::Millis;
use parking_lot::Mutex;
use store::TokenHash;

use super::identity::{CallerIdentity, Credential};
use super::refusals::AuthenticationError;
use super::stored::{SessionLifetimes, StoredPrincipals};
use crate::tokens::{self, Tokens};

/// Current credentials, by which tokens are recognised.
#[derive(Clone, Copy)]
pub struct Recogniser<'a> {
    /// Tokens of the configuration.
    pub tokens: &'a Tokens,
    /// Tokens of the database.
    pub stored: &'a StoredPrincipals,
    /// Limiter for guesses, by address.
    pub guesses: &'a Mutex<GuessLimiter>,
    /// Lifetimes of sessions.
    pub lasting: SessionLifetimes,
}

impl Recogniser<'_> {
    /// Identifies the caller by a token that came from an address.
    pub fn recognise(&self, token: &str, from: IpAddr, now: Millis) -> Result<CallerIdentity, AuthenticationError> {
        self.recognise_with(token, from, now, || self.tokens.recognise(token))
    }

    /// Identifies the caller by the session secret of a browser. Session secrets cannot be guessed, so they are
    /// always looked up.
    pub fn recognise_session(&self, secret: &str, now: Millis) -> Result<CallerIdentity, AuthenticationError> {
        let hash = tokens::hash(secret);
        self.stored.recognise_session(&hash, now, self.lasting)
    }

    /// Looks for a token in the database and then, with `configured`, in the configuration. The former cannot be
    /// guessed and are always looked up, so that their owners are not held up by somebody guessing from the same
    /// address. The latter are chosen by people.
    pub(super) fn recognise_with(
        &self,
        token: &str,
        from: IpAddr,
        now: Millis,
        configured: impl FnOnce() -> Option<TokenHash>,
    ) -> Result<CallerIdentity, AuthenticationError> {
        if let Some(identity) = self.stored.recognise(&tokens::hash(token), now)? {
            return Ok(identity);
        }
        let mut guesses = self.guesses.lock();
        guesses.check(from, now).map_err(AuthenticationError::Slowed)?;
        if let Some(hash) = configured() {
            return Ok(configured_identity(hash));
        }
        if let Some(wait) = guesses.record_failure(from, now) {
            let seconds = wait.div_ceil(1000);
            tracing::warn!("too many unknown tokens from {from}: none is checked for {seconds} s");
        }
        Err(AuthenticationError::Unknown)
    }
}

fn configured_identity(hash: TokenHash) -> CallerIdentity {
    CallerIdentity {
        principal: Arc::new(Principal::admin("configured")),
        shown: Credential::Configured,
        owner: Some(hash.clone()),
        token: Some(hash),
    }
}
