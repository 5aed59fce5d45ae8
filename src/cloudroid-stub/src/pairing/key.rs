//! The robot's own key (ECDSA, P-256): made here, and of it nothing leaves but its public half, with requests that it has signed.

use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::anyhow;
use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_ASN1_SIGNING, EcdsaKeyPair};
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};

use super::{about, request, write_whole};

/// The key.
pub struct Key {
    pair: EcdsaKeyPair,
    /// PKCS #8 (RFC 5958).
    written: PrivatePkcs8KeyDer<'static>,
}

impl Key {
    /// Reads a key that nobody else can.
    pub fn read(path: &Path) -> anyhow::Result<Key> {
        let mut file = std::fs::File::open(path).map_err(|error| match error.kind() {
            std::io::ErrorKind::PermissionDenied => about(
                path,
                "this robot's key cannot be read by this user; run the nodes as the user who paired the robot, or pair it as this one: \
                 cloudroid-stub pair 'LINE'",
            ),
            _ => about(path, format!("this robot's key cannot be read: {error}; pair the robot again: cloudroid-stub pair 'LINE'")),
        })?;
        let mode = file
            .metadata()
            .map_err(|error| about(path, error))?
            .permissions()
            .mode();
        if mode & 0o077 != 0 {
            return Err(about(
                path,
                format!(
                    "others can read this robot's key; if nobody has: chmod 600 {}",
                    path.display()
                ),
            ));
        }
        let mut text = String::new();
        file.read_to_string(&mut text)
            .map_err(|error| about(path, error))?;
        let read = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes());
        let key = read.map_err(|error| error.to_string()).and_then(Key::of);
        key.map_err(|error| {
            about(path, format!("this is no key ({error}); remove it, and pair the robot again: cloudroid-stub pair 'LINE'"))
        })
    }

    fn of(written: PrivatePkcs8KeyDer<'static>) -> Result<Key, String> {
        let (kind, random) = (&ECDSA_P256_SHA256_ASN1_SIGNING, SystemRandom::new());
        let pair = EcdsaKeyPair::from_pkcs8(kind, written.secret_pkcs8_der(), &random)
            .map_err(|error| error.to_string())?;
        Ok(Key { pair, written })
    }

    /// Makes one.
    pub fn make(path: &Path) -> anyhow::Result<Key> {
        let unmade = |error: &dyn std::fmt::Display| anyhow!("cannot make a key: {error}");
        let (kind, random) = (&ECDSA_P256_SHA256_ASN1_SIGNING, SystemRandom::new());
        let made = EcdsaKeyPair::generate_pkcs8(kind, &random).map_err(|error| unmade(&error))?;
        let written = PrivatePkcs8KeyDer::from(made.as_ref().to_vec());
        let key = Key::of(written).map_err(|error| unmade(&error))?;
        let text = request::pem("PRIVATE KEY", key.written.secret_pkcs8_der());
        write_whole(path, &text)?;
        Ok(key)
    }

    /// A request for a certificate, in PEM.
    pub fn request(&self, robot: &str) -> anyhow::Result<String> {
        request::request(&self.pair, &format!("robot:{robot}"))
            .map_err(|error| anyhow!("cannot make a request for a certificate: {error}"))
    }

    /// For TLS.
    pub fn to_show(&self) -> PrivateKeyDer<'static> {
        self.written.clone_key().into()
    }
}
