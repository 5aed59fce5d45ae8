//! A certificate of an authority that is asked by ACME (RFC 8555): kept in the home, and renewed when two thirds of its time are over.

mod account;
mod order;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use portal::{App, TlsError};
use store::{Journal, NewEvent, private};
use tokio::net::TcpListener;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;

use super::{DIRECTORY, Pair, read};
use crate::config;
use crate::home::Home;

/// The certificate with those that lead to the authority, and its key.
const CERTIFICATE: &str = "acme.pem";
/// The clock is looked at so often: it may be set, and the machine may have slept.
const LOOK: Duration = Duration::from_secs(3600);
/// The longest time between two attempts.
const LONGEST_RETRY: Duration = Duration::from_secs(6 * 3600);

/// What the home has, with the path of its file: a certificate that is good now, and for all names.
pub fn kept(acme: &config::Acme, directory: &Path) -> Option<(PathBuf, Pair)> {
    let path = directory.join(CERTIFICATE);
    if !path.exists() {
        return None;
    }
    let pair = match read(&path, &path) {
        Ok(pair) => pair,
        Err(error) => {
            tracing::warn!("{error}; another certificate is asked for");
            return None;
        }
    };
    let certificate = pair.0.first()?;
    let good = authority::period(certificate).is_ok_and(|period| store::now() < period.until);
    (good && is_for_all(certificate, &acme.names)).then_some((path, pair))
}

fn is_for_all(certificate: &CertificateDer<'_>, names: &[String]) -> bool {
    names.iter().all(|name| tls::speaks_for(certificate, name))
}

/// Listens where the authority looks, if that is not the portal's own port.
pub async fn listen_for_challenges(
    acme: Option<&config::Acme>,
) -> anyhow::Result<Option<TcpListener>> {
    let Some(address) = acme.and_then(|acme| acme.challenge_listen) else {
        return Ok(None);
    };
    let listener = TcpListener::bind(address).await.with_context(|| {
        format!("cannot listen on {address}, which is challenge_listen in [tls.acme]")
    })?;
    Ok(Some(listener))
}

/// Keeps the certificate good.
pub struct Renewal {
    app: Arc<App>,
    acme: config::Acme,
    directory: PathBuf,
    looked_at: SocketAddr,
}

impl Renewal {
    /// For a daemon that listens at `listen`.
    pub fn new(app: Arc<App>, acme: config::Acme, home: &Home, listen: SocketAddr) -> Renewal {
        let looked_at = acme.challenge_listen.unwrap_or(listen);
        Renewal {
            app,
            acme,
            directory: home.path().join(DIRECTORY),
            looked_at,
        }
    }

    /// Asks for a certificate whenever one is due, until the daemon ends.
    pub async fn keep(self) {
        let journal = Journal::new(Arc::clone(&self.app.state));
        let about = NewEvent::default();
        loop {
            self.until_due().await;
            let mut pause = self.acme.retry.0;
            while let Err(error) = self.renew().await {
                let fingerprint = self.app.tls.as_ref().map(|tls| tls.fingerprint());
                let shown = fingerprint.map_or_else(String::new, |print| print.to_string());
                let message = format!(
                    "{} was asked for a certificate of {}, and there is none: {error:#}; it is asked again in {} s, and {shown} is \
                     shown until then",
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
                    "the portal shows a certificate for {} that {} has signed: {}",
                    self.acme.names.join(", "),
                    self.acme.directory,
                    tls.fingerprint()
                );
                journal.info("certificate-shown", &message, &about);
            }
        }
    }

    /// Waits until two thirds of the certificate's time are over. Where there is none, or one for other names, that is now.
    async fn until_due(&self) {
        loop {
            let (acme, directory) = (self.acme.clone(), self.directory.clone());
            let kept = privilege::run(async move { kept(&acme, &directory) }).await;
            let due = kept.and_then(|(_, (chain, _))| due(chain.first()?));
            let left = due.unwrap_or(0).saturating_sub(store::now());
            if left == 0 {
                return;
            }
            tokio::time::sleep(LOOK.min(Duration::from_millis(left))).await;
        }
    }

