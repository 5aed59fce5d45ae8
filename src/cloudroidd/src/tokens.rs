//! Who may use the portal. Only hashes of tokens are kept in memory and on disk, except for what rosauth's
//! message authentication needs: there the token is the shared secret.

use anyhow::bail;
use sha2::{Digest, Sha256, Sha512};

/// SHA-256 of a token, lower-case hex.
pub type TokenHash = String;

/// The tokens of the configuration.
#[derive(Debug, Clone, Default)]
pub struct Tokens {
    hashes: Vec<TokenHash>,
    /// Those written in clear.
    secrets: Vec<String>,
}

/// rosbridge's `auth` operation (rosauth): a MAC over the other fields and the secret.
#[derive(Debug, Clone, serde::Deserialize)]
pub struct AuthMessage {
    /// The MAC, or a token as it is.
    #[serde(alias = "token")]
    pub mac: String,
    /// The client's address.
    #[serde(default)]
    pub client: String,
    /// The destination's address.
    #[serde(default)]
    pub dest: String,
    /// Something random.
    #[serde(default)]
    pub rand: String,
    /// Seconds since 1970 when it was made.
    #[serde(default)]
    pub t: f64,
    /// The client's level.
    #[serde(default)]
    pub level: String,
    /// Seconds since 1970 when it ends.
    #[serde(default)]
    pub end: f64,
}

/// Clocks may differ by so many seconds, as in rosauth.
const CLOCK_DIFFERENCE: f64 = 5.0;

/// SHA-256 of `token`, as it may be written into the configuration after `sha256:`.
pub fn hash(token: &str) -> TokenHash {
    hex::encode(Sha256::digest(token.as_bytes()))
}

impl Tokens {
    /// Reads the configuration's list.
    pub fn new(written: &[String]) -> anyhow::Result<Tokens> {
        let mut tokens = Tokens::default();
        for text in written {
            match text.strip_prefix("sha256:") {
                Some(digest)
                    if digest.len() == 64 && digest.chars().all(|c| c.is_ascii_hexdigit()) =>
                {
                    tokens.hashes.push(digest.to_ascii_lowercase());
                }
                Some(digest) => {
                    bail!("token \"sha256:{digest}\" is not followed by 64 hexadecimal digits")
                }
                None if text.len() < 8 => bail!(
                    "a token of {} characters is too short; use at least 8",
                    text.len()
                ),
                None => {
                    tokens.hashes.push(hash(text));
                    tokens.secrets.push(text.clone());
                }
            }
        }
        Ok(tokens)
    }

    /// Whether none is configured.
    pub fn is_empty(&self) -> bool {
        self.hashes.is_empty()
    }

    /// Hashes of all tokens.
    pub fn hashes(&self) -> &[TokenHash] {
        &self.hashes
    }

    /// The hash of `token`, if it is one of these.
    pub fn recognise(&self, token: &str) -> Option<TokenHash> {
        let hash = hash(token);
        self.hashes.contains(&hash).then_some(hash)
    }

    /// The hash of the token that signed `message`, at `now` (seconds since 1970).
    pub fn recognise_auth(&self, message: &AuthMessage, now: f64) -> Option<TokenHash> {
        if let Some(known) = self.recognise(&message.mac) {
            return Some(known);
        }
        let fresh = (message.t - now).abs() <= CLOCK_DIFFERENCE && message.end > now;
        let signed_by =
            |secret: &&String| message.signature(secret) == message.mac.to_ascii_lowercase();
        fresh
            .then(|| self.secrets.iter().find(signed_by))
            .flatten()
            .map(|secret| hash(secret))
    }
}

impl AuthMessage {
    /// SHA-512 over secret and fields; whole seconds, as roslibjs and rosauth write them.
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
        Tokens::new(
            &written
                .iter()
                .map(|text| (*text).to_owned())
                .collect::<Vec<_>>(),
        )
        .expect("valid tokens")
    }

    #[test]
    fn a_token_is_recognised_in_clear_and_by_its_hash() {
        let known = tokens(&[
            "open-sesame",
            &format!("sha256:{}", hash("other-secret").to_uppercase()),
        ]);
        assert_eq!(known.recognise("open-sesame"), Some(hash("open-sesame")));
        assert_eq!(known.recognise("other-secret"), Some(hash("other-secret")));
        assert_eq!(known.recognise("guess"), None);
        assert_eq!(
            known.recognise(&hash("other-secret")),
            None,
            "the hash itself opens nothing"
        );
    }

    #[test]
    fn bad_tokens_are_refused() {
        for written in ["short", "sha256:abc"] {
            Tokens::new(&[written.to_owned()]).expect_err(written);
        }
    }

    #[test]
    fn rosauth_messages_are_verified() {
        let known = tokens(&["open-sesame"]);
        let mut message = AuthMessage {
            mac: String::new(),
            client: "10.0.0.2".into(),
            dest: "10.0.0.1".into(),
            rand: "abc".into(),
            t: 1000.0,
            level: "user".into(),
            end: 2000.0,
        };
        message.mac = message.signature("open-sesame");
        assert_eq!(
            known.recognise_auth(&message, 1003.0),
            Some(hash("open-sesame"))
        );
        assert_eq!(known.recognise_auth(&message, 1010.0), None, "too old");
        let forged = AuthMessage {
            client: "10.0.0.3".into(),
            ..message.clone()
        };
        assert_eq!(
            known.recognise_auth(&forged, 1003.0),
            None,
            "signed for another"
        );
        let plain = AuthMessage {
            mac: "open-sesame".into(),
            ..message
        };
        assert_eq!(known.recognise_auth(&plain, 9e9), Some(hash("open-sesame")));
    }
}
