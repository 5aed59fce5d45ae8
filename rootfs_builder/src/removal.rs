//! The end of a build's directory: when its containers have ended, and in the background, because a big tree takes long.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::task::JoinHandle;

/// Directories that are being removed, by the id of their build.
#[derive(Clone, Default)]
pub(crate) struct Removals(Arc<Mutex<HashMap<String, JoinHandle<()>>>>);

impl Removals {
    /// Removes `directory` after `containers` have ended.
    pub(crate) fn start(&self, id: String, containers: Vec<JoinHandle<()>>, directory: PathBuf) {
        let Ok(runtime) = tokio::runtime::Handle::try_current() else {
            return remove(&directory);
        };
        let removal = runtime.spawn(async move {
            for container in containers {
                let _ = container.await;
            }
            // Not as a part of the build: that it was cancelled is the reason for this.
            let _ = tokio::task::spawn_blocking(move || remove(&directory)).await;
        });
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.retain(|_, removal| !removal.is_finished());
        all.insert(id, removal);
    }

    /// Comes back when nothing is being removed of this build.
    pub(crate) async fn done(&self, id: &str) {
        let removal = {
            let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            all.remove(id)
        };
        if let Some(removal) = removal {
            let _ = removal.await;
        }
    }
}

fn remove(directory: &Path) {
    if let Err(error) = foreign::remove(directory) {
        tracing::warn!(path = %directory.display(), %error, "a build's directory could not be removed");
    }
}
