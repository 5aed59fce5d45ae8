//! How many pushes are built and wait at a time, and which of them may change a service.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use parking_lot::Mutex;
use tokio::sync::{OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

use super::request::Reporter;
use crate::{Error, Options};

/// Limits the number of pushes that are built at a time and that wait, and lets those of one service follow one
/// another.
///
/// Whoever has a place never waits for a turn, so that a place is always given back: a push that learns only from what
/// it has built which service it is of gives its place back while it waits.
pub(super) struct Places {
    free: Arc<Semaphore>,
    turns: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
    waiting: AtomicUsize,
    at_once: usize,
    queue: usize,
}

/// The right to change a service, until it is dropped.
pub(super) type Turn = OwnedMutexGuard<()>;

/// A push's place, and its turn once its service is known. Both are given back when this is dropped.
pub(super) struct Admitted<'a> {
    places: &'a Places,
    turn: Option<(String, Turn)>,
    place: Option<OwnedSemaphorePermit>,
}

impl Places {
    pub(super) fn new(options: &Options) -> Places {
        Places {
            free: Arc::new(Semaphore::new(options.at_once)),
            turns: Mutex::default(),
            waiting: AtomicUsize::new(0),
            at_once: options.at_once,
            queue: options.queue,
        }
    }

    /// Waits for the turn of a service, where it is known, and then for a place.
    pub(super) async fn enter(
        &self,
        service: Option<&str>,
        report: &Reporter,
    ) -> Result<Admitted<'_>, Error> {
        let mut waiting = None;
        let turn = match service {
            None => None,
            Some(name) => {
                let turn = match self.turn_of(name).try_lock_owned() {
                    Ok(turn) => turn,
                    Err(_) => {
                        waiting = Some(self.wait()?);
                        self.report_turn(name, report).await
                    }
                };
                Some((name.to_owned(), turn))
            }
        };
        let place = match Arc::clone(&self.free).try_acquire_owned() {
            Ok(place) => place,
            Err(_) => {
                let waiting = match waiting {
                    Some(waiting) => waiting,
                    None => self.wait()?,
                };
                self.report_place(&waiting, report).await?
            }
        };
        Ok(Admitted {
            places: self,
            turn,
            place: Some(place),
        })
    }

    /// Waits for the turn of a service, without a place.
    pub(super) async fn turn(&self, service: &str) -> Turn {
        self.turn_of(service).lock_owned().await
    }

    fn turn_of(&self, service: &str) -> Arc<tokio::sync::Mutex<()>> {
        let mut turns = self.turns.lock();
        turns.retain(|_, turn| Arc::strong_count(turn) > 1);
        Arc::clone(turns.entry(service.to_owned()).or_default())
    }

    async fn report_turn(&self, service: &str, report: &Reporter) -> Turn {
        report
            .step(&format!(
                "waiting: {service} is being pushed or changed already"
            ))
            .await;
        self.turn(service).await
    }

    async fn report_place(
        &self,
        waiting: &Waiting<'_>,
        report: &Reporter,
    ) -> Result<OwnedSemaphorePermit, Error> {
        report
            .step(&format!(
                "waiting: {} pushes are being built, and {} wait before this one",
                self.at_once, waiting.before
            ))
            .await;
        let place = Arc::clone(&self.free).acquire_owned().await;
        place.map_err(|_| Error::Ending)
    }

    /// Counts as waiting, if another may.
    fn wait(&self) -> Result<Waiting<'_>, Error> {
        let waiting = Waiting::among(&self.waiting);
        if waiting.before >= self.queue {
            return Err(Error::Failed {
                message: format!(
                    "{} pushes are being built, and {} wait already",
                    self.at_once, waiting.before
                ),
                next: Some(
                    "push again later, or raise at_once or queue in [push] of the configuration"
                        .to_owned(),
                ),
                log: Vec::new(),
            });
        }
        Ok(waiting)
    }
}

impl Admitted<'_> {
    /// Takes the turn of the service, which may be known only now: then the place is given back while another push of
    /// it is built, and taken again. That is never refused, since the work is done.
    pub(super) async fn named(&mut self, service: &str, report: &Reporter) -> Result<(), Error> {
        if self.turn.as_ref().is_some_and(|(name, _)| name == service) {
            return Ok(());
        }
        // Of another name that the package goes by.
        self.turn = None;
        let turn = match self.places.turn_of(service).try_lock_owned() {
            Ok(turn) => turn,
            Err(_) => {
                let waiting = Waiting::among(&self.places.waiting);
                self.place = None;
                let turn = self.places.report_turn(service, report).await;
                self.place = Some(self.places.report_place(&waiting, report).await?);
                turn
            }
        };
        self.turn = Some((service.to_owned(), turn));
        Ok(())
    }
}

/// One that waits, counted until it is dropped.
struct Waiting<'a> {
    count: &'a AtomicUsize,
    before: usize,
}

impl Waiting<'_> {
    fn among(count: &AtomicUsize) -> Waiting<'_> {
        let before = count.fetch_add(1, Ordering::Relaxed);
        Waiting { count, before }
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.count.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;

    use super::*;

    fn options() -> Options {
        Options {
            at_once: 1,
            queue: 1,
            ..Options::wide()
        }
    }

    #[tokio::test]
    async fn pushes_take_turns_and_no_more_wait_than_may() {
        let places = Arc::new(Places::new(&options()));
        let (sender, mut told) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let first = places.enter(None, &report).await.expect("free");
        let (again, report_again) = (Arc::clone(&places), report.clone());
        let second = tokio::spawn(async move { again.enter(None, &report_again).await.map(drop) });
        let Some(api::PushEvent::Step { title }) = told.recv().await else {
            panic!("nothing was told");
        };
        assert!(title.contains("1 pushes are being built"), "{title}");
        let refused = places.enter(None, &report).await.map(drop);
        let refused = refused.expect_err("the queue is full").words();
        assert!(
            refused.contains("1 wait already") && refused.contains("at_once"),
            "{refused}"
        );
        drop(first);
        second.await.expect("no panic").expect("its turn");
        drop(places.enter(None, &report).await.expect("free again"));
    }

    #[tokio::test]
    async fn who_waits_for_a_service_holds_no_place() {
        let options = Options {
            at_once: 2,
            queue: 2,
            ..options()
        };
        let places = Arc::new(Places::new(&options));
        let (sender, mut told) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let first = places.enter(Some("a"), &report).await.expect("free");
        let (again, report_again) = (Arc::clone(&places), report.clone());
        let named = tokio::spawn(async move {
            let second = again.enter(Some("a"), &report_again).await;
            second.map(drop)
        });
        let waits = |event| match event {
            Some(api::PushEvent::Step { title }) => {
                assert!(title.contains("a is being pushed"), "{title}");
            }
            other => panic!("{other:?}"),
        };
        waits(told.recv().await);
        // One that is told its service when it is built.
        let (again, report_again) = (Arc::clone(&places), report.clone());
        let unnamed = tokio::spawn(async move {
            let mut second = again.enter(None, &report_again).await?;
            second.named("a", &report_again).await
        });
        waits(told.recv().await);
        // Two wait, and there is a place for a third.
        let other = places.enter(Some("b"), &report).await.expect("a place");
        drop((first, other));
        for waiting in [named, unnamed] {
            waiting.await.expect("no panic").expect("its turn");
        }
    }
}
