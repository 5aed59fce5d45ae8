//! The operator's certificate and revocation lists, reloaded when their files change.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use portal::App;
use store::{Journal, NewEvent};

use super::{Error, load_revocation_lists, read_chain_and_key};

/// Interval between looks at the files.
const LOOK: Duration = Duration::from_secs(1);

/// Version of a file: its device, inode, size and modification time.
#[derive(Debug, Clone, PartialEq, Eq)]
struct FileVersion(Option<(u64, u64, u64, i64, i64)>);

impl FileVersion {
    fn stat(path: &Path) -> FileVersion {
        let about = std::fs::metadata(path).ok();
        FileVersion(about.map(|about| {
            let (at, fraction) = (about.mtime(), about.mtime_nsec());
            (about.dev(), about.ino(), about.size(), at, fraction)
        }))
    }
}

/// Files that are loaded together.
struct WatchedFiles {
    paths: Vec<PathBuf>,
    /// Versions at the last load, and at the last look.
    read: Vec<FileVersion>,
    before: Vec<FileVersion>,
}

impl WatchedFiles {
    fn new(paths: Vec<PathBuf>) -> WatchedFiles {
        let now = versions(&paths);
        WatchedFiles { paths, read: now.clone(), before: now }
    }

    /// Returns when the files have changed and have then stayed the same for one interval: they are not written
    /// atomically.
    async fn wait_for_change(&mut self) {
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

fn versions(paths: &[PathBuf]) -> Vec<FileVersion> {
    paths.iter().map(|path| FileVersion::stat(path)).collect()
}

/// Reloads the operator's certificate whenever its files have changed. A certificate that cannot be used is reported in
/// an event, and the previous one stays in use.
pub async fn watch_certificate(app: Arc<App>, certificate: PathBuf, key: PathBuf) {
    let Some(tls) = &app.tls else { return };
    let journal = Journal::new(Arc::clone(&app.state));
    let mut files = WatchedFiles::new(vec![certificate.clone(), key.clone()]);
    loop {
        files.wait_for_change().await;
        let shown = read_chain_and_key(&certificate, &key).and_then(|(chain, key)| {
            tls.replace_certificate(chain, key).map_err(|source| Error::Unusable { path: certificate.clone(), source })
        });
        let about = NewEvent::default();
        match shown {
            Ok(()) => {
                let message = format!("the portal now uses another certificate: {}", tls.fingerprint());
                journal.info("certificate-shown", &message, &about);
            }
            Err(error) => {
                let message = format!("{error}; the portal still uses the previous certificate: {}", tls.fingerprint());
                journal.warning("certificate-refused", &message, &about);
            }
        }
    }
}

/// Reloads the revocation lists of the lab's own authorities whenever their file has changed. If it cannot be read, an
/// event is written and the previous lists stay in force.
pub async fn watch_revocation_lists(app: Arc<App>, path: PathBuf) {
    let Some(tls) = &app.tls else { return };
    let journal = Journal::new(Arc::clone(&app.state));
    let mut files = WatchedFiles::new(vec![path.clone()]);
    loop {
        files.wait_for_change().await;
        let about = NewEvent::default();
        match load_revocation_lists(tls, &path) {
            Ok(()) => {
                let message = format!("revocation lists reloaded: {}", path.display());
                journal.info("revocations-read", &message, &about);
            }
            Err(error) => {
                let message = format!("{error}; the previous lists stay in force");
                journal.warning("revocations-refused", &message, &about);
            }
        }
    }
}
