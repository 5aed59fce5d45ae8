//! A certificate obtained from an authority by ACME (RFC 8555): kept in the home and renewed after two thirds of its
//! lifetime.

mod account;
mod order;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use portal::App;
use store::{Journal, NewEvent, private};
use tokio::net::TcpListener;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;

use self::order::to_anyhow;
use super::{ChainAndKey, DIRECTORY, read_chain_and_key};
use crate::config;
use crate::home::Home;

/// File of the certificate chain and its key.
const CERTIFICATE: &str = "acme.pem";
/// Interval between looks at the clock: it may be set, and the machine may have slept.
const LOOK: Duration = Duration::from_secs(3600);
/// Longest time between two attempts.
const LONGEST_RETRY: Duration = Duration::from_secs(6 * 3600);

/// Loads the certificate of the home with the path of its file, if it is valid now and covers all names.
pub fn load_certificate(acme: &config::AcmeConfig, directory: &Path) -> Option<(PathBuf, ChainAndKey)> {
    let path = directory.join(CERTIFICATE);
    if !path.exists() {
        return None;
    }
    let pair = match read_chain_and_key(&path, &path) {
        Ok(pair) => pair,
        Err(error) => {
            tracing::warn!("{error}; requesting a new certificate");
            return None;
        }
    };
    let certificate = pair.0.first()?;
    let good = authority::read_validity(certificate).is_ok_and(|period| store::now() < period.until);
    (good && covers_all(certificate, &acme.names)).then_some((path, pair))
}

fn covers_all(certificate: &CertificateDer<'_>, names: &[String]) -> bool {
    names.iter().all(|name| tls::is_valid_for_host(certificate, name))
}

/// Binds the address that the authority connects to, if that is not the portal's own port.
pub async fn listen_for_challenges(acme: Option<&config::AcmeConfig>) -> anyhow::Result<Option<TcpListener>> {
    let Some(address) = acme.and_then(|acme| acme.challenge_listen) else {
        return Ok(None);
    };
    let listener = TcpListener::bind(address)
        .await
        .with_context(|| format!("cannot listen on {address}, which is challenge_listen in [tls.acme]"))?;
    Ok(Some(listener))
}

/// Keeps the certificate valid by renewing it in time.
pub struct Renewal {
    app: Arc<App>,
    acme: config::AcmeConfig,
    directory: PathBuf,
    looked_at: SocketAddr,
}

impl Renewal {
    /// Creates the renewal for a daemon that listens at `listen`.
    pub fn new(app: Arc<App>, acme: config::AcmeConfig, home: &Home, listen: SocketAddr) -> Renewal {
        let looked_at = acme.challenge_listen.unwrap_or(listen);
        Renewal { app, acme, directory: home.path().join(DIRECTORY), looked_at }
    }

    /// Requests a certificate whenever one is due, until the daemon ends.
    pub async fn run(self) {
        let journal = Journal::new(Arc::clone(&self.app.state));
        let about = NewEvent::default();
        loop {
            self.wait_until_due().await;
            let mut pause = self.acme.retry.0;
            while let Err(error) = self.renew().await {
                let fingerprint = self.app.tls.as_ref().map(|tls| tls.fingerprint());
                let shown = fingerprint.map_or_else(String::new, |print| print.to_string());
                let message = format!(
                    "{} did not issue a certificate for {}: {error:#}; next attempt in {} s, until then the portal \
                        uses {shown}",
                    self.acme.directory,
                    self.acme.names.join(", "),
                    pause.as_secs(),
                );
                journal.warning("certificate-not-renewed", &message, &about);
                tokio::time::sleep(pause).await;
                pause = (pause * 2).min(LONGEST_RETRY);
            }
            if let Some(tls) = &self.app.tls {
                let message = format!(
                    "the portal now uses a certificate for {}, signed by {}: {}",
                    self.acme.names.join(", "),
                    self.acme.directory,
                    tls.fingerprint()
                );
                journal.info("certificate-shown", &message, &about);
            }
        }
    }

