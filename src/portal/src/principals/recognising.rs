//! Looking for a token: in the database, and then among those of the configuration, where guesses are slowed.

use std::net::IpAddr;
use std::sync::Arc;

use access::{Guesses, Principal};
use api::Millis;
use parking_lot::Mutex;
use store::TokenHash;

use super::people::Lasting;
use super::{Identity, Shown, Stored, Unrecognised};
use crate::tokens::{self, Tokens};

/// By what tokens are recognised.
#[derive(Clone, Copy)]
pub struct Recognising<'a> {
    /// Tokens of the configuration.
    pub tokens: &'a Tokens,
    /// Tokens of the database.
    pub stored: &'a Stored,
    /// What was guessed, by address.
    pub guesses: &'a Mutex<Guesses>,
    /// How long sessions last.
    pub lasting: Lasting,
}

impl Recognising<'_> {
    /// Whose token it is, that came from an address.
    pub fn recognise(
        &self,
        token: &str,
        from: IpAddr,
        now: Millis,
    ) -> Result<Identity, Unrecognised> {
        self.by(token, from, now, || self.tokens.recognise(token))
    }

    /// Whose session it is that a browser shows. Nobody guesses one: they are looked for always.
    pub fn recognise_session(&self, secret: &str, now: Millis) -> Result<Identity, Unrecognised> {
        let hash = tokens::hash(secret);
        self.stored.recognise_session(&hash, now, self.lasting)
    }

    /// Looks for a token in the database and then, with `configured`, among those of the configuration. The former cannot be
    /// guessed, and are looked for always: who has one is not held up by whoever guesses at the same address. The latter
    /// people choose.
    pub(super) fn by(
        &self,
        token: &str,
        from: IpAddr,
        now: Millis,
        configured: impl FnOnce() -> Option<TokenHash>,
    ) -> Result<Identity, Unrecognised> {
        if let Some(identity) = self.stored.recognise(&tokens::hash(token), now)? {
            return Ok(identity);
        }
        let mut guesses = self.guesses.lock();
        guesses.ask(from, now).map_err(Unrecognised::Slowed)?;
        if let Some(hash) = configured() {
            return Ok(of_configuration(hash));
        }
        if let Some(wait) = guesses.failed(from, now) {
            let seconds = wait.div_ceil(1000);
            tracing::warn!(
                "tokens that are not known come from {from}: for {seconds} s none is looked at"
            );
        }
        Err(Unrecognised::Unknown)
    }
}

fn of_configuration(hash: TokenHash) -> Identity {
    Identity {
        principal: Arc::new(Principal::admin("configured")),
        shown: Shown::Configured,
        owner: Some(hash.clone()),
        token: Some(hash),
    }
}
