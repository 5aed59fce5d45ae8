//! Tokens of the configuration. Only hashes of tokens are kept in memory and on disk, except for rosauth's message
//! authentication, where the token is the shared secret.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use sha2::{Digest, Sha256, Sha512};

pub use store::TokenHash;

/// The tokens of the configuration.
#[derive(Debug, Clone, Default)]
pub struct Tokens {
    hashes: Vec<TokenHash>,
    /// Tokens written in clear text.
    secrets: Vec<String>,
    /// MACs that were accepted, and until when (seconds since 1970) they would be accepted again.
    used: Arc<Mutex<HashMap<String, f64>>>,
}

/// Error for an invalid token.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TokenError {
    /// `sha256:` is not followed by a hash.
    #[error("token \"sha256:{0}\" is not followed by 64 hexadecimal digits")]
    Digest(String),
    /// The token is too short.
    #[error("a token of {0} characters is too short; use at least 8")]
    Short(usize),
}

/// Reason why an `auth` message is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AuthRefusal {
    /// It contains no known token and is not currently signed by one.
    #[error("the auth message neither contains a known token nor is signed by one")]
    Unknown,
    /// It was accepted before.
    #[error("this auth message was used before; each is valid once: sign a new one (t, rand) for each connection")]
    Used,
}

/// rosbridge's `auth` operation (rosauth): a MAC over the other fields and the secret.
#[derive(Debug, Clone, serde::Deserialize)]
pub struct AuthMessage {
    /// The MAC, or a token in clear text.
    #[serde(alias = "token")]
    pub mac: String,
    /// Address of the client.
    #[serde(default)]
    pub client: String,
    /// Address of the destination.
    #[serde(default)]
    pub dest: String,
    /// Random text.
    #[serde(default)]
    pub rand: String,
    /// Time of creation in seconds since 1970.
    #[serde(default)]
    pub t: f64,
    /// Access level of the client.
    #[serde(default)]
    pub level: String,
    /// End of validity in seconds since 1970.
    #[serde(default)]
    pub end: f64,
}

/// Tolerated clock skew in seconds, as in rosauth.
const CLOCK_DIFFERENCE: f64 = 5.0;

/// Returns the SHA-256 hash of `token`, as it may be written into the configuration after `sha256:`.
pub fn hash(token: &str) -> TokenHash {
    hex::encode(Sha256::digest(token.as_bytes()))
}

impl Tokens {
    /// Parses the configuration's list.
    pub fn new(written: &[String]) -> Result<Tokens, TokenError> {
        let mut tokens = Tokens::default();
        for text in written {
            match text.strip_prefix("sha256:") {
                Some(digest) if digest.len() == 64 && digest.chars().all(|c| c.is_ascii_hexdigit()) => {
                    tokens.hashes.push(digest.to_ascii_lowercase());
                }
                Some(digest) => return Err(TokenError::Digest(digest.to_owned())),
                None if text.len() < 8 => return Err(TokenError::Short(text.len())),
                None => {
                    tokens.hashes.push(hash(text));
                    tokens.secrets.push(text.clone());
                }
            }
        }
        Ok(tokens)
    }

    /// Returns true if no token is configured.
    pub fn is_empty(&self) -> bool {
        self.hashes.is_empty()
    }

    /// Returns the hashes of all tokens.
    pub fn hashes(&self) -> &[TokenHash] {
        &self.hashes
    }

    /// Returns the hash of `token` if it is configured.
    pub fn recognise(&self, token: &str) -> Option<TokenHash> {
        let hash = hash(token);
        self.hashes.contains(&hash).then_some(hash)
    }

    /// Returns the hash of the token that `message` contains or is signed with, at `now` (seconds since 1970). A
    /// signed message is accepted once, so it cannot be replayed.
    pub fn recognise_auth(&self, message: &AuthMessage, now: f64) -> Result<TokenHash, AuthRefusal> {
        if let Some(known) = self.recognise(&message.mac) {
            return Ok(known);
        }
        let mac = message.mac.to_ascii_lowercase();
        let fresh = (message.t - now).abs() <= CLOCK_DIFFERENCE && message.end > now;
        let secret =
            self.secrets.iter().find(|secret| fresh && message.signature(secret) == mac).ok_or(AuthRefusal::Unknown)?;
        let mut used = self.used.lock();
        used.retain(|_, until| *until >= now);
        // The MAC does not cover the fraction of `t`.
        let until = message.t.trunc() + 1.0 + CLOCK_DIFFERENCE;
        match used.insert(mac, until) {
            None => Ok(hash(secret)),
            Some(_) => Err(AuthRefusal::Used),
        }
    }
}

