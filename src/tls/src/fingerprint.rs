//! Certificate fingerprints: the SHA-256 hash of the DER encoding, written as `SHA256:` and 64 hexadecimal digits.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tokio_rustls::rustls::pki_types::CertificateDer;

/// Prefix of the digits.
const PREFIX: &str = "SHA256:";

/// SHA-256 fingerprint of a certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Fingerprint([u8; 32]);

/// Error for text that is not a fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not a certificate fingerprint; write SHA256: and 64 hexadecimal digits")]
pub struct ParseFingerprintError(String);

impl Fingerprint {
    /// Computes the fingerprint of a certificate.
    pub fn from_certificate(certificate: &CertificateDer<'_>) -> Self {
        Self(Sha256::digest(certificate.as_ref()).into())
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{PREFIX}{}", hex::encode(self.0))
    }
}

impl FromStr for Fingerprint {
    type Err = ParseFingerprintError;

    /// Also accepts the output of `openssl x509 -fingerprint -sha256`: upper case, with colons between the bytes.
    fn from_str(text: &str) -> Result<Self, ParseFingerprintError> {
        let wrong = || ParseFingerprintError(text.to_owned());
        let prefix = text.get(..PREFIX.len()).ok_or_else(wrong)?;
        if !prefix.eq_ignore_ascii_case(PREFIX) {
            return Err(wrong());
        }
        let digits = &text[PREFIX.len()..];
        if digits.contains(':') && digits.split(':').any(|byte| byte.len() != 2) {
            return Err(wrong());
        }
        let digits = digits.replace(':', "");
        let mut bytes = [0; 32];
        hex::decode_to_slice(digits, &mut bytes).map_err(|_| wrong())?;
        Ok(Self(bytes))
    }
}

impl TryFrom<String> for Fingerprint {
    type Error = ParseFingerprintError;

    fn try_from(text: String) -> Result<Self, ParseFingerprintError> {
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
        let fingerprint = Fingerprint::from_certificate(&CertificateDer::from(b"abc".as_slice()));
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