    /// Waits until two thirds of the certificate's lifetime have passed; returns at once if there is no certificate for
    /// these names.
    async fn wait_until_due(&self) {
        loop {
            let (acme, directory) = (self.acme.clone(), self.directory.clone());
            let kept = privilege::run(async move { load_certificate(&acme, &directory) }).await;
            let due = kept.and_then(|(_, (chain, _))| renewal_time(chain.first()?));
            let left = due.unwrap_or(0).saturating_sub(store::now());
            if left == 0 {
                return;
            }
            tokio::time::sleep(LOOK.min(Duration::from_millis(left))).await;
        }
    }

    async fn renew(&self) -> anyhow::Result<()> {
        let Some(tls) = &self.app.tls else {
            bail!("TLS is off");
        };
        let account = account::load_or_create(&self.acme, &self.directory).await?;
        let made = order::order_certificate(&account, &self.acme.names, tls, self.looked_at).await;
        // The challenges are over.
        tls.set_challenges(Vec::new()).map_err(to_anyhow)?;
        if made.as_ref().is_err_and(account::is_unknown_account) {
            account::forget(&self.directory).await?;
        }
        let made = made?;
        let path = self.directory.join(CERTIFICATE);
        let text = format!("{}\n{}", made.chain.trim_end(), made.key);
        let keep = path.clone();
        let (chain, key) = privilege::run(async move {
            let first = CertificateDer::from_pem_slice(text.as_bytes())
                .context("the authority's response is not a certificate")?;
            authority::read_validity(&first)?;
            private::write_atomically(&keep, text.as_bytes())
                .with_context(|| format!("cannot write it to {}", keep.display()))?;
            Ok::<ChainAndKey, anyhow::Error>(read_chain_and_key(&keep, &keep)?)
        })
        .await?;
        if let Some(first) = chain.first()
            && !covers_all(first, &self.acme.names)
        {
            bail!("the authority's certificate is for other names");
        }
        tls.replace_certificate(chain, key).map_err(to_anyhow)
    }
}

/// Returns the time at which a certificate is to be renewed, in milliseconds since 1970.
fn renewal_time(certificate: &CertificateDer<'_>) -> Option<u64> {
    let period = authority::read_validity(certificate).ok()?;
    Some(period.from + period.until.saturating_sub(period.from) / 3 * 2)
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair, date_time_ymd};

    use super::*;

    const NAME: &str = "robots.lab.example";

    /// Writes a certificate for a name and a range of years to a directory.
    fn write_certificate(directory: &Path, name: &str, years: (i32, i32)) {
        let mut params = CertificateParams::new([name.to_owned()]).expect("a name");
        params.not_before = date_time_ymd(years.0, 1, 1);
        params.not_after = date_time_ymd(years.1, 1, 1);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("a certificate");
        let text = certificate.pem() + &key.serialize_pem();
        private::write_atomically(&directory.join(CERTIFICATE), text.as_bytes()).expect("kept");
    }

    fn acme() -> config::AcmeConfig {
        config::AcmeConfig { names: vec![NAME.to_owned()], ..config::AcmeConfig::default() }
    }

    #[test]
    fn what_is_kept_is_shown_while_it_is_good() {
        let home = tempfile::tempdir().expect("a directory");
        let shown = || load_certificate(&acme(), home.path()).is_some();
        assert!(!shown(), "there is none");
        write_certificate(home.path(), NAME, (2000, 2100));
        assert!(shown());
        write_certificate(home.path(), NAME, (2000, 2001));
        assert!(!shown(), "it has ended");
        write_certificate(home.path(), "other.lab.example", (2000, 2100));
        assert!(!shown(), "of another name");
        std::fs::write(home.path().join(CERTIFICATE), "half").expect("written");
        assert!(!shown(), "no certificate");
    }

    #[test]
    fn it_is_renewed_when_two_thirds_of_its_time_are_over() {
        let home = tempfile::tempdir().expect("a directory");
        write_certificate(home.path(), NAME, (2000, 2003));
        let pair = read_chain_and_key(&home.path().join(CERTIFICATE), &home.path().join(CERTIFICATE)).expect("a pair");
        let due = renewal_time(pair.0.first().expect("a certificate")).expect("a time");
        let year = 365 * 86_400_000;
        let begin = 946_684_800_000;
        // One of the three years has a day more; the last second belongs to the period.
        let expected = begin + 2 * year + 86_400_000 * 2 / 3;
        assert!(due.abs_diff(expected) <= 1_000, "{due} {expected}");
    }
}
