//! `[tls]`: where TLS is spoken, and with which certificate.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use serde::Deserialize;

use super::Acme;
use super::time::Time;

/// TLS of the portal.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Tls {
    /// Where it is spoken.
    pub serve: Serve,
    /// PEM file of the certificate, followed by those that lead from it to an authority. Without one the daemon makes its own.
    pub certificate: Option<PathBuf>,
    /// PEM file of its key.
    pub key: Option<PathBuf>,
    /// Names and addresses of this machine that the certificate which the daemon makes is to have, besides those that it knows.
    pub names: Vec<String>,
    /// How long robots' certificates are good that the daemon signs; the robots renew them in time.
    pub robot_certificates: Time,
    /// PEM file of authorities of the lab's own that sign robots' certificates, besides the daemon's.
    pub client_authorities: Option<PathBuf>,
    /// PEM file of revocation lists (RFC 5280) of these authorities.
    pub client_revocations: Option<PathBuf>,
    /// Whom the daemon asks for its certificate.
    pub acme: Option<Acme>,
}

impl Default for Tls {
    fn default() -> Self {
        Tls {
            serve: Serve::default(),
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

/// Certificates have whole seconds.
const SHORTEST: Duration = Duration::from_secs(1);

/// Where TLS is spoken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Serve {
    /// Beyond loopback, and wherever a certificate is named.
    #[default]
    Auto,
    /// On loopback, too.
    Tls,
    /// Nowhere: everybody on the way reads what is sent.
    PlainTextBeyondLoopback,
}

impl Tls {
    /// Whether a portal that listens at an address speaks it.
    pub fn is_spoken(&self, listen: SocketAddr) -> bool {
        match self.serve {
            Serve::Auto => self.is_named() || !listen.ip().is_loopback(),
            Serve::Tls => true,
            Serve::PlainTextBeyondLoopback => false,
        }
    }

    /// Whether there is a certificate that is not the daemon's own.
    fn is_named(&self) -> bool {
        self.certificate.is_some() || self.acme.is_some()
    }

    /// The files of the operator's own certificate and key.
    pub fn files(&self) -> Option<(PathBuf, PathBuf)> {
        self.certificate.clone().zip(self.key.clone())
    }

    pub(super) fn check(&self) -> anyhow::Result<()> {
        match (&self.certificate, &self.key) {
            (Some(_), None) => {
                bail!("certificate is of no use without key; name the file of its key, too")
            }
            (None, Some(_)) => {
                bail!("key is of no use without certificate; name the file of its certificate, too")
            }
            _ => {}
        }
        if let Some(acme) = &self.acme {
            acme.check().context("[tls.acme]")?;
            if self.certificate.is_some() {
                bail!(
                    "certificate names one that is there, and [tls.acme] asks for another; remove one of both"
                );
            }
        }
        if self.serve == Serve::PlainTextBeyondLoopback && self.is_named() {
            bail!(
                "serve = \"plain-text-beyond-loopback\" shows nobody the certificate; remove one of both"
            );
        }
        if self.is_named() && !self.names.is_empty() {
            bail!(
                "names are for the certificate that the daemon makes, and another is named; remove one of both"
            );
        }
        if self.client_revocations.is_some() && self.client_authorities.is_none() {
            bail!(
                "client_revocations names lists of authorities that client_authorities does not name; name them, too"
            );
        }
        if self.robot_certificates.0 < SHORTEST {
            bail!(
                "robot_certificates is {:?}, and robots have to renew them in time; make it 1s at least, 168h is usual",
                self.robot_certificates.0
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Tls {
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
                assert_eq!(tls.is_spoken(listen), spoken, "{text:?} at {listen}");
            }
            tls.check().expect(text);
        }
    }

    #[test]
    fn what_cannot_be_together_is_refused() {
        for (text, words) in [
            ("certificate = \"c\"", "file of its key"),
            ("key = \"k\"", "file of its certificate"),
            ("client_revocations = \"r\"", "client_authorities"),
            (
                "serve = \"plain-text-beyond-loopback\"\ncertificate = \"c\"\nkey = \"k\"",
                "remove one",
            ),
            (
                "certificate = \"c\"\nkey = \"k\"\n[acme]\nnames = [\"a.b\"]\naccept_terms = true",
                "remove one",
            ),
            (
                "serve = \"plain-text-beyond-loopback\"\n[acme]\nnames = [\"a.b\"]\naccept_terms = true",
                "remove one",
            ),
            ("[acme]\nnames = [\"a.b\"]", "[tls.acme]"),
            (
                "names = [\"n\"]\ncertificate = \"c\"\nkey = \"k\"",
                "remove one",
            ),
            ("robot_certificates = \"500ms\"", "1s at least"),
        ] {
            let refused = format!("{:#}", read(text).check().expect_err(text));
            assert!(refused.contains(words), "{refused}");
        }
    }
}
