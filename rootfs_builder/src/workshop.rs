//! Shared context of the steps of a build: the work directory, the layer cache, and locks on keys.
//!
//! A new layer is created in two stages: first its extracted tree, which the next step can use at once; then,
//! concurrently, the compressed archive for the image and the cache. Both are completed even if the build is cancelled
//! meanwhile: the next push of the same sources goes on from there.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use image::{Digest, TreeOptions};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use crate::cache::{LayerCache, LayerEntry};
use crate::error::Error;
use crate::event::Progress;
use crate::sandbox::BuildSite;

/// Context of a single build.
pub(crate) struct BuildContext {
    pub(crate) site: BuildSite,
    pub(crate) layers: LayerCache,
    turns: KeyLocks,
    push: PushLabel,
    progress: Progress,
    /// Archives in progress.
    packing: Mutex<Vec<JoinHandle<Result<(), Error>>>>,
}

/// A layer whose extracted tree exists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StagedLayer {
    pub(crate) diff_id: Digest,
    /// True if the layer already existed.
    pub(crate) cached: bool,
}

/// A tree to be packed into a cached layer.
pub(crate) struct PackJob {
    /// Cache key.
    pub(crate) key: String,
    /// Human-readable list of the inputs.
    pub(crate) made_from: Vec<String>,
    pub(crate) tree: PathBuf,
    pub(crate) options: TreeOptions,
    /// Directory of the tree, removed at the end.
    pub(crate) directory: PathBuf,
    /// Lock on the key; others wait until the layer is in the cache.
    pub(crate) turn: tokio::sync::OwnedMutexGuard<()>,
}

impl BuildContext {
    pub(crate) fn new(
        site: BuildSite,
        layers: LayerCache,
        turns: KeyLocks,
        push: PushLabel,
        progress: Progress,
    ) -> Self {
        Self { site, layers, turns, push, progress, packing: Mutex::default() }
    }

    /// Waits for the lock on a key of a layer or a note; reports when another push holds it.
    pub(crate) async fn lock_key(&self, key: &str) -> tokio::sync::OwnedMutexGuard<()> {
        self.turns.lock(key, &self.push, &self.progress).await
    }

    /// Creates a layer's tree; the archive follows (see [`BuildContext::wait_until_packed`]). `record` is called with
    /// the size of the layer when it is in the cache.
    pub(crate) async fn pack(
        &self,
        packing: PackJob,
        record: impl FnOnce(u64) -> Result<(), Error> + Send + 'static,
    ) -> Result<Digest, Error> {
        let (stage, staged) = oneshot::channel();
        let layers = self.layers.clone();
        let work = move || -> Result<(), Error> {
            // Of its own: that of the build ends with it.
            let _hold = layers.store().hold()?;
            let (diff_id, bytes) = layers.store().stage_tree(&packing.tree, &packing.options)?;
            // Nobody listens any more if the build was cancelled.
            let _ = stage.send(diff_id);
            let layer = layers.store().layer_from_tree(&packing.tree, &packing.options)?;
            if layer.diff_id != diff_id {
                return Err(
                    image::Error::Damaged { path: packing.tree, expected: diff_id, found: layer.diff_id }.into()
                );
            }
            layers.insert(&packing.key, &LayerEntry { layer: Some(layer), made_from: packing.made_from })?;
            record(bytes)?;
            drop(packing.turn);
            Ok(foreign::remove(&packing.directory)?)
        };
        // Before anything is awaited, since the build may be cancelled at any await.
        let archive = crate::blocking::spawn_until(self.layers.packings().begin(self.site.id()), work);
        self.packing.lock().unwrap_or_else(PoisonError::into_inner).push(archive);
        match staged.await {
            Ok(diff_id) => Ok(diff_id),
            Err(_) => {
                self.wait_until_packed().await?;
                Err(Error::NotPacked)
            }
        }
    }

    /// Returns whether archives are still in progress.
    pub(crate) fn is_packing(&self) -> bool {
        let packing = self.packing.lock().unwrap_or_else(PoisonError::into_inner);
        packing.iter().any(|archive| !archive.is_finished())
    }

    /// Waits until all packed layers are complete and in the cache.
    pub(crate) async fn wait_until_packed(&self) -> Result<(), Error> {
        let packing = std::mem::take(&mut *self.packing.lock().unwrap_or_else(PoisonError::into_inner));
        let mut result = Ok(());
        for archive in packing {
            let done = archive.await.unwrap_or_else(|error| Err(error.into()));
            result = result.and(done);
        }
        result
    }

    /// Returns the cached layer of a key.
    pub(crate) async fn get_cached(&self, key: &str) -> Result<Option<LayerEntry>, Error> {
        let (layers, key) = (self.layers.clone(), key.to_owned());
        crate::blocking::spawn(move || layers.get(&key)).await?
    }

    /// Stores a layer under a key.
    pub(crate) async fn put_cached(&self, key: &str, entry: LayerEntry) -> Result<(), Error> {
        let (layers, key) = (self.layers.clone(), key.to_owned());
        crate::blocking::spawn(move || layers.insert(&key, &entry)).await?
    }

    /// Extracts layers and returns their trees.
    pub(crate) async fn extract_layers(&self, layers: &[Digest]) -> Result<Vec<PathBuf>, Error> {
        let (store, layers) = (self.layers.store().clone(), layers.to_vec());
        crate::blocking::spawn(move || layers.iter().map(|layer| Ok(store.ensure_extracted(layer)?)).collect()).await?
    }
}

impl Drop for BuildContext {
    fn drop(&mut self) {
        let packing = std::mem::take(&mut *self.packing.lock().unwrap_or_else(PoisonError::into_inner));
        self.site.keep_while(packing);
    }
}

