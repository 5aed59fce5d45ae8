//! What every step of a build needs: the place to work in, the layers there are, and turns at making new ones.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError};

use image::LayerInfo;

use crate::cache::{Entry, Layers};
use crate::error::Error;
use crate::sandbox::Site;

/// Lives as long as one build.
pub(crate) struct Workshop {
    pub(crate) site: Site,
    pub(crate) layers: Layers,
    pub(crate) turns: Turns,
}

impl Workshop {
    /// The cached layer of a key.
    pub(crate) async fn cached(&self, key: &str) -> Result<Option<Entry>, Error> {
        let (layers, key) = (self.layers.clone(), key.to_owned());
        crate::blocking::spawn(move || layers.get(&key)).await?
    }

    /// Keeps a layer under a key.
    pub(crate) async fn keep(&self, key: &str, entry: Entry) -> Result<(), Error> {
        let (layers, key) = (self.layers.clone(), key.to_owned());
        crate::blocking::spawn(move || layers.put(&key, &entry)).await?
    }

    /// Trees of these layers.
    pub(crate) async fn extracted(&self, layers: &[LayerInfo]) -> Result<Vec<PathBuf>, Error> {
        let (store, layers) = (self.layers.store().clone(), layers.to_vec());
        crate::blocking::spawn(move || {
            layers
                .iter()
                .map(|layer| Ok(store.extracted(&layer.diff_id)?))
                .collect()
        })
        .await?
    }
}

/// One at a time per key: two pushes that need the same layer make it once.
#[derive(Clone, Default)]
pub(crate) struct Turns(Arc<std::sync::Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>>);

impl Turns {
    /// Waits for the turn; it ends when the guard is dropped.
    pub(crate) async fn take(&self, key: &str) -> tokio::sync::OwnedMutexGuard<()> {
        let mutex = {
            let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            all.retain(|_, mutex| Arc::strong_count(mutex) > 1);
            all.entry(key.to_owned()).or_default().clone()
        };
        mutex.lock_owned().await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn turns_are_per_key() {
        let turns = Turns::default();
        let first = turns.take("a").await;
        let _other = turns.take("b").await;
        let again = turns.clone();
        let waiting = tokio::spawn(async move { again.take("a").await });
        tokio::task::yield_now().await;
        assert!(!waiting.is_finished());
        drop(first);
        waiting.await.expect("it comes");
    }
}
