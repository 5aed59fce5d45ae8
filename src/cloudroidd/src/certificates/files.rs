//! The operator's certificate and revocation lists: read again when their files change.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use portal::App;
use store::{Journal, NewEvent};

use super::{Error, read, revoke};

/// How often it is looked whether the files are others.
const LOOK: Duration = Duration::from_secs(1);

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

/// Files that belong together.
struct Files {
    paths: Vec<PathBuf>,
    /// As they were when they were read last, and at the last look.
    read: Vec<Version>,
    before: Vec<Version>,
}

impl Files {
    fn new(paths: Vec<PathBuf>) -> Files {
        let now = versions(&paths);
        Files {
            paths,
            read: now.clone(),
            before: now,
        }
    }

    /// Comes back when they have changed, and have then been the same for a while, because they are not written at once.
    async fn changed(&mut self) {
        loop {
            tokio::time::sleep(LOOK).await;
            let now = versions(&self.paths);
            let before = std::mem::replace(&mut self.before, now.clone());
            if now != self.read && now == before {
                self.read = now;
                return;
            }
        }
    }
}

fn versions(paths: &[PathBuf]) -> Vec<Version> {
    paths.iter().map(|path| Version::of(path)).collect()
}

/// Shows the operator's certificate anew whenever its files have changed. What cannot be used is told of, and the one before goes on
/// being shown.
pub async fn keep(app: Arc<App>, certificate: PathBuf, key: PathBuf) {
    let Some(tls) = &app.tls else { return };
    let journal = Journal::new(Arc::clone(&app.state));
    let mut files = Files::new(vec![certificate.clone(), key.clone()]);
    loop {
        files.changed().await;
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

/// Reads the revocation lists of the lab's own authorities whenever their file has changed. Where it cannot be read, what it named before is
/// refused on, and that is told.
pub async fn keep_lists(app: Arc<App>, path: PathBuf) {
    let Some(tls) = &app.tls else { return };
    let journal = Journal::new(Arc::clone(&app.state));
    let mut files = Files::new(vec![path.clone()]);
    loop {
        files.changed().await;
        let about = NewEvent::default();
        match revoke(tls, &path) {
            Ok(()) => {
                let message = format!("revocation lists were read again: {}", path.display());
                journal.info("revocations-read", &message, &about);
            }
            Err(error) => {
                let message = format!("{error}; the lists before count on");
                journal.warning("revocations-refused", &message, &about);
            }
        }
    }
}
