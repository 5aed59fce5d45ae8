//! Guards of started probes and of the resources reserved for them.

use std::sync::Arc;

use choreographer::Permit;
use servant::engine::ServantHandle;
use tokio::sync::mpsc;
use tokio_util::task::TaskTracker;
use tracing::Instrument;

use crate::Error;

/// Reservation shared by everything that was started within it; released when the last clone is dropped.
pub(crate) struct RoomGuard<R = Permit> {
    // Released before the channel closes: fields are dropped in declaration order.
    room: Arc<R>,
    _gone: mpsc::Sender<()>,
}

impl<R> Clone for RoomGuard<R> {
    fn clone(&self) -> Self {
        RoomGuard { room: Arc::clone(&self.room), _gone: self._gone.clone() }
    }
}

impl<R> RoomGuard<R> {
    /// Returns the first guard of a reservation, and a channel that closes when the last one is dropped.
    pub(super) fn with_room(room: R) -> (Self, mpsc::Receiver<()>) {
        let (_gone, gone) = mpsc::channel(1);
        let room = Arc::new(room);
        (RoomGuard { room, _gone }, gone)
    }

    pub(super) fn room(&self) -> &R {
        &self.room
    }
}

/// A servant that is stopped when this value is dropped, even if nobody waits for it.
pub(crate) struct ProbeServant<R: Send + Sync + 'static = Permit> {
    servant: Option<Arc<dyn ServantHandle>>,
    tasks: TaskTracker,
    alive: RoomGuard<R>,
}

impl<R: Send + Sync + 'static> ProbeServant<R> {
    pub(super) fn new(servant: Arc<dyn ServantHandle>, tasks: TaskTracker, alive: RoomGuard<R>) -> Self {
        Self { servant: Some(servant), tasks, alive }
    }

    /// Stops the servant. If the caller is cancelled, it is stopped in the background and keeps its reservation until
    /// then.
    pub(crate) async fn end(mut self) -> Result<(), Error> {
        let Some(servant) = self.servant.take() else {
            return Ok(());
        };
        let alive = self.alive.clone();
        let stopping = async move {
            let _alive = alive;
            stop(&servant).await
        };
        let stopped = self.tasks.spawn(stopping.in_current_span()).await;
        Ok(stopped.map_err(|_| Error::Internal("stopping the started image"))??)
    }
}

/// Logged here as well, since the caller may have gone.
async fn stop(servant: &Arc<dyn ServantHandle>) -> Result<(), servant::Error> {
    let stopped = servant.stop().await;
    if let Err(error) = &stopped {
        tracing::error!("cannot stop the probe {}: {error}", servant.id());
    }
    stopped
}

impl<R: Send + Sync + 'static> Drop for ProbeServant<R> {
    fn drop(&mut self) {
        let Some(servant) = self.servant.take() else {
            return;
        };
        let alive = self.alive.clone();
        let stopping = async move {
            let _alive = alive;
            let _ = stop(&servant).await;
        };
        self.tasks.spawn(stopping.in_current_span());
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

    /// Sends a message when the reservation is released.
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
            let (alive, mut gone) = RoomGuard::with_room(Room(Some(given_back)));
            let tasks = TaskTracker::new();
            let probe = ProbeServant::new(servant, tasks.clone(), alive.clone());
            drop(alive);
            if is_ended {
                let mut ending = Box::pin(probe.end());
                assert!(ending.as_mut().now_or_never().is_none(), "it takes its time");
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
