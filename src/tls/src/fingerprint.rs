//! Fingerprints of certificates: the SHA-256 of their DER, written as `SHA256:` and 64 hexadecimal digits.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tokio_rustls::rustls::pki_types::CertificateDer;

/// What stands before the digits.
const PREFIX: &str = "SHA256:";

/// The SHA-256 of a certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Fingerprint([u8; 32]);

/// A text that is no fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no fingerprint of a certificate; write SHA256: and 64 hexadecimal digits")]
pub struct NoFingerprint(String);

impl Fingerprint {
    /// That of a certificate.
    pub fn of(certificate: &CertificateDer<'_>) -> Self {
        Self(Sha256::digest(certificate.as_ref()).into())
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{PREFIX}{}", hex::encode(self.0))
    }
}

impl FromStr for Fingerprint {
    type Err = NoFingerprint;

    /// Also takes the form of `openssl x509 -fingerprint -sha256`: capitals, with colons between the bytes.
    fn from_str(text: &str) -> Result<Self, NoFingerprint> {
        let wrong = || NoFingerprint(text.to_owned());
        let prefix = text.get(..PREFIX.len()).ok_or_else(wrong)?;
        if !prefix.eq_ignore_ascii_case(PREFIX) {
            return Err(wrong());
        }
        let digits = &text[PREFIX.len()..];
        let digits = match digits.contains(':') {
            true if digits.split(':').all(|byte| byte.len() == 2) => digits.replace(':', ""),
            true => return Err(wrong()),
            false => digits.to_owned(),
        };
        let mut bytes = [0; 32];
        hex::decode_to_slice(digits, &mut bytes).map_err(|_| wrong())?;
        Ok(Self(bytes))
    }
}

impl TryFrom<String> for Fingerprint {
    type Error = NoFingerprint;

    fn try_from(text: String) -> Result<Self, NoFingerprint> {
        text.parse()
    }
}

impl From<Fingerprint> for String {
    fn from(fingerprint: Fingerprint) -> String {
        fingerprint.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fingerprint_is_read_as_it_is_written() {
        let fingerprint = Fingerprint::of(&CertificateDer::from(b"abc".as_slice()));
        // The example of FIPS 180-4.
        let text = "SHA256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(fingerprint.to_string(), text);
        assert_eq!(text.parse(), Ok(fingerprint));
        let digits = text.strip_prefix(PREFIX).unwrap().to_uppercase();
        let pairs: Vec<&str> = (0..32).map(|at| &digits[2 * at..2 * at + 2]).collect();
        let as_openssl = format!("sha256:{}", pairs.join(":"));
        assert_eq!(as_openssl.parse(), Ok(fingerprint));
    }

    #[test]
    fn what_is_no_fingerprint_is_refused_with_its_form() {
        let short = format!("SHA256:{}", "a".repeat(63));
        let long = format!("SHA256:{}", "a".repeat(66));
        let bare = "a".repeat(64);
        let uneven = format!("SHA256:a:{}", "a".repeat(63));
        for text in ["", "SHA256:", "SHA1:00", "ä", &short, &long, &bare, &uneven] {
            let refused = text.parse::<Fingerprint>().expect_err(text).to_string();
            assert!(refused.contains("64 hexadecimal digits"), "{refused}");
        }
    }
}
