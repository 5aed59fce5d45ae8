//! Admission of pushes: limits on concurrent and waiting builds, and locks per service.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use parking_lot::Mutex;
use tokio::sync::{OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

use super::reporter::Reporter;
use crate::{Error, Options};

/// Limits the number of concurrent and waiting builds, and serializes pushes of the same service.
///
/// A push that holds a build slot never waits for a service lock, so slots are always released eventually: a push that
/// learns its service only from the build releases its slot while it waits for the lock.
pub(super) struct PushQueue {
    free: Arc<Semaphore>,
    turns: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
    /// Number of pushes that have entered.
    entered: AtomicUsize,
    waiting: AtomicUsize,
    at_once: usize,
    queue: usize,
}

/// Lock on a service, held until dropped.
pub(super) type ServiceLock = OwnedMutexGuard<()>;

/// Build slot of a push, and the lock on its service once that is known. Both are released on drop.
pub(super) struct AdmittedPush<'a> {
    places: &'a PushQueue,
    turn: Option<(String, ServiceLock)>,
    place: Option<OwnedSemaphorePermit>,
}

impl PushQueue {
    pub(super) fn new(options: &Options) -> PushQueue {
        PushQueue {
            free: Arc::new(Semaphore::new(options.at_once)),
            turns: Mutex::default(),
            entered: AtomicUsize::new(0),
            waiting: AtomicUsize::new(0),
            at_once: options.at_once,
            queue: options.queue,
        }
    }

    /// Lets a push in before it has files, unless as many as may build and wait are in. It counts until the result is
    /// dropped.
    pub(super) fn enter(&self) -> Result<QueuedPush<'_>, Error> {
        let entered = QueuedPush::count_in(&self.entered);
        if entered.before >= self.at_once.saturating_add(self.queue) {
            return Err(Error::Failed {
                message: format!("{} pushes are building, and {} are already waiting", self.at_once, self.queue),
                next: Some("push again later, or raise at_once or queue in [push] of the configuration".to_owned()),
                log: Vec::new(),
            });
        }
        Ok(entered)
    }

    /// Waits for the lock on the service, if it is known, and then for a build slot.
    pub(super) async fn admit(&self, service: Option<&str>, report: &Reporter) -> Result<AdmittedPush<'_>, Error> {
        let mut waiting = None;
        let turn = match service {
            None => None,
            Some(name) => {
                let turn = match self.service_lock(name).try_lock_owned() {
                    Ok(turn) => turn,
                    Err(_) => {
                        waiting = Some(QueuedPush::count_in(&self.waiting));
                        self.report_and_lock_service(name, report).await
                    }
                };
                Some((name.to_owned(), turn))
            }
        };
        let place = match Arc::clone(&self.free).try_acquire_owned() {
            Ok(place) => place,
            Err(_) => {
                let waiting = waiting.unwrap_or_else(|| QueuedPush::count_in(&self.waiting));
                self.report_and_acquire_slot(&waiting, report).await?
            }
        };
        Ok(AdmittedPush { places: self, turn, place: Some(place) })
    }

    /// Waits for the lock on a service, without a build slot.
    pub(super) async fn lock_service(&self, service: &str) -> ServiceLock {
        self.service_lock(service).lock_owned().await
    }

    fn service_lock(&self, service: &str) -> Arc<tokio::sync::Mutex<()>> {
        let mut turns = self.turns.lock();
        turns.retain(|_, turn| Arc::strong_count(turn) > 1);
        Arc::clone(turns.entry(service.to_owned()).or_default())
    }

    async fn report_and_lock_service(&self, service: &str, report: &Reporter) -> ServiceLock {
        report.step(&format!("waiting: {service} is already being pushed or changed")).await;
        self.lock_service(service).await
    }

    async fn report_and_acquire_slot(
        &self,
        waiting: &QueuedPush<'_>,
        report: &Reporter,
    ) -> Result<OwnedSemaphorePermit, Error> {
        report
            .step(&format!(
                "waiting: {} pushes are building, and {} are ahead of this one",
                self.at_once, waiting.before
            ))
            .await;
        let place = Arc::clone(&self.free).acquire_owned().await;
        place.map_err(|_| Error::Ending)
    }
}

