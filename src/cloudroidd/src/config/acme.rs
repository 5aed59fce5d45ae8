//! `[tls.acme]`: a certificate of an authority that is asked by ACME (RFC 8555).

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::bail;
use instant_acme::LetsEncrypt;
use serde::Deserialize;

use super::Time;

/// Which certificate is asked for, and of whom.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Acme {
    /// Names of this machine in the public DNS.
    pub names: Vec<String>,
    /// Whether the authority's terms of service are agreed to.
    pub accept_terms: bool,
    /// Whom the authority may write to: `mailto:…`.
    pub contact: Vec<String>,
    /// Its directory (RFC 8555, section 7.1.1); that of Let's Encrypt by default.
    pub directory: String,
    /// PEM file of the authorities by whom the directory's server is known; the system's by default.
    pub authorities: Option<PathBuf>,
    /// Where the authority looks whether a name leads here, if port 443 does not lead to the portal itself.
    pub challenge_listen: Option<SocketAddr>,
    /// How long after a failure it is asked again; twice as long each further time, up to 6 hours.
    pub retry: Time,
}

impl Default for Acme {
    fn default() -> Self {
        Acme {
            names: Vec::new(),
            accept_terms: false,
            contact: Vec::new(),
            directory: LetsEncrypt::Production.url().to_owned(),
            authorities: None,
            challenge_listen: None,
            retry: Time::seconds(600),
        }
    }
}

impl Acme {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if self.names.is_empty() {
            bail!("names is missing: the names in the public DNS that lead to this machine");
        }
        if let Some(name) = self.names.iter().find(|name| !is_name(name)) {
            bail!(
                "names has {name:?}: an authority that looks at port 443 gives certificates for whole names, as robots.lab.example; \
                 addresses, wildcards and names without a dot need a certificate of another kind (certificate and key of [tls])"
            );
        }
        let directory = self.directory.parse::<portal::Uri>().ok();
        let usable = directory.as_ref().is_some_and(|uri| {
            let here = uri.host().is_some_and(outbound::is_this_machine);
            uri.scheme_str() == Some("https") || here && uri.scheme_str() == Some("http")
        });
        if !usable {
            bail!(
                "directory = {:?} is no address of a directory; write https://HOST/PATH",
                self.directory
            );
        }
        if let Some(contact) = self
            .contact
            .iter()
            .find(|contact| !contact.starts_with("mailto:"))
        {
            bail!("contact has {contact:?}; write \"mailto:NAME@HOST\"");
        }
        if !self.accept_terms {
            bail!(
                "accept_terms is missing: the authority at {} gives certificates to those who agree to its terms of service; \
                 read them, then write accept_terms = true",
                self.directory
            );
        }
        if self.retry.0.is_zero() {
            bail!("retry = 0 would ask without end; write a time such as \"10m\"");
        }
        Ok(())
    }
}

/// Whether a name may be one of the public DNS (RFC 1123, section 2.1): labels of letters, digits and hyphens, two at least, the last
/// of which is no number.
fn is_name(name: &str) -> bool {
    let labels: Vec<&str> = name.split('.').collect();
    let is_label = |label: &&str| {
        (1..=63).contains(&label.len())
            && !label.starts_with('-')
            && !label.ends_with('-')
            && label.chars().all(|c| c.is_ascii_alphanumeric() || c == '-')
    };
    name.len() <= 253
        && labels.len() > 1
        && labels.iter().all(is_label)
        && labels
            .last()
            .is_some_and(|last| last.parse::<u64>().is_err())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str) -> String {
        let acme: Acme = toml::from_str(text).expect("well-formed");
        acme.check().expect_err(text).to_string()
    }

    #[test]
    fn what_no_authority_could_sign_is_refused() {
        for (text, words) in [
            ("accept_terms = true", "names is missing"),
            (
                "accept_terms = true\nnames = [\"*.lab.example\"]",
                "wildcards",
            ),
            ("accept_terms = true\nnames = [\"192.0.2.1\"]", "192.0.2.1"),
            ("accept_terms = true\nnames = [\"robots\"]", "without a dot"),
            ("accept_terms = true\nnames = [\"a..b\"]", "a..b"),
            ("names = [\"robots.lab.example\"]", "terms of service"),
            (
                "accept_terms = true\nnames = [\"a.b\"]\ndirectory = \"http://ca.lab.example/\"",
                "https://",
            ),
            (
                "accept_terms = true\nnames = [\"a.b\"]\ncontact = [\"me@lab.example\"]",
                "mailto:",
            ),
            ("accept_terms = true\nnames = [\"a.b\"]\nretry = 0", "retry"),
        ] {
            let refused = refused(text);
            assert!(refused.contains(words), "{refused}");
        }
    }

    #[test]
    fn names_and_agreement_are_enough() {
        let acme: Acme =
            toml::from_str("names = [\"robots.lab.example\"]\naccept_terms = true").expect("read");
        acme.check().expect("complete");
        assert!(acme.directory.starts_with("https://"));
    }
}
