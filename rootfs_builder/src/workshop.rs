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
use crate::event::Progress;
use crate::sandbox::Site;

/// Lives as long as one build.
pub(crate) struct Workshop {
    pub(crate) site: Site,
    pub(crate) layers: Layers,
    turns: Turns,
    push: Push,
    progress: Progress,
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
    pub(crate) fn new(
        site: Site,
        layers: Layers,
        turns: Turns,
        push: Push,
        progress: Progress,
    ) -> Self {
        Self {
            site,
            layers,
            turns,
            push,
            progress,
            packing: Mutex::default(),
        }
    }

    /// Waits for the turn at a key, of a layer or of what is remembered; while another push has it, that is told.
    pub(crate) async fn turn(&self, key: &str) -> tokio::sync::OwnedMutexGuard<()> {
        self.turns.take(key, &self.push, &self.progress).await
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

/// A push, as others are told of it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Push {
    /// Of the push: see [`crate::PushRequest::id`].
    pub(crate) id: String,
    /// Of the service, or of the package that becomes one.
    pub(crate) name: String,
}

/// One at a time per key: two pushes that need the same layer make it once.
#[derive(Clone, Default)]
pub(crate) struct Turns(Arc<Mutex<HashMap<String, Arc<Turn>>>>);

#[derive(Default)]
struct Turn {
    taken: Arc<tokio::sync::Mutex<()>>,
    /// Who had it last.
    by: Mutex<Push>,
}

impl Turns {
    /// Waits for the turn; it ends when the guard is dropped. `progress` is told whom it waits for.
    async fn take(
        &self,
        key: &str,
        push: &Push,
        progress: &Progress,
    ) -> tokio::sync::OwnedMutexGuard<()> {
        let turn = {
            let mut all = locked(&self.0);
            // The guard of a turn holds the lock alone.
            all.retain(|_, turn| Arc::strong_count(turn) > 1 || Arc::strong_count(&turn.taken) > 1);
            Arc::clone(all.entry(key.to_owned()).or_default())
        };
        let guard = match Arc::clone(&turn.taken).try_lock_owned() {
            Ok(guard) => guard,
            Err(_) => {
                let by = locked(&turn.by).clone();
                // The layers of one push are not told to wait for each other.
                if by.id != push.id {
                    progress.waits(by.name).await;
                }
                Arc::clone(&turn.taken).lock_owned().await
            }
        };
        locked(&turn.by).clone_from(push);
        guard
    }
}

fn locked<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use crate::event::BuildEvent;

    use super::*;

    fn push(name: &str) -> Push {
        Push {
            id: format!("push-{name}"),
            name: name.to_owned(),
        }
    }

    #[tokio::test]
    async fn turns_are_per_key_and_who_waits_is_told_for_whom() {
        let turns = Turns::default();
        let (sender, mut told) = tokio::sync::mpsc::channel(8);
        let progress = Progress::new(sender);
        let (lab, field) = (push("lab"), push("field"));
        let first = turns.take("a", &lab, &progress).await;
        let _other = turns.take("b", &field, &progress).await;
        let (again, by, telling) = (turns.clone(), field.clone(), progress.clone());
        let waiting = tokio::spawn(async move { again.take("a", &by, &telling).await });
        let waits = BuildEvent::Waits {
            push: "lab".to_owned(),
        };
        assert_eq!(told.recv().await, Some(waits));
        assert!(!waiting.is_finished());
        drop(first);
        let second = waiting.await.expect("it comes");
        // Its own layers wait in silence.
        let (again, by, telling) = (turns.clone(), field, progress.clone());
        let own = tokio::spawn(async move { again.take("a", &by, &telling).await });
        tokio::task::yield_now().await;
        drop(second);
        own.await.expect("it comes");
        assert!(told.try_recv().is_err());
        // Turns that nobody has are forgotten; that of `b` is kept.
        drop(turns.take("c", &lab, &progress).await);
        drop(turns.take("d", &lab, &progress).await);
        let kept: Vec<String> = locked(&turns.0).keys().cloned().collect();
        assert!(
            kept.contains(&"b".to_owned()) && !kept.contains(&"c".to_owned()),
            "{kept:?}"
        );
    }
}
