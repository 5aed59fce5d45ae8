//! The robot's private key (ECDSA, P-256), generated here. Only its public half leaves the robot, in requests signed
//! with the key.

use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::anyhow;
use ring::error::KeyRejected;
use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_ASN1_SIGNING, EcdsaKeyPair};
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};

use super::files::{file_error, write_atomically};
use super::request;

/// The private key of this robot.
pub struct RobotKey {
    pair: EcdsaKeyPair,
    /// PKCS #8 (RFC 5958).
    written: PrivatePkcs8KeyDer<'static>,
}

impl RobotKey {
    /// Reads a key that no other user can read.
    pub fn read(path: &Path) -> anyhow::Result<RobotKey> {
        let mut file = std::fs::File::open(path).map_err(|error| match error.kind() {
            std::io::ErrorKind::PermissionDenied => file_error(
                path,
                "this user cannot read this robot's key; run the nodes as the user who paired the robot, or pair it as \
                    this user: cloudroid-stub pair 'LINE'",
            ),
            _ => file_error(
                path,
                format!(
                    "cannot read this robot's key: {error}; pair the robot again: cloudroid-stub \
                pair 'LINE'"
                ),
            ),
        })?;
        let mode = file.metadata().map_err(|error| file_error(path, error))?.permissions().mode();
        if mode & 0o077 != 0 {
            return Err(file_error(
                path,
                format!("other users can read this robot's key; restrict it with: chmod 600 {}", path.display()),
            ));
        }
        let mut text = String::new();
        file.read_to_string(&mut text).map_err(|error| file_error(path, error))?;
        let invalid = |error: &dyn std::fmt::Display| {
            file_error(
                path,
                format!("not a valid key ({error}); remove it, and pair the robot again: cloudroid-stub pair 'LINE'"),
            )
        };
        let read = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes());
        let written = read.map_err(|error| invalid(&error))?;
        RobotKey::from_pkcs8(written).map_err(|error| invalid(&error))
    }

    fn from_pkcs8(written: PrivatePkcs8KeyDer<'static>) -> Result<RobotKey, KeyRejected> {
        let (kind, random) = (&ECDSA_P256_SHA256_ASN1_SIGNING, SystemRandom::new());
        let pair = EcdsaKeyPair::from_pkcs8(kind, written.secret_pkcs8_der(), &random)?;
        Ok(RobotKey { pair, written })
    }

    /// Generates a key and writes it to the file.
    pub fn generate(path: &Path) -> anyhow::Result<RobotKey> {
        let unmade = |error: &dyn std::fmt::Display| anyhow!("cannot create a key: {error}");
        let (kind, random) = (&ECDSA_P256_SHA256_ASN1_SIGNING, SystemRandom::new());
        let made = EcdsaKeyPair::generate_pkcs8(kind, &random).map_err(|error| unmade(&error))?;
        let written = PrivatePkcs8KeyDer::from(made.as_ref().to_vec());
        let key = RobotKey::from_pkcs8(written).map_err(|error| unmade(&error))?;
        let text = request::pem("PRIVATE KEY", key.written.secret_pkcs8_der());
        write_atomically(path, &text)?;
        Ok(key)
    }

    /// Returns a certificate request in PEM.
    pub fn certificate_request(&self, robot: &str) -> anyhow::Result<String> {
        request::request(&self.pair, &format!("robot:{robot}"))
            .map_err(|error| anyhow!("cannot create a certificate request: {error}"))
    }

    /// Returns the private key for TLS.
    pub fn private_key(&self) -> PrivateKeyDer<'static> {
        self.written.clone_key().into()
    }
}
