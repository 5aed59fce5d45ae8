//! `[tls]`: use of TLS, and the certificate.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use serde::Deserialize;

use super::AcmeConfig;
use super::time::Time;

/// TLS of the portal.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TlsConfig {
    /// Addresses on which TLS is used.
    pub serve: TlsMode,
    /// PEM file of the certificate chain, the certificate first (default: the daemon makes its own).
    pub certificate: Option<PathBuf>,
    /// PEM file of the certificate's key.
    pub key: Option<PathBuf>,
    /// Additional names and addresses of this machine for the certificate that the daemon makes.
    pub names: Vec<String>,
    /// Lifetime of the robots' certificates that the daemon signs; robots renew them in time.
    pub robot_certificates: Time,
    /// PEM file of the lab's own authorities that sign robots' certificates, besides the daemon's.
    pub client_authorities: Option<PathBuf>,
    /// PEM file of revocation lists (RFC 5280) of these authorities.
    pub client_revocations: Option<PathBuf>,
    /// Authority to obtain the certificate from.
    pub acme: Option<AcmeConfig>,
}

impl Default for TlsConfig {
    fn default() -> Self {
        TlsConfig {
            serve: TlsMode::default(),
            certificate: None,
            key: None,
            names: Vec::new(),
            robot_certificates: Time::seconds(7 * 86_400),
            client_authorities: None,
            client_revocations: None,
            acme: None,
        }
    }
}

/// Shortest lifetime: certificates have a resolution of one second.
const SHORTEST: Duration = Duration::from_secs(1);

/// Addresses on which TLS is used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TlsMode {
    /// Beyond loopback, and everywhere if a certificate is configured.
    #[default]
    Auto,
    /// Everywhere, including loopback.
    Tls,
    /// Nowhere: anybody on the network path can read the traffic.
    PlainTextBeyondLoopback,
}

impl TlsConfig {
    /// Returns whether a portal that listens at an address uses TLS.
    pub fn is_enabled(&self, listen: SocketAddr) -> bool {
        match self.serve {
            TlsMode::Auto => self.has_certificate() || !listen.ip().is_loopback(),
            TlsMode::Tls => true,
            TlsMode::PlainTextBeyondLoopback => false,
        }
    }

    /// Returns whether a certificate other than the daemon's own is configured.
    fn has_certificate(&self) -> bool {
        self.certificate.is_some() || self.acme.is_some()
    }

    /// Returns the files of the operator's certificate and key.
    pub fn certificate_files(&self) -> Option<(PathBuf, PathBuf)> {
        self.certificate.clone().zip(self.key.clone())
    }

    pub(super) fn check(&self) -> anyhow::Result<()> {
        match (&self.certificate, &self.key) {
            (Some(_), None) => {
                bail!("certificate needs key; set key to the file of its private key")
            }
            (None, Some(_)) => {
                bail!("key needs certificate; set certificate to the file of its certificate")
            }
            _ => {}
        }
        if let Some(acme) = &self.acme {
            acme.check().context("[tls.acme]")?;
            if self.certificate.is_some() {
                bail!("certificate and [tls.acme] exclude each other; remove one of them");
            }
        }
        if self.serve == TlsMode::PlainTextBeyondLoopback && self.has_certificate() {
            bail!("serve = \"plain-text-beyond-loopback\" does not use the certificate; remove one of them");
        }
        if self.has_certificate() && !self.names.is_empty() {
            bail!("names is only for the daemon's own certificate, but another one is set; remove one of them");
        }
        if self.client_revocations.is_some() && self.client_authorities.is_none() {
            bail!("client_revocations needs client_authorities; set it to the authorities of those lists");
        }
        if self.robot_certificates.0 < SHORTEST {
            bail!(
                "robot_certificates is {:?}, too short for robots to renew their certificates; write at least 1s, \
                    usually 168h",
                self.robot_certificates.0
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> TlsConfig {
        toml::from_str(text).expect("well-formed")
    }

    #[test]
    fn beyond_loopback_plain_text_needs_words() {
        let own = "certificate = \"c\"\nkey = \"k\"";
        for (text, loopback, beyond) in [
            ("", false, true),
            ("serve = \"auto\"", false, true),
            (own, true, true),
            ("[acme]\nnames = [\"a.b\"]\naccept_terms = true", true, true),
            ("serve = \"tls\"", true, true),
            ("serve = \"plain-text-beyond-loopback\"", false, false),
        ] {
            let tls = read(text);
            for (listen, spoken) in [
                ("127.0.0.1:1", loopback),
                ("[::1]:1", loopback),
                ("0.0.0.0:1", beyond),
                ("[::]:1", beyond),
                ("192.0.2.1:1", beyond),
            ] {
                let listen = listen.parse().expect("an address");
                assert_eq!(tls.is_enabled(listen), spoken, "{text:?} at {listen}");
            }
            tls.check().expect(text);
        }
    }

    #[test]
    fn what_cannot_be_together_is_refused() {
        for (text, words) in [
            ("certificate = \"c\"", "set key to the file"),
            ("key = \"k\"", "file of its certificate"),
            ("client_revocations = \"r\"", "client_authorities"),
            ("serve = \"plain-text-beyond-loopback\"\ncertificate = \"c\"\nkey = \"k\"", "remove one"),
            ("certificate = \"c\"\nkey = \"k\"\n[acme]\nnames = [\"a.b\"]\naccept_terms = true", "remove one"),
            ("serve = \"plain-text-beyond-loopback\"\n[acme]\nnames = [\"a.b\"]\naccept_terms = true", "remove one"),
            ("[acme]\nnames = [\"a.b\"]", "[tls.acme]"),
            ("names = [\"n\"]\ncertificate = \"c\"\nkey = \"k\"", "remove one"),
            ("robot_certificates = \"500ms\"", "at least 1s"),
        ] {
            let refused = format!("{:#}", read(text).check().expect_err(text));
            assert!(refused.contains(words), "{refused}");
        }
    }
}