/// A push, as reported to others.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct PushLabel {
    /// Id of the push; see [`crate::PushRequest::id`].
    pub(crate) id: String,
    /// Name of the service, or of the package that becomes one.
    pub(crate) name: String,
}

/// Locks by key, so that two pushes that need the same layer create it once.
#[derive(Clone, Default)]
pub(crate) struct KeyLocks(Arc<Mutex<HashMap<String, Arc<KeyLock>>>>);

#[derive(Default)]
struct KeyLock {
    taken: Arc<tokio::sync::Mutex<()>>,
    /// Last holder of the lock.
    by: Mutex<PushLabel>,
}

impl KeyLocks {
    /// Waits for a lock, which is released when the guard is dropped. `progress` receives the name of the lock holder.
    pub(crate) async fn lock(
        &self,
        key: &str,
        push: &PushLabel,
        progress: &Progress,
    ) -> tokio::sync::OwnedMutexGuard<()> {
        let turn = {
            let mut all = lock_unpoisoned(&self.0);
            // The guard of a lock holds only the inner mutex.
            all.retain(|_, turn| Arc::strong_count(turn) > 1 || Arc::strong_count(&turn.taken) > 1);
            Arc::clone(all.entry(key.to_owned()).or_default())
        };
        let guard = match Arc::clone(&turn.taken).try_lock_owned() {
            Ok(guard) => guard,
            Err(_) => {
                let by = lock_unpoisoned(&turn.by).clone();
                // Layers of one push waiting for each other are not reported.
                let is_anothers = by.id != push.id;
                if is_anothers {
                    progress.waits(by.id, by.name).await;
                }
                let guard = Arc::clone(&turn.taken).lock_owned().await;
                if is_anothers {
                    progress.continues().await;
                }
                guard
            }
        };
        lock_unpoisoned(&turn.by).clone_from(push);
        guard
    }
}

fn lock_unpoisoned<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;
    use crate::builder::Builder;
    use crate::builder::tests::{new_builder, new_context};
    use crate::event::BuildEvent;

    fn push(name: &str) -> PushLabel {
        PushLabel { id: format!("push-{name}"), name: name.to_owned() }
    }

    /// Begins to pack a compiled package under a key while nothing can be packed, and cancels the build meanwhile.
    async fn cancel_while_packing(builder: &Builder, id: &str, key: &str) {
        let context = new_context(builder, id);
        let directory = context.site.fresh_directory("compile").expect("made");
        let tree = directory.join("tree");
        std::fs::create_dir(&tree).expect("made");
        std::fs::write(tree.join("node"), key).expect("written");
        let store = File::open(context.layers.store().layers_dir()).expect("a store");
        rustix::fs::flock(&store, rustix::fs::FlockOperation::NonBlockingLockExclusive).expect("free");
        let packing = PackJob {
            key: key.to_owned(),
            made_from: Vec::new(),
            tree,
            options: TreeOptions::default(),
            directory,
            turn: context.lock_key(key).await,
        };
        let mut building = Box::pin(crate::blocking::cancellable(context.pack(packing, |_| Ok(()))));
        tokio::select! {
            biased;
            // Packing that is given up may have ended already.
            packed = &mut building => assert!(packed.is_err(), "the store is locked: {packed:?}"),
            () = std::future::ready(()) => {}
        }
        drop(building);
        drop(context);
    }

    #[tokio::test]
    async fn what_a_cancelled_build_has_compiled_is_kept() {
        let place = tempfile::tempdir().expect("a directory");
        let builder = new_builder(place.path());
        cancel_while_packing(&builder, "b1", "compiled").await;
        builder.wait_removed("b1").await;
        assert!(builder.layers().contains("compiled"));
        let next = new_context(&builder, "b2");
        drop(next.lock_key("compiled").await);
        assert!(next.get_cached("compiled").await.expect("read").is_some());
        assert!(!place.path().join("build/b1").exists());
        // The daemon does not wait for it.
        builder.stop_packing();
        cancel_while_packing(&builder, "b3", "given-up").await;
        builder.wait_removed("b3").await;
        assert!(!builder.layers().contains("given-up"));
        assert!(!place.path().join("build/b3").exists());
    }

    #[tokio::test]
    async fn turns_are_per_key_and_who_waits_is_told_for_whom() {
        let turns = KeyLocks::default();
        let (sender, mut told) = tokio::sync::mpsc::channel(8);
        let progress = Progress::new(sender);
        let (lab, field) = (push("lab"), push("field"));
        let first = turns.lock("a", &lab, &progress).await;
        let _other = turns.lock("b", &field, &progress).await;
        let (again, by, telling) = (turns.clone(), field.clone(), progress.clone());
        let waiting = tokio::spawn(async move { again.lock("a", &by, &telling).await });
        let waits = BuildEvent::Waits { id: lab.id.clone(), push: "lab".to_owned() };
        assert_eq!(told.recv().await, Some(waits));
        assert!(!waiting.is_finished());
        drop(first);
        let second = waiting.await.expect("it comes");
        assert_eq!(told.recv().await, Some(BuildEvent::Continues));
        // Its own layers wait without a report.
        let (again, by, telling) = (turns.clone(), field, progress.clone());
        let own = tokio::spawn(async move { again.lock("a", &by, &telling).await });
        tokio::task::yield_now().await;
        drop(second);
        own.await.expect("it comes");
        assert!(told.try_recv().is_err());
        // Locks that nobody holds are removed; that of `b` is kept.
        drop(turns.lock("c", &lab, &progress).await);
        drop(turns.lock("d", &lab, &progress).await);
        let kept: Vec<String> = lock_unpoisoned(&turns.0).keys().cloned().collect();
        assert!(kept.contains(&"b".to_owned()) && !kept.contains(&"c".to_owned()), "{kept:?}");
    }
}
