//! The operator's certificate: read again when its files change.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use portal::App;
use store::{Journal, NewEvent};

use super::{Error, read};

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
