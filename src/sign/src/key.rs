//! The server's signing key, and its public key as kept by robots.

use std::fmt;
use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::str::FromStr;

use base64_simd::{STANDARD, STANDARD_NO_PAD};
use ring::rand::{SecureRandom, SystemRandom};
use ring::signature::{Ed25519KeyPair, KeyPair};
use sha2::{Digest, Sha256};

use crate::{Error, wire};

/// Name of the key type in OpenSSH.
pub const ALGORITHM: &str = "ssh-ed25519";
/// Bytes before the 32 bytes of a private key in PKCS #8 (RFC 8410, section 7).
const PKCS8: [u8; 16] =
    [0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20];
const BEGIN: &str = "-----BEGIN PRIVATE KEY-----";
const END: &str = "-----END PRIVATE KEY-----";

/// A private key.
pub struct SigningKey {
    pair: Ed25519KeyPair,
}

impl SigningKey {
    /// Loads the key from a file, creating it the first time. Only the file's owner may read it.
    pub fn load_or_create(path: &Path) -> Result<SigningKey, Error> {
        let io = |action| {
            let path = path.to_owned();
            move |source| Error::Io { action, path, source }
        };
        match std::fs::read_to_string(path) {
            Ok(text) => Self::from_pem(&text).ok_or_else(|| Error::NoKey(path.to_owned())),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let (key, text) = Self::generate()?;
                // Written atomically.
                let half = path.with_extension("half");
                let _ = std::fs::remove_file(&half);
                let mut file =
                    OpenOptions::new().write(true).create_new(true).mode(0o600).open(&half).map_err(io("make"))?;
                file.write_all(text.as_bytes())
                    .and_then(|()| file.sync_all())
                    .and_then(|()| std::fs::rename(&half, path))
                    .map_err(io("write"))?;
                Ok(key)
            }
            Err(error) => Err(io("read")(error)),
        }
    }

    /// Generates a new key; returns it with its PEM form.
    pub fn generate() -> Result<(SigningKey, String), Error> {
        let mut seed = [0; 32];
        SystemRandom::new().fill(&mut seed).map_err(|_| Error::NoRandom)?;
        let mut document = PKCS8.to_vec();
        document.extend_from_slice(&seed);
        let text = format!("{BEGIN}\n{}\n{END}\n", STANDARD.encode_to_string(document));
        let pair = Ed25519KeyPair::from_seed_unchecked(&seed).map_err(|_| Error::NoRandom)?;
        Ok((SigningKey { pair }, text))
    }

    fn from_pem(text: &str) -> Option<SigningKey> {
        let body = text.trim().strip_prefix(BEGIN)?.strip_suffix(END)?;
        let body: String = body.split_whitespace().collect();
        let document = STANDARD.decode_to_vec(body).ok()?;
        let seed = document.strip_prefix(&PKCS8)?;
        let pair = Ed25519KeyPair::from_seed_unchecked(seed).ok()?;
        Some(SigningKey { pair })
    }

    /// Returns the public key, by which others verify.
    pub fn public_key(&self) -> PublicKey {
        let mut bytes = [0; 32];
        bytes.copy_from_slice(self.pair.public_key().as_ref());
        PublicKey(bytes)
    }

    pub(crate) fn sign_bytes(&self, bytes: &[u8]) -> Vec<u8> {
        self.pair.sign(bytes).as_ref().to_vec()
    }
}

impl fmt::Debug for SigningKey {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "SigningKey({})", self.public_key().fingerprint())
    }
}

/// A public key: `ssh-ed25519 AAAA…`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PublicKey(pub(crate) [u8; 32]);

impl PublicKey {
    /// Encodes the key in SSH's binary form (RFC 8709, section 4).
    pub(crate) fn to_blob(self) -> Vec<u8> {
        let mut blob = Vec::new();
        wire::write_string(&mut blob, ALGORITHM.as_bytes());
        wire::write_string(&mut blob, &self.0);
        blob
    }

    pub(crate) fn from_blob(mut blob: &[u8]) -> Option<PublicKey> {
        let algorithm = wire::read_string(&mut blob)?;
        let bytes: [u8; 32] = wire::read_string(&mut blob)?.try_into().ok()?;
        (algorithm == ALGORITHM.as_bytes() && blob.is_empty()).then_some(PublicKey(bytes))
    }

    /// Returns the fingerprint, as printed by `ssh-keygen -l`.
    pub fn fingerprint(self) -> String {
        let hash = Sha256::digest(self.to_blob());
        format!("SHA256:{}", STANDARD_NO_PAD.encode_to_string(hash))
    }

    /// Returns the line for OpenSSH's list of allowed signers.
    pub fn allowed_signers_line(self) -> String {
        format!("cloudroid {self}")
    }
}

impl fmt::Display for PublicKey {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{ALGORITHM} {}", STANDARD.encode_to_string(self.to_blob()))
    }
}

impl FromStr for PublicKey {
    type Err = Error;

    fn from_str(text: &str) -> Result<PublicKey, Error> {
        // With or without the name of the algorithm before it.
        let encoded = text.trim();
        let encoded = encoded.strip_prefix(ALGORITHM).unwrap_or(encoded).trim();
        STANDARD
            .decode_to_vec(encoded)
            .ok()
            .and_then(|blob| PublicKey::from_blob(&blob))
            .ok_or_else(|| Error::NoPublicKey(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_key_is_made_once_and_is_its_owners_alone() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("signing.pem");
        let made = SigningKey::load_or_create(&path).expect("made").public_key();
        assert_eq!(SigningKey::load_or_create(&path).expect("read").public_key(), made);
        let mode = path.metadata().expect("there").permissions().mode() & 0o7777;
        assert_eq!(mode, 0o600);
        assert_eq!(std::fs::read_dir(place.path()).expect("there").count(), 1);
        std::fs::write(&path, "rubbish").expect("written");
        let refused = SigningKey::load_or_create(&path).expect_err("no key").to_string();
        assert!(refused.contains("signing.pem holds no ed25519 key"), "{refused}");
    }

    #[test]
    fn a_public_key_is_read_as_it_is_written() {
        let (key, _) = SigningKey::generate().expect("made");
        let public = key.public_key();
        let text = public.to_string();
        assert_eq!(text.parse::<PublicKey>().expect("read"), public);
        let bare = text.split(' ').nth(1).expect("two words");
        assert_eq!(bare.parse::<PublicKey>().expect("read"), public);
        for wrong in ["", "ssh-ed25519", "ssh-rsa AAAA", &text[..text.len() - 4]] {
            wrong.parse::<PublicKey>().expect_err(wrong);
        }
    }
}
