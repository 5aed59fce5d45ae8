//! What a push has started, and the room that it takes until nothing of it is left.

use std::sync::Arc;

use choreographer::Permit;
use servant::engine::Servant;
use tokio::sync::mpsc;
use tokio_util::task::TaskTracker;

use crate::Error;

/// Held by whatever is there of what was started in a room. With the last one the room is given back.
pub(crate) struct Alive<R = Permit> {
    // Given back before that is told: fields are dropped in their order.
    room: Arc<R>,
    _gone: mpsc::Sender<()>,
}

impl<R> Clone for Alive<R> {
    fn clone(&self) -> Self {
        Alive {
            room: Arc::clone(&self.room),
            _gone: self._gone.clone(),
        }
    }
}

impl<R> Alive<R> {
    /// The first of a room, and what closes when the last one is dropped.
    pub(super) fn begin(room: R) -> (Self, mpsc::Receiver<()>) {
        let (_gone, gone) = mpsc::channel(1);
        let room = Arc::new(room);
        (Alive { room, _gone }, gone)
    }

    pub(super) fn room(&self) -> &R {
        &self.room
    }
}

/// A servant that ends with this value, whatever becomes of whoever waits for that.
pub(crate) struct ProbeServant<R: Send + Sync + 'static = Permit> {
    servant: Option<Arc<dyn Servant>>,
    tasks: TaskTracker,
    alive: Alive<R>,
}

impl<R: Send + Sync + 'static> ProbeServant<R> {
    pub(super) fn new(servant: Arc<dyn Servant>, tasks: TaskTracker, alive: Alive<R>) -> Self {
        Self {
            servant: Some(servant),
            tasks,
            alive,
        }
    }

    /// Ends it. Where whoever waits is interrupted, it is ended all the same, and has its room until then.
    pub(crate) async fn end(mut self) -> Result<(), Error> {
        let Some(servant) = self.servant.take() else {
            return Ok(());
        };
        let alive = self.alive.clone();
        let stopping = self.tasks.spawn(async move {
            let _alive = alive;
            stop(&servant).await
        });
        let stopped = stopping.await;
        Ok(stopped.map_err(|_| Error::Internal("ending what was started once"))??)
    }
}

/// Told here as well: whoever waited for it may have gone.
async fn stop(servant: &Arc<dyn Servant>) -> Result<(), servant::Error> {
    let stopped = servant.stop().await;
    if let Err(error) = &stopped {
        tracing::error!("the probe {} could not be ended: {error}", servant.id());
    }
    stopped
}

impl<R: Send + Sync + 'static> Drop for ProbeServant<R> {
    fn drop(&mut self) {
        let Some(servant) = self.servant.take() else {
            return;
        };
        let alive = self.alive.clone();
        self.tasks.spawn(async move {
            let _alive = alive;
            let _ = stop(&servant).await;
        });
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;
    use in_memory::MemoryEngine;
    use servant::engine::Engine;
    use servant::spec::Spec;
    use tokio::sync::oneshot;

    use super::*;

    /// Comes to an end when the room is given back.
    struct Room(Option<oneshot::Sender<()>>);

    impl Drop for Room {
        fn drop(&mut self) {
            let _ = self.0.take().map(|given_back| given_back.send(()));
        }
    }

    #[tokio::test]
    async fn what_is_interrupted_while_it_ends_is_ended_and_has_its_room_until_then() {
        for is_ended in [true, false] {
            let engine = MemoryEngine::default();
            let spec = Spec {
                id: "a-probe".to_owned(),
                image: "sha256:1".to_owned(),
                limits: Default::default(),
                environment: Default::default(),
                nodes: Vec::new(),
                grants: Default::default(),
                resident: serde_json::Value::Null,
            };
            let servant = engine.start(spec).await.expect("it starts");
            let held = engine.servant("a-probe").expect("it runs");
            held.stuck.send_replace(true);
            let (given_back, mut is_given_back) = oneshot::channel();
            let (alive, mut gone) = Alive::begin(Room(Some(given_back)));
            let tasks = TaskTracker::new();
            let probe = ProbeServant::new(servant, tasks.clone(), alive.clone());
            drop(alive);
            if is_ended {
                let mut ending = Box::pin(probe.end());
                assert!(
                    ending.as_mut().now_or_never().is_none(),
                    "it takes its time"
                );
                // The push is cancelled.
                drop(ending);
            } else {
                drop(probe);
            }
            tokio::task::yield_now().await;
            assert_eq!(engine.servants(), ["a-probe"]);
            let empty = Err(oneshot::error::TryRecvError::Empty);
            assert_eq!(is_given_back.try_recv(), empty, "it is ending");
            held.stuck.send_replace(false);
            assert_eq!(gone.recv().await, None);
            assert_eq!(is_given_back.try_recv(), Ok(()), "first");
            tasks.close();
            tasks.wait().await;
            assert!(engine.servants().is_empty());
        }
    }
}
