//! Digests of content (OCI image specification 1.1, "Digests"); SHA-256 alone, which all registries use.

use std::fmt;
use std::str::FromStr;

use anyhow::bail;
use serde::Deserialize;
use sha2::{Digest as _, Sha256};

/// Digest of a document or a layer: `sha256:` and 64 hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
#[serde(try_from = "String")]
pub struct Digest(String);

impl Digest {
    /// Computes the digest of a document.
    pub fn compute(bytes: &[u8]) -> Digest {
        Digest::from_hasher(Sha256::new_with_prefix(bytes))
    }

    /// Returns the digest of what a hasher was given.
    pub fn from_hasher(hasher: Sha256) -> Digest {
        Digest(hex::encode(hasher.finalize()))
    }

    /// Returns the hexadecimal digits.
    pub fn hex(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "sha256:{}", self.0)
    }
}

impl FromStr for Digest {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Digest> {
        let is_digit = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
        match text.strip_prefix("sha256:").filter(|digits| digits.len() == 64 && digits.bytes().all(is_digit)) {
            Some(digits) => Ok(Digest(digits.to_owned())),
            None => bail!("{:?} is no SHA-256 digest, sha256: and 64 hexadecimal digits", shorten(text)),
        }
    }
}

impl TryFrom<String> for Digest {
    type Error = anyhow::Error;

    fn try_from(text: String) -> anyhow::Result<Digest> {
        text.parse()
    }
}

/// Returns the beginning of a text that somebody else wrote, for a message.
fn shorten(text: &str) -> String {
    text.chars().take(80).collect()
}
