//! Removal of build directories, after their containers have ended, in the background because a large tree takes long.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::task::JoinHandle;

/// Directories being removed, by the id of their build.
#[derive(Clone, Default)]
pub(crate) struct PendingRemovals(Arc<Mutex<HashMap<String, JoinHandle<()>>>>);

impl PendingRemovals {
    /// Starts to remove `directory` when `containers` have ended.
    pub(crate) fn start(&self, id: String, containers: Vec<JoinHandle<()>>, directory: PathBuf) {
        let Ok(runtime) = tokio::runtime::Handle::try_current() else {
            return remove(&directory);
        };
        let removal = runtime.spawn(async move {
            for container in containers {
                let _ = container.await;
            }
            // Not as part of the build, since its cancellation is the reason for this.
            let _ = tokio::task::spawn_blocking(move || remove(&directory)).await;
        });
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.retain(|_, removal| !removal.is_finished());
        all.insert(id, removal);
    }

    /// Waits until nothing of this build is being removed.
    pub(crate) async fn wait(&self, id: &str) {
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
