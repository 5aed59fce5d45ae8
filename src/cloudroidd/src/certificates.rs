//! The certificate that the portal shows: the operator's, read again when its files change, or one that the daemon makes for
//! itself and keeps in its home (ADR 080).

use std::io::Write;
use std::net::{IpAddr, SocketAddr};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use authority::Authority;
use portal::{App, Robots, Tls};
use rcgen::{CertificateParams, DnType, KeyPair};
use store::{Journal, NewEvent, private};
use tokio_rustls::rustls::pki_types::pem::{self, PemObject};
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};

use crate::config;
use crate::home::Home;

/// How often it is looked whether the files are others.
const LOOK: Duration = Duration::from_secs(1);
/// The daemon's own certificate and its key.
const OWN: &str = "own.pem";
/// The authority of robots' certificates and its key.
const AUTHORITY: &str = "authority.pem";

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file that cannot be read, or holds something else.
    #[error("cannot read the {what} in {path}: {source}; it should be a PEM file")]
    Unreadable {
        /// `certificate` or `key`.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// The cause.
        source: pem::Error,
    },
    /// A file without one.
    #[error("{0} holds no certificate; it should be a PEM file with BEGIN CERTIFICATE")]
    None(PathBuf),
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
    let directory = home.path().join("tls");
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
    let (certificate, key) = match config.files() {
        Some(files) => files,
        None => {
            let own = home.path().join("tls").join(OWN);
            if !own.exists() {
                make(&own, names(&config.names, listen))?;
            }
            (own.clone(), own)
        }
    };
    let (chain, key) = read(&certificate, &key)?;
    let unusable = |source| Error::Unusable {
        path: certificate,
        source,
    };
    let others = match &config.client_authorities {
        Some(path) => certificates(path)?,
        None => Vec::new(),
    };
    let tls = Tls::new(chain, key, robots.authority.certificate(), others).map_err(unusable)?;
    warn_of_other_names(&tls, &config.names);
    Ok(Some(Arc::new(tls)))
}

/// The daemon's certificate is made once, since clients have its fingerprint: names that are configured later are not in it.
fn warn_of_other_names(tls: &Tls, configured: &[String]) {
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
    let kept = || -> std::io::Result<()> {
        if let Some(directory) = path.parent() {
            private::make_directory(directory)?;
        }
        let begun = path.with_extension("begun");
        let mut file = private::open(&begun)?;
        file.set_len(0)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&begun, path)
    };
    kept().map_err(|source| Error::Unkept {
        path: path.to_owned(),
        source,
    })
}

/// Which version of a file it is.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Version(Option<(u64, u64, u64, i64, i64)>);

impl Version {
    fn of(path: &Path) -> Version {
        let about = std::fs::metadata(path).ok();
        Version(about.map(|about| {
            let (at, fraction) = (about.mtime(), about.mtime_nsec());
            (about.dev(), about.ino(), about.size(), at, fraction)
        }))
    }
}

/// Shows the operator's certificate anew whenever its files have changed, and have then been the same for a while, because
/// there are two of them. What cannot be used is told of, and the one before goes on being shown.
pub async fn keep(app: Arc<App>, certificate: PathBuf, key: PathBuf) {
    let Some(tls) = &app.tls else { return };
    let journal = Journal::new(Arc::clone(&app.state));
    let look = || (Version::of(&certificate), Version::of(&key));
    let (mut read_at, mut before) = (look(), look());
    loop {
        tokio::time::sleep(LOOK).await;
        let now = look();
        let settled = now == before;
        before = now.clone();
        if now == read_at || !settled {
            continue;
        }
        read_at = now;
        let shown = read(&certificate, &key).and_then(|(chain, key)| {
            tls.show(chain, key).map_err(|source| Error::Unusable {
                path: certificate.clone(),
                source,
            })
        });
        let about = NewEvent::default();
        match shown {
            Ok(()) => {
                let message = format!(
                    "the portal shows another certificate: {}",
                    tls.fingerprint()
                );
                journal.info("certificate-shown", &message, &about);
            }
            Err(error) => {
                let message = format!("{error}; the one before is shown on: {}", tls.fingerprint());
                journal.warning("certificate-refused", &message, &about);
            }
        }
    }
}
