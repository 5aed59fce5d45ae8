//! The portal's certificate: the operator's, reloaded when its files change; one obtained from an authority by ACME; or
//! one that the daemon makes for itself (ADR 080, 081). The latter two are kept in the home.

mod acme;
mod files;
mod own;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use authority::Authority;
use portal::{RobotAuthority, Tls};
use store::private;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject};
use tokio_rustls::rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};

use crate::config;
use crate::home::Home;

pub use acme::{Renewal, listen_for_challenges};
pub use files::{watch_certificate, watch_revocation_lists};

/// Directory of certificates and keys in the home.
const DIRECTORY: &str = "tls";
/// File of the authority of robots' certificates and its key.
const AUTHORITY: &str = "authority.pem";

/// Reason why there is no certificate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file cannot be read, or holds something else.
    #[error("cannot read the {what} in {path}: {source}; it should be a PEM file")]
    Unreadable {
        /// `certificate`, `key` or `revocation list`.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Underlying error.
        source: pem::Error,
    },
    /// A file holds no certificate.
    #[error("{0} holds no certificate; it should be a PEM file with BEGIN CERTIFICATE")]
    None(PathBuf),
    /// A file holds no revocation list.
    #[error("{0} holds no revocation list; it should be a PEM file with BEGIN X509 CRL")]
    NoList(PathBuf),
    /// Certificate and key do not match, or are of an unsupported kind.
    #[error("{path}: {source}")]
    Unusable {
        /// Path of the certificate.
        path: PathBuf,
        /// Underlying error.
        source: portal::TlsError,
    },
    /// The daemon's own certificate cannot be made.
    #[error("cannot create a certificate for {names}: {source}; correct names in [tls] of the configuration")]
    Unmade {
        /// Names that the certificate was to have.
        names: String,
        /// Underlying error.
        source: rcgen::Error,
    },
    /// The daemon's own certificate cannot be written to its file.
    #[error("cannot write the daemon's certificate to {path}: {source}")]
    Unkept {
        /// Path of the file.
        path: PathBuf,
        /// Underlying error.
        source: std::io::Error,
    },
}

/// A certificate chain and its key.
type ChainAndKey = (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>);

fn unreadable(what: &'static str, path: &Path) -> impl FnOnce(pem::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Unreadable { what, path, source }
}

fn read_certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, Error> {
    let read = CertificateDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(unreadable("certificate", path))?;
    if read.is_empty() { Err(Error::None(path.to_owned())) } else { Ok(read) }
}

/// Loads revocation lists from a file; certificates that they name are refused from then on.
fn load_revocation_lists(tls: &Tls, path: &Path) -> Result<(), Error> {
    let lists = CertificateRevocationListDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(unreadable("revocation list", path))?;
    if lists.is_empty() {
        return Err(Error::NoList(path.to_owned()));
    }
    tls.set_revocation_lists(lists).map_err(|source| Error::Unusable { path: path.to_owned(), source })
}

fn read_chain_and_key(certificate: &Path, key: &Path) -> Result<ChainAndKey, Error> {
    let chain = read_certificates(certificate)?;
    let key = PrivateKeyDer::from_pem_file(key).map_err(unreadable("key", key))?;
    Ok((chain, key))
}

/// Opens the authority of robots' certificates, which is created at first use; `None` without TLS.
pub fn open_robot_authority(
    config: &config::TlsConfig,
    home: &Home,
    listen: SocketAddr,
) -> anyhow::Result<Option<RobotAuthority>> {
    if !config.is_enabled(listen) {
        return Ok(None);
    }
    let directory = home.path().join(DIRECTORY);
    private::make_directory(&directory).with_context(|| format!("cannot create {}", directory.display()))?;
    Ok(Some(RobotAuthority {
        authority: Authority::load_or_create(&directory.join(AUTHORITY))?,
        lifetime: config.robot_certificates.0,
    }))
}

/// Builds the TLS of a portal that listens at `listen`; `None` without TLS.
pub fn build_tls(
    config: &config::TlsConfig,
    home: &Home,
    listen: SocketAddr,
    robots: Option<&RobotAuthority>,
) -> Result<Option<Arc<Tls>>, Error> {
    let Some(robots) = robots else {
        return Ok(None);
    };
    let directory = home.path().join(DIRECTORY);
    let (certificate, (chain, key)) = match (config.certificate_files(), &config.acme) {
        (Some((certificate, key)), _) => {
            let pair = read_chain_and_key(&certificate, &key)?;
            (certificate, pair)
        }
        (None, Some(acme)) => match acme::load_certificate(acme, &directory) {
            Some(kept) => kept,
            None => own::load_or_create(&directory, config, listen)?,
        },
        (None, None) => own::load_or_create(&directory, config, listen)?,
    };
    let unusable = |source| Error::Unusable { path: certificate, source };
    let others = match &config.client_authorities {
        Some(path) => read_certificates(path)?,
        None => Vec::new(),
    };
    let tls = Tls::new(chain, key, robots.authority.certificate(), others).map_err(unusable)?;
    if let Some(path) = &config.client_revocations {
        load_revocation_lists(&tls, path)?;
    }
    if config.acme.is_none() {
        own::warn_of_missing_names(&tls, &config.names);
    }
    Ok(Some(Arc::new(tls)))
}
