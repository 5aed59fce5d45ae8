//! The certificate that the portal shows: the operator's, read again when its files change; that of an authority which is asked by
//! ACME; or one that the daemon makes for itself (ADR 080, 081). The latter two are kept in its home.

mod acme;
mod files;
mod own;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use authority::Authority;
use portal::{Robots, Tls};
use store::private;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject};
use tokio_rustls::rustls::pki_types::{
    CertificateDer, CertificateRevocationListDer, PrivateKeyDer,
};

use crate::config;
use crate::home::Home;

pub use acme::{Renewal, listen_for_challenges};
pub use files::{keep, keep_lists};

/// Where the home has certificates and keys.
const DIRECTORY: &str = "tls";
/// The authority of robots' certificates and its key.
const AUTHORITY: &str = "authority.pem";

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file that cannot be read, or holds something else.
    #[error("cannot read the {what} in {path}: {source}; it should be a PEM file")]
    Unreadable {
        /// `certificate`, `key` or `revocation list`.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// The cause.
        source: pem::Error,
    },
    /// A file without one.
    #[error("{0} holds no certificate; it should be a PEM file with BEGIN CERTIFICATE")]
    None(PathBuf),
    /// A file without a revocation list.
    #[error("{0} holds no revocation list; it should be a PEM file with BEGIN X509 CRL")]
    NoList(PathBuf),
    /// They do not belong together, or are of a kind that nobody knows.
    #[error("{path}: {source}")]
    Unusable {
        /// The certificate's file.
        path: PathBuf,
        /// The cause.
        source: portal::TlsError,
    },
    /// The daemon's own cannot be made.
    #[error(
        "cannot make a certificate for {names}: {source}; correct names in [tls] of the configuration"
    )]
    Unmade {
        /// The names that it was to have.
        names: String,
        /// The cause.
        source: rcgen::Error,
    },
    /// The daemon's own cannot be kept.
    #[error("cannot keep the daemon's certificate in {path}: {source}")]
    Unkept {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
}

/// A certificate with those that lead from it to an authority, and its key.
type Pair = (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>);

fn unreadable(what: &'static str, path: &Path) -> impl FnOnce(pem::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Unreadable { what, path, source }
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, Error> {
    let read = CertificateDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(unreadable("certificate", path))?;
    match read.is_empty() {
        true => Err(Error::None(path.to_owned())),
        false => Ok(read),
    }
}

/// Has certificates refused that the lists of a file name.
fn revoke(tls: &Tls, path: &Path) -> Result<(), Error> {
    let lists = CertificateRevocationListDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(unreadable("revocation list", path))?;
    if lists.is_empty() {
        return Err(Error::NoList(path.to_owned()));
    }
    tls.revoke(lists).map_err(|source| Error::Unusable {
        path: path.to_owned(),
        source,
    })
}

fn read(certificate: &Path, key: &Path) -> Result<Pair, Error> {
    let chain = certificates(certificate)?;
    let key = PrivateKeyDer::from_pem_file(key).map_err(unreadable("key", key))?;
    Ok((chain, key))
}

/// The authority of robots' certificates, where TLS is spoken: made at the first time.
pub fn robots(
    config: &config::Tls,
    home: &Home,
    listen: SocketAddr,
) -> anyhow::Result<Option<Robots>> {
    if !config.is_spoken(listen) {
        return Ok(None);
    }
    let directory = home.path().join(DIRECTORY);
    private::make_directory(&directory)
        .with_context(|| format!("cannot make {}", directory.display()))?;
    Ok(Some(Robots {
        authority: Authority::of_file(&directory.join(AUTHORITY))?,
        lifetime: config.robot_certificates.0,
    }))
}

/// TLS for a portal that listens at `listen`, where it is spoken there.
pub fn tls(
    config: &config::Tls,
    home: &Home,
    listen: SocketAddr,
    robots: Option<&Robots>,
) -> Result<Option<Arc<Tls>>, Error> {
    let Some(robots) = robots else {
        return Ok(None);
    };
    let directory = home.path().join(DIRECTORY);
    let (certificate, (chain, key)) = match (config.files(), &config.acme) {
        (Some((certificate, key)), _) => {
            let pair = read(&certificate, &key)?;
            (certificate, pair)
        }
        (None, Some(acme)) => match acme::kept(acme, &directory) {
            Some(kept) => kept,
            None => own::kept(&directory, config, listen)?,
        },
        (None, None) => own::kept(&directory, config, listen)?,
    };
    let unusable = |source| Error::Unusable {
        path: certificate,
        source,
    };
    let others = match &config.client_authorities {
        Some(path) => certificates(path)?,
        None => Vec::new(),
    };
    let tls = Tls::new(chain, key, robots.authority.certificate(), others).map_err(unusable)?;
    if let Some(path) = &config.client_revocations {
        revoke(&tls, path)?;
    }
    if config.acme.is_none() {
        own::warn_of_other_names(&tls, &config.names);
    }
    Ok(Some(Arc::new(tls)))
}
