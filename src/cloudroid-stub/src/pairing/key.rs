//! The robot's own key (ECDSA, P-256): made here, and of it nothing leaves but its public half, with requests that it has signed.

use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::Context;
use rcgen::{CertificateParams, DistinguishedName, DnType, KeyPair};
use tokio_rustls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};

use super::{about, write_whole};

/// The key.
pub struct Key(KeyPair);

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
        let pair = KeyPair::from_pem(&text).map_err(|error| {
            about(path, format!("this is no key ({error}); remove it, and pair the robot again: cloudroid-stub pair 'LINE'"))
        })?;
        Ok(Key(pair))
    }

    /// Makes one.
    pub fn make(path: &Path) -> anyhow::Result<Key> {
        let pair = KeyPair::generate().context("cannot make a key")?;
        write_whole(path, &pair.serialize_pem())?;
        Ok(Key(pair))
    }

    /// A request for a certificate (PKCS #10, RFC 2986), in PEM.
    pub fn request(&self, robot: &str) -> anyhow::Result<String> {
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        params
            .distinguished_name
            .push(DnType::CommonName, format!("robot:{robot}"));
        let request = params.serialize_request(&self.0);
        request
            .and_then(|request| request.pem())
            .context("cannot make a request for a certificate")
    }

    /// For TLS.
    pub fn to_show(&self) -> PrivateKeyDer<'static> {
        PrivatePkcs8KeyDer::from(self.0.serialize_der()).into()
    }
}