    async fn renew(&self) -> anyhow::Result<()> {
        let Some(tls) = &self.app.tls else {
            bail!("no TLS is spoken");
        };
        let account = account::of_home(&self.acme, &self.directory).await?;
        let made = order::certificate(&account, &self.acme.names, tls, self.looked_at).await;
        // Nobody looks any more.
        tls.answer(Vec::new()).map_err(said)?;
        if made.as_ref().is_err_and(account::is_unknown) {
            account::forget(&self.directory).await?;
        }
        let made = made?;
        let path = self.directory.join(CERTIFICATE);
        let text = format!("{}\n{}", made.chain.trim_end(), made.key);
        let keep = path.clone();
        let (chain, key) = privilege::run(async move {
            let first = CertificateDer::from_pem_slice(text.as_bytes())
                .context("the authority's answer is no certificate")?;
            authority::period(&first).map_err(anyhow::Error::msg)?;
            private::replace(&keep, text.as_bytes())
                .with_context(|| format!("cannot keep it in {}", keep.display()))?;
            Ok::<Pair, anyhow::Error>(read(&keep, &keep)?)
        })
        .await?;
        if let Some(first) = chain.first()
            && !is_for_all(first, &self.acme.names)
        {
            bail!("the authority has signed a certificate for other names");
        }
        tls.show(chain, key).map_err(said)
    }
}

/// Its words have those of its cause.
fn said(error: TlsError) -> anyhow::Error {
    anyhow::Error::msg(error.to_string())
}

/// When a certificate is to be renewed, in milliseconds since 1970.
fn due(certificate: &CertificateDer<'_>) -> Option<u64> {
    let period = authority::period(certificate).ok()?;
    Some(period.from + period.until.saturating_sub(period.from) / 3 * 2)
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair, date_time_ymd};

    use super::*;

    const NAME: &str = "robots.lab.example";

    /// Keeps a certificate for a name and some years in a directory.
    fn keep(directory: &Path, name: &str, years: (i32, i32)) {
        let mut params = CertificateParams::new([name.to_owned()]).expect("a name");
        params.not_before = date_time_ymd(years.0, 1, 1);
        params.not_after = date_time_ymd(years.1, 1, 1);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("a certificate");
        let text = certificate.pem() + &key.serialize_pem();
        private::replace(&directory.join(CERTIFICATE), text.as_bytes()).expect("kept");
    }

    fn acme() -> config::Acme {
        config::Acme {
            names: vec![NAME.to_owned()],
            ..config::Acme::default()
        }
    }

    #[test]
    fn what_is_kept_is_shown_while_it_is_good() {
        let home = tempfile::tempdir().expect("a directory");
        let shown = || kept(&acme(), home.path()).is_some();
        assert!(!shown(), "there is none");
        keep(home.path(), NAME, (2000, 2100));
        assert!(shown());
        keep(home.path(), NAME, (2000, 2001));
        assert!(!shown(), "it has ended");
        keep(home.path(), "other.lab.example", (2000, 2100));
        assert!(!shown(), "of another name");
        std::fs::write(home.path().join(CERTIFICATE), "half").expect("written");
        assert!(!shown(), "no certificate");
    }

    #[test]
    fn it_is_renewed_when_two_thirds_of_its_time_are_over() {
        let home = tempfile::tempdir().expect("a directory");
        keep(home.path(), NAME, (2000, 2003));
        let pair = read(
            &home.path().join(CERTIFICATE),
            &home.path().join(CERTIFICATE),
        )
        .expect("a pair");
        let due = due(pair.0.first().expect("a certificate")).expect("a time");
        let year = 365 * 86_400_000;
        let begin = 946_684_800_000;
        // One of the three has a day more; the last second is part of it.
        let expected = begin + 2 * year + 86_400_000 * 2 / 3;
        assert!(due.abs_diff(expected) <= 1_000, "{due} {expected}");
    }
}
