//! What every step of a build needs: the place to work in, the layers there are, and turns at making new ones.
//!
//! A new layer is made in two halves. First its extracted tree, on which the next step can stand at once; then, while
//! that runs, the compressed archive for the image and the cache.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use image::{Digest, TreeOptions};
use tokio::task::JoinHandle;

use crate::cache::{Entry, Layers};
use crate::error::Error;
use crate::sandbox::Site;

/// Lives as long as one build.
pub(crate) struct Workshop {
    pub(crate) site: Site,
    pub(crate) layers: Layers,
    pub(crate) turns: Turns,
    /// Archives that are being made.
    packing: Mutex<Vec<JoinHandle<Result<(), Error>>>>,
}

/// A layer whose tree is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layer {
    pub(crate) diff_id: Digest,
    /// It was there already.
    pub(crate) cached: bool,
}

/// A tree that becomes a layer in the cache.
pub(crate) struct Packing {
    /// Its key there.
    pub(crate) key: String,
    /// For people.
    pub(crate) made_from: Vec<String>,
    pub(crate) tree: PathBuf,
    pub(crate) options: TreeOptions,
    /// Removed when all is done: the tree's own directory.
    pub(crate) directory: PathBuf,
    /// The turn at this key; others wait until the layer is in the cache.
    pub(crate) turn: tokio::sync::OwnedMutexGuard<()>,
}

impl Workshop {
    pub(crate) fn new(site: Site, layers: Layers, turns: Turns) -> Self {
        Self {
            site,
            layers,
            turns,
            packing: Mutex::default(),
        }
    }

    /// Makes a layer's tree; the archive follows (see [`Workshop::settled`]). `record` is called with the bytes of
    /// the layer when it is in the cache.
    pub(crate) async fn pack(
        &self,
        packing: Packing,
        record: impl FnOnce(u64) -> Result<(), Error> + Send + 'static,
    ) -> Result<Digest, Error> {
        let store = self.layers.store().clone();
        let (tree, options) = (packing.tree.clone(), packing.options.clone());
        let (diff_id, bytes) =
            crate::blocking::spawn(move || store.stage_tree(&tree, &options)).await??;
        let layers = self.layers.clone();
        let archive = crate::blocking::spawn(move || -> Result<_, Error> {
            let layer = layers
                .store()
                .layer_from_tree(&packing.tree, &packing.options)?;
            if layer.diff_id != diff_id {
                return Err(image::Error::Damaged {
                    path: packing.tree,
                    expected: diff_id,
                    found: layer.diff_id,
                }
                .into());
            }
            layers.put(
                &packing.key,
                &Entry {
                    layer: Some(layer),
                    made_from: packing.made_from,
                },
            )?;
            record(bytes)?;
            drop(packing.turn);
            Ok(foreign::remove(&packing.directory)?)
        });
        self.packing
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(archive);
        Ok(diff_id)
    }

    /// Whether archives are still being made.
    pub(crate) fn is_packing(&self) -> bool {
        let packing = self.packing.lock().unwrap_or_else(PoisonError::into_inner);
        packing.iter().any(|archive| !archive.is_finished())
    }

    /// Waits until every layer that was packed is whole and in the cache.
    pub(crate) async fn settled(&self) -> Result<(), Error> {
        let packing =
            std::mem::take(&mut *self.packing.lock().unwrap_or_else(PoisonError::into_inner));
        let mut result = Ok(());
        for archive in packing {
            let done = archive.await.unwrap_or_else(|error| Err(error.into()));
            result = result.and(done);
        }
        result
    }

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
    pub(crate) async fn extracted(&self, layers: &[Digest]) -> Result<Vec<PathBuf>, Error> {
        let (store, layers) = (self.layers.store().clone(), layers.to_vec());
        crate::blocking::spawn(move || {
            layers
                .iter()
                .map(|layer| Ok(store.extracted(layer)?))
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
