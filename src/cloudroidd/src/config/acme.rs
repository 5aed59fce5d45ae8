//! `[tls.acme]`: a certificate obtained from an authority by ACME (RFC 8555).

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::bail;
use instant_acme::LetsEncrypt;
use serde::Deserialize;

use super::Time;

/// Names of the certificate, and the authority to ask.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AcmeConfig {
    /// Names of this machine in the public DNS.
    pub names: Vec<String>,
    /// Agreement to the authority's terms of service; must be true.
    pub accept_terms: bool,
    /// Contact addresses for the authority: `mailto:…`.
    pub contact: Vec<String>,
    /// Directory URL of the authority (RFC 8555, section 7.1.1; default: Let's Encrypt).
    pub directory: String,
    /// PEM file of the authorities by which the directory server's certificate is checked (default: the system's).
    pub authorities: Option<PathBuf>,
    /// Address for the authority's challenges, if port 443 does not lead to the portal itself.
    pub challenge_listen: Option<SocketAddr>,
    /// Pause after a failed attempt, doubled each time up to 6 hours.
    pub retry: Time,
}

impl Default for AcmeConfig {
    fn default() -> Self {
        AcmeConfig {
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

impl AcmeConfig {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if self.names.is_empty() {
            bail!("names is missing: the names in the public DNS that lead to this machine");
        }
        if let Some(name) = self.names.iter().find(|name| !is_name(name)) {
            bail!(
                "names has {name:?}: only full domain names such as robots.lab.example can be verified through port \
                    443; for addresses, wildcards and names without a dot set certificate and key in [tls]"
            );
        }
        let directory = self.directory.parse::<portal::Uri>().ok();
        let usable = directory.as_ref().is_some_and(|uri| {
            let here = uri.host().is_some_and(outbound::is_loopback_host);
            uri.scheme_str() == Some("https") || here && uri.scheme_str() == Some("http")
        });
        if !usable {
            bail!("directory = {:?} is not the URL of an ACME directory; write https://HOST/PATH", self.directory);
        }
        if let Some(contact) = self.contact.iter().find(|contact| !contact.starts_with("mailto:")) {
            bail!("contact has {contact:?}, which is not a mail address; write \"mailto:NAME@HOST\"");
        }
        if !self.accept_terms {
            bail!(
                "accept_terms is missing: the authority at {} requires agreement to its terms of service; read them, \
                    then write accept_terms = true",
                self.directory
            );
        }
        if self.retry.0.is_zero() {
            bail!("retry = 0 would retry without a pause; write a time such as \"10m\"");
        }
        Ok(())
    }
}

/// Returns whether a name may be in the public DNS (RFC 1123, section 2.1): at least two labels of letters, digits and
/// hyphens, the last one not a number.
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
        && labels.last().is_some_and(|last| last.parse::<u64>().is_err())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(text: &str) -> String {
        let acme: AcmeConfig = toml::from_str(text).expect("well-formed");
        acme.check().expect_err(text).to_string()
    }

    #[test]
    fn what_no_authority_could_sign_is_refused() {
        for (text, words) in [
            ("accept_terms = true", "names is missing"),
            ("accept_terms = true\nnames = [\"*.lab.example\"]", "wildcards"),
            ("accept_terms = true\nnames = [\"192.0.2.1\"]", "192.0.2.1"),
            ("accept_terms = true\nnames = [\"robots\"]", "without a dot"),
            ("accept_terms = true\nnames = [\"a..b\"]", "a..b"),
            ("names = [\"robots.lab.example\"]", "terms of service"),
            ("accept_terms = true\nnames = [\"a.b\"]\ndirectory = \"http://ca.lab.example/\"", "https://"),
            ("accept_terms = true\nnames = [\"a.b\"]\ncontact = [\"me@lab.example\"]", "mailto:"),
            ("accept_terms = true\nnames = [\"a.b\"]\nretry = 0", "retry"),
        ] {
            let refused = refusal(text);
            assert!(refused.contains(words), "{refused}");
        }
    }

    #[test]
    fn names_and_agreement_are_enough() {
        let acme: AcmeConfig = toml::from_str("names = [\"robots.lab.example\"]\naccept_terms = true").expect("read");
        acme.check().expect("complete");
        assert!(acme.directory.starts_with("https://"));
    }
}
