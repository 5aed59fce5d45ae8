//! The directory of a robot's own key and certificates.

use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use nix::fcntl::{Flock, FlockArg};
use serde::{Deserialize, Serialize};
use tls::KnownServers;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;

use super::key::Key;
use super::{about, write_whole};
use crate::address::Address;

/// The directory.
#[derive(Debug, Clone)]
pub struct Own(pub PathBuf);

/// A certificate of this robot for one server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Certificate {
    /// The name that the robot is paired by.
    pub robot: String,
    /// When it came, by the robot's clock: milliseconds since 1970. The server's may tell another time.
    pub received: u64,
    /// For how long it is good, in milliseconds.
    pub lifetime: u64,
    /// The certificate, in PEM.
    pub certificate: String,
}

/// What a server answers.
#[derive(Deserialize)]
struct Answer {
    robot: String,
    certificate: String,
    issued: u64,
    expires: u64,
}

pub fn now() -> u64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as u64)
}

impl Certificate {
    /// Reads what a server has answered.
    pub fn read(answer: &[u8]) -> anyhow::Result<Certificate> {
        let answer: Answer = serde_json::from_slice(answer)?;
        let read = Certificate {
            robot: answer.robot,
            received: now(),
            lifetime: answer.expires.saturating_sub(answer.issued),
            certificate: answer.certificate,
        };
        read.chain()?;
        Ok(read)
    }

    /// For TLS.
    pub fn chain(&self) -> anyhow::Result<Vec<CertificateDer<'static>>> {
        let chain = CertificateDer::pem_slice_iter(self.certificate.as_bytes())
            .collect::<Result<Vec<_>, _>>()
            .context("the certificate is no PEM")?;
        anyhow::ensure!(!chain.is_empty(), "there is no certificate");
        Ok(chain)
    }

    /// How long it is good.
    pub fn lifetime(&self) -> Duration {
        Duration::from_millis(self.lifetime)
    }

    /// How long until it is to be renewed: at two thirds of its life. At once, too, where the robot's clock was set back, since
    /// nobody knows how long ago it came.
    pub fn due(&self, now: u64) -> Duration {
        let Some(age) = now.checked_sub(self.received) else {
            return Duration::ZERO;
        };
        Duration::from_millis((self.lifetime / 3 * 2).saturating_sub(age))
    }
}

impl Own {
    /// The robot's key.
    pub fn key(&self) -> PathBuf {
        self.0.join("robot.key")
    }

    /// The file of the certificate for a server.
    fn of_server(&self, address: &Address) -> PathBuf {
        self.0
            .join("paired")
            .join(format!("{}.toml", address.known_as()))
    }

    /// Servers whose certificates are known.
    pub fn known_servers(&self) -> KnownServers {
        KnownServers::at(self.0.join("known_servers"))
    }

    /// The key, made where there is none yet.
    pub fn make_key(&self) -> anyhow::Result<Key> {
        let path = self.key();
        match path.symlink_metadata() {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Key::make(&path),
            _ => Key::read(&path),
        }
    }

    /// The certificate for a server; none where the robot is not paired with it.
    pub fn certificate(&self, address: &Address) -> anyhow::Result<Option<Certificate>> {
        let path = self.of_server(address);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            // Nothing is kept there for this user.
            Err(error) if error.kind() == std::io::ErrorKind::NotADirectory => return Ok(None),
            Err(error) => {
                let words = format!(
                    "this robot's certificate cannot be read: {error}; run the nodes as the user who paired the robot"
                );
                return Err(about(&path, words));
            }
        };
        toml::from_str(&text).map(Some).map_err(|error| {
            let words = format!("this is no certificate as cloudroid-stub pair writes it ({}); pair the robot again", error.message());
            about(&path, words)
        })
    }

    /// Keeps a certificate in place of the one before, which stays until this one is written.
    pub fn keep(&self, address: &Address, certificate: &Certificate) -> anyhow::Result<()> {
        write_whole(&self.of_server(address), &toml::to_string(certificate)?)
    }

    /// Keeps the key that a server signs stubs by, as install.sh reads it.
    pub fn trust_signer(&self, key: &str) -> anyhow::Result<()> {
        let path = self.0.join("servers.pub");
        let line = format!("cloudroid ssh-ed25519 {key}");
        let mut text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(about(&path, error)),
        };
        if text.lines().any(|known| known == line) {
            return Ok(());
        }
        text.push_str(&line);
        text.push('\n');
        write_whole(&path, &text)
    }

    /// The right to renew the certificate for a server; none while another stub does.
    pub fn lock(&self, address: &Address) -> Option<Flock<std::fs::File>> {
        let path = self.of_server(address).with_extension("lock");
        let file = std::fs::OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .ok()?;
        Flock::lock(file, FlockArg::LockExclusiveNonblock).ok()
    }
}