impl AdmittedPush<'_> {
    /// Acquires the lock on the service, which may be known only now. If another push holds it, the build slot is
    /// released while waiting and acquired again. This is never refused, since the work is already done.
    pub(super) async fn assign_service(&mut self, service: &str, report: &Reporter) -> Result<(), Error> {
        if self.turn.as_ref().is_some_and(|(name, _)| name == service) {
            return Ok(());
        }
        // The package may go by another name.
        self.turn = None;
        let turn = match self.places.service_lock(service).try_lock_owned() {
            Ok(turn) => turn,
            Err(_) => {
                let waiting = QueuedPush::count_in(&self.places.waiting);
                self.place = None;
                let turn = self.places.report_and_lock_service(service, report).await;
                self.place = Some(self.places.report_and_acquire_slot(&waiting, report).await?);
                turn
            }
        };
        self.turn = Some((service.to_owned(), turn));
        Ok(())
    }
}

/// A counted push; it counts until it is dropped.
pub(super) struct QueuedPush<'a> {
    count: &'a AtomicUsize,
    before: usize,
}

impl QueuedPush<'_> {
    fn count_in(count: &AtomicUsize) -> QueuedPush<'_> {
        let before = count.fetch_add(1, Ordering::Relaxed);
        QueuedPush { count, before }
    }
}

impl Drop for QueuedPush<'_> {
    fn drop(&mut self) {
        self.count.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;

    use super::*;

    fn options() -> Options {
        Options { at_once: 1, queue: 1, ..Options::unlimited() }
    }

    #[tokio::test]
    async fn pushes_take_turns_and_no_more_wait_than_may() {
        let places = Arc::new(PushQueue::new(&options()));
        let (sender, mut told) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let first = places.admit(None, &report).await.expect("free");
        let (again, report_again) = (Arc::clone(&places), report.clone());
        let second = tokio::spawn(async move { again.admit(None, &report_again).await.map(drop) });
        let Some(api::PushEvent::Step { title, .. }) = told.recv().await else {
            panic!("nothing was told");
        };
        assert!(title.contains("1 pushes are building"), "{title}");
        let entered = [places.enter().expect("it builds"), places.enter().expect("it may wait")];
        let refused = places.enter().map(drop).expect_err("the queue is full").message_and_advice();
        assert!(refused.contains("1 are already waiting") && refused.contains("at_once"), "{refused}");
        drop(entered);
        drop(places.enter().expect("there is room again"));
        drop(first);
        second.await.expect("no panic").expect("its turn");
        drop(places.admit(None, &report).await.expect("free again"));
    }

    #[tokio::test]
    async fn who_waits_for_a_service_holds_no_place() {
        let options = Options { at_once: 2, queue: 2, ..options() };
        let places = Arc::new(PushQueue::new(&options));
        let (sender, mut told) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let first = places.admit(Some("a"), &report).await.expect("free");
        let (again, report_again) = (Arc::clone(&places), report.clone());
        let named = tokio::spawn(async move {
            let second = again.admit(Some("a"), &report_again).await;
            second.map(drop)
        });
        let waits = |event| match event {
            Some(api::PushEvent::Step { title, .. }) => {
                assert!(title.contains("a is already being pushed"), "{title}");
            }
            other => panic!("{other:?}"),
        };
        waits(told.recv().await);
        // A push whose service becomes known when it is built.
        let (again, report_again) = (Arc::clone(&places), report.clone());
        let unnamed = tokio::spawn(async move {
            let mut second = again.admit(None, &report_again).await?;
            second.assign_service("a", &report_again).await
        });
        waits(told.recv().await);
        // Two are waiting for a service, so there is a place for a third.
        let other = places.admit(Some("b"), &report).await.expect("a place");
        drop((first, other));
        for waiting in [named, unnamed] {
            waiting.await.expect("no panic").expect("its turn");
        }
    }
}
