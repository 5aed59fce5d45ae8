//! The self-signed certificate that the daemon makes for itself, once.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use portal::Tls;
use rcgen::{CertificateParams, DnType, KeyPair};
use store::private;

use super::{ChainAndKey, Error, read_chain_and_key};
use crate::config;

/// File of the certificate and its key.
const OWN: &str = "own.pem";

/// Loads the certificate from the home, created at first use, with the path of its file.
pub fn load_or_create(
    directory: &Path,
    config: &config::TlsConfig,
    listen: SocketAddr,
) -> Result<(PathBuf, ChainAndKey), Error> {
    let path = directory.join(OWN);
    if !path.exists() {
        create(&path, certificate_names(&config.names, listen))?;
    }
    let pair = read_chain_and_key(&path, &path)?;
    Ok((path, pair))
}

/// Warns if names are configured that the certificate does not have. It is made once only, since clients know it by its
/// fingerprint.
pub fn warn_of_missing_names(tls: &Tls, configured: &[String]) {
    let is_other = |name: &&str| !tls.is_valid_for_host(name);
    let others: Vec<&str> = configured.iter().map(String::as_str).filter(is_other).collect();
    if !others.is_empty() {
        tracing::warn!(
            "the daemon's certificate lacks {}, which names in [tls] has now: clients that trust its fingerprint are \
                not affected; for those that verify names, stop the daemon, remove tls/{OWN} in its home and start it \
                (every client must then accept the new certificate with cloudroidctl trust)",
            others.join(", ")
        );
    }
}

/// Returns the names and addresses by which this machine may be reached.
fn certificate_names(configured: &[String], listen: SocketAddr) -> Vec<String> {
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

/// Makes a self-signed certificate and writes it with its key. It does not expire (RFC 5280, section 4.1.2.5): clients
/// know it by its fingerprint and would have to be told of a new one.
fn create(path: &Path, names: Vec<String>) -> Result<(), Error> {
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
    private::write_atomically(path, text.as_bytes()).map_err(|source| Error::Unkept { path: path.to_owned(), source })
}