/// Returns the key for a client's resume token: a hash of the token and the principal it is bound to, so that nobody
/// else can resume with it.
pub fn bind_resume_token(principal: Option<&str>, resume: &str) -> String {
    let principal = principal.unwrap_or_default();
    hash(&format!("{principal} {resume}"))
}

impl AuthMessage {
    /// Computes the SHA-512 hash of secret and fields, with whole seconds, as roslibjs and rosauth do.
    fn signature(&self, secret: &str) -> String {
        let text = format!(
            "{secret}{}{}{}{}{}{}",
            self.client, self.dest, self.rand, self.t as i64, self.level, self.end as i64
        );
        hex::encode(Sha512::digest(text.as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens(written: &[&str]) -> Tokens {
        Tokens::new(&written.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>()).expect("valid tokens")
    }

    #[test]
    fn a_token_is_recognised_in_clear_and_by_its_hash() {
        let known = tokens(&["open-sesame", &format!("sha256:{}", hash("other-secret").to_uppercase())]);
        assert_eq!(known.recognise("open-sesame"), Some(hash("open-sesame")));
        assert_eq!(known.recognise("other-secret"), Some(hash("other-secret")));
        assert_eq!(known.recognise("guess"), None);
        assert_eq!(known.recognise(&hash("other-secret")), None, "the hash itself opens nothing");
    }

    #[test]
    fn bad_tokens_are_refused() {
        for written in ["short", "sha256:abc"] {
            Tokens::new(&[written.to_owned()]).expect_err(written);
        }
    }

    /// Creates a message signed at 1000 s and valid until 2000 s.
    fn signed_message(secret: &str) -> AuthMessage {
        let mut message = AuthMessage {
            mac: String::new(),
            client: "10.0.0.2".into(),
            dest: "10.0.0.1".into(),
            rand: "abc".into(),
            t: 1000.0,
            level: "user".into(),
            end: 2000.0,
        };
        message.mac = message.signature(secret);
        message
    }

    #[test]
    fn rosauth_messages_are_verified() {
        let known = tokens(&["open-sesame"]);
        let message = signed_message("open-sesame");
        assert_eq!(known.recognise_auth(&message, 1010.0), Err(AuthRefusal::Unknown), "too old");
        let forged = AuthMessage { client: "10.0.0.3".into(), ..message.clone() };
        assert_eq!(known.recognise_auth(&forged, 1003.0), Err(AuthRefusal::Unknown), "signed for another");
        assert_eq!(known.recognise_auth(&message, 1003.0), Ok(hash("open-sesame")));
        let plain = AuthMessage { mac: "open-sesame".into(), ..message };
        for _ in 0..2 {
            assert_eq!(known.recognise_auth(&plain, 9e9), Ok(hash("open-sesame")));
        }
    }

    #[test]
    fn a_signed_message_counts_once() {
        let known = tokens(&["open-sesame"]);
        let message = signed_message("open-sesame");
        let later = tokens(&["open-sesame"]);
        known.recognise_auth(&message, 996.0).expect("the first");
        let upper = AuthMessage { mac: message.mac.to_uppercase(), ..message.clone() };
        let delayed = AuthMessage { t: 1000.9, ..message.clone() };
        for (again, now) in [(&message, 996.0), (&upper, 1004.0), (&delayed, 1005.8)] {
            assert_eq!(known.recognise_auth(again, now), Err(AuthRefusal::Used), "{now}");
        }
        // Messages too old to be accepted are forgotten.
        let mut next = AuthMessage { t: 1010.0, ..message.clone() };
        next.mac = next.signature("open-sesame");
        known.recognise_auth(&next, 1010.0).expect("another one");
        assert_eq!(known.used.lock().len(), 1);
        later.recognise_auth(&message, 1000.0).expect("not used there");
    }

    #[test]
    fn a_resume_token_is_bound_to_who_shows_it() {
        let (one, two) = (hash("one"), hash("two"));
        assert_eq!(bind_resume_token(Some(&one), "mine"), bind_resume_token(Some(&one), "mine"));
        for other in [
            bind_resume_token(Some(&two), "mine"),
            bind_resume_token(None, "mine"),
            bind_resume_token(Some(&one), "yours"),
        ] {
            assert_ne!(bind_resume_token(Some(&one), "mine"), other);
        }
    }
}
