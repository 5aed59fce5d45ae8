//! The certificate that the daemon makes for itself, once.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use portal::Tls;
use rcgen::{CertificateParams, DnType, KeyPair};
use store::private;

use super::{Error, Pair, read};
use crate::config;

/// The certificate and its key.
const OWN: &str = "own.pem";

/// What the home has of it, made at the first time, with the path of its file.
pub fn kept(
    directory: &Path,
    config: &config::Tls,
    listen: SocketAddr,
) -> Result<(PathBuf, Pair), Error> {
    let path = directory.join(OWN);
    if !path.exists() {
        make(&path, names(&config.names, listen))?;
    }
    let pair = read(&path, &path)?;
    Ok((path, pair))
}

/// The daemon's certificate is made once, since clients have its fingerprint: names that are configured later are not in it.
pub fn warn_of_other_names(tls: &Tls, configured: &[String]) {
    let is_other = |name: &&str| !tls.speaks_for(name);
    let others: Vec<&str> = configured
        .iter()
        .map(String::as_str)
        .filter(is_other)
        .collect();
    if !others.is_empty() {
        tracing::warn!(
            "the daemon's certificate was made before names in [tls] had {}: clients that know its fingerprint do not mind; \
             for those that look at names, stop the daemon, remove tls/{OWN} of its home and start it (every client then has \
             to accept the new one, with cloudroidctl trust)",
            others.join(", ")
        );
    }
}

/// By which names and addresses this machine may be reached.
fn names(configured: &[String], listen: SocketAddr) -> Vec<String> {
    let mut names = configured.to_vec();
    let host = nix::unistd::gethostname();
    names.extend(host.ok().and_then(|name| name.into_string().ok()));
    names.extend(["localhost", "127.0.0.1", "::1"].map(str::to_owned));
    let at: IpAddr = listen.ip();
    if !at.is_unspecified() && !at.is_loopback() {
        names.push(at.to_string());
    }
    let mut seen = std::collections::HashSet::new();
    names.retain(|name| seen.insert(name.clone()));
    names
}

/// Makes a certificate that signs itself, and keeps it with its key. It has no end (RFC 5280, section 4.1.2.5): who trusts it
/// has its fingerprint, and would have to be told of another.
fn make(path: &Path, names: Vec<String>) -> Result<(), Error> {
    let all = names.join(", ");
    let unmade = |source| Error::Unmade { names: all, source };
    let made = || -> Result<String, rcgen::Error> {
        let first = names.first().cloned().unwrap_or_default();
        let mut params = CertificateParams::new(names)?;
        params.distinguished_name.push(DnType::CommonName, first);
        params.not_before = rcgen::date_time_ymd(2000, 1, 1);
        params.not_after = rcgen::date_time_ymd(9999, 12, 31);
        let key = KeyPair::generate()?;
        let certificate = params.self_signed(&key)?;
        Ok(certificate.pem() + &key.serialize_pem())
    };
    let text = made().map_err(unmade)?;
    private::replace(path, text.as_bytes()).map_err(|source| Error::Unkept {
        path: path.to_owned(),
        source,
    })
}
