//! The directory of a robot's key and certificates.

use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use nix::fcntl::{Flock, FlockArg};
use serde::{Deserialize, Serialize};
use tls::KnownServers;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;

use super::files::{file_error, write_atomically};
use super::key::RobotKey;
use crate::address::Address;

/// The directory with the key and certificates of this robot.
#[derive(Debug, Clone)]
pub struct IdentityDirectory(pub PathBuf);

/// A certificate of this robot for one server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PairedCertificate {
    /// Name that the robot is paired under.
    pub robot: String,
    /// Time at which the certificate was received, by the robot's clock, in milliseconds since 1970. The server's clock
    /// may differ.
    pub received: u64,
    /// Validity in milliseconds.
    pub lifetime: u64,
    /// The certificate, in PEM.
    pub certificate: String,
}

/// Answer of a server to a pairing or renewal.
#[derive(Deserialize)]
struct CertificateAnswer {
    robot: String,
    certificate: String,
    issued: u64,
    expires: u64,
}

pub fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

impl PairedCertificate {
    /// Parses the answer of a server.
    pub fn read(answer: &[u8]) -> anyhow::Result<PairedCertificate> {
        let answer: CertificateAnswer = serde_json::from_slice(answer)?;
        let read = PairedCertificate {
            robot: answer.robot,
            received: now(),
            lifetime: answer.expires.saturating_sub(answer.issued),
            certificate: answer.certificate,
        };
        read.chain()?;
        Ok(read)
    }

    /// Returns the certificate chain for TLS.
    pub fn chain(&self) -> anyhow::Result<Vec<CertificateDer<'static>>> {
        let chain = CertificateDer::pem_slice_iter(self.certificate.as_bytes())
            .collect::<Result<Vec<_>, _>>()
            .context("the certificate is not in PEM format")?;
        anyhow::ensure!(!chain.is_empty(), "no certificate found");
        Ok(chain)
    }

    /// Returns the validity of the certificate.
    pub fn lifetime(&self) -> Duration {
        Duration::from_millis(self.lifetime)
    }

    /// Returns the time until the certificate is to be renewed, at two thirds of its validity. Zero if the robot's
    /// clock was set back, because its age is then unknown.
    pub fn renewal_delay(&self, now: u64) -> Duration {
        let Some(age) = now.checked_sub(self.received) else {
            return Duration::ZERO;
        };
        Duration::from_millis((self.lifetime / 3 * 2).saturating_sub(age))
    }
}

impl IdentityDirectory {
    /// Returns the path of the robot's key.
    pub fn key_path(&self) -> PathBuf {
        self.0.join("robot.key")
    }

    /// Returns the path of the certificate for a server.
    fn certificate_path(&self, address: &Address) -> PathBuf {
        self.0.join("paired").join(format!("{}.toml", address.known_server_name()))
    }

    /// Returns the servers whose certificates are known.
    pub fn known_servers(&self) -> KnownServers {
        KnownServers::new(self.0.join("known_servers"))
    }

    /// Loads the key, or generates it if there is none.
    pub fn load_or_create_key(&self) -> anyhow::Result<RobotKey> {
        let path = self.key_path();
        match path.symlink_metadata() {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => RobotKey::generate(&path),
            _ => RobotKey::read(&path),
        }
    }

    /// Loads the certificate for a server; `None` if the robot is not paired with it.
    pub fn load_certificate(&self, address: &Address) -> anyhow::Result<Option<PairedCertificate>> {
        let path = self.certificate_path(address);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            // This user has no such directory.
            Err(error) if error.kind() == std::io::ErrorKind::NotADirectory => return Ok(None),
            Err(error) => {
                let words = format!(
                    "cannot read this robot's certificate: {error}; run the nodes as the user who paired the robot"
                );
                return Err(file_error(&path, words));
            }
        };
        toml::from_str(&text).map(Some).map_err(|error| {
            let words =
                format!("not a certificate file of cloudroid-stub pair ({}); pair the robot again", error.message());
            file_error(&path, words)
        })
    }

    /// Stores a certificate, replacing the previous one atomically.
    pub fn store_certificate(&self, address: &Address, certificate: &PairedCertificate) -> anyhow::Result<()> {
        write_atomically(&self.certificate_path(address), &toml::to_string(certificate)?)
    }

    /// Adds the key that a server signs stubs with to the file that install.sh reads.
    pub fn trust_signer(&self, key: &str) -> anyhow::Result<()> {
        let path = self.0.join("servers.pub");
        let line = format!("cloudroid ssh-ed25519 {key}");
        let mut text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(file_error(&path, error)),
        };
        if text.lines().any(|known| known == line) {
            return Ok(());
        }
        text.push_str(&line);
        text.push('\n');
        write_atomically(&path, &text)
    }

    /// Acquires the lock to renew the certificate for a server; `None` while another stub holds it.
    pub fn lock_renewal(&self, address: &Address) -> Option<Flock<std::fs::File>> {
        let path = self.certificate_path(address).with_extension("lock");
        let file = std::fs::OpenOptions::new().write(true).create(true).truncate(false).open(path).ok()?;
        Flock::lock(file, FlockArg::LockExclusiveNonblock).ok()
    }
}
