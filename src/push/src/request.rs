//! Life cycle of a push: a task that is started, bounded, cancelled as a whole, and reported on.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use api::{Limits, PushEvent, PushOptions, PushStatus, Sla};
use catalogue::names;
use futures_util::FutureExt;
use rootfs_builder::blocking;
use store::NewEvent;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::deployer::Deployer;
use super::pusher::EVENTS_AHEAD;
use super::reporter::Reporter;
use super::running::RunningPush;
use super::{Archive, Error, OptionsError, Pusher, option_check, receive, shared};

/// Result of a push: a new revision, or the unchanged one.
#[derive(Debug, Clone, PartialEq)]
pub enum Published {
    /// The service of this name.
    Service(String),
    /// This underlay.
    Underlay(Box<api::Underlay>),
}

/// Result of a push.
#[derive(Debug)]
pub struct PushResult {
    /// The published revision.
    pub published: Published,
    /// Layers of the image.
    pub layers: Vec<api::push::Layer>,
    /// Duration, including the time spent waiting for other pushes.
    pub took: Duration,
    /// True if the revision that serves is the same, so that none was published.
    pub unchanged: bool,
}

impl Pusher {
    /// Starts a push; `to_last_event` converts its result. It is cancelled if its client leaves before the archive is
    /// complete ([`ReceptionGuard`](super::ReceptionGuard)).
    pub fn start(
        self: &Arc<Self>,
        options: PushOptions,
        by: Deployer,
        archive: Archive,
        to_last_event: impl FnOnce(Result<PushResult, Error>) -> PushEvent + Send + 'static,
    ) -> Result<Arc<RunningPush>, Error> {
        let pusher = Arc::clone(self);
        let id = format!("push-{}", names::random(8));
        let name = options.name.as_deref().or(options.as_underlay.as_deref());
        let running = self.registry.begin(&id, (name, &options.source, &by.name))?;
        // Of a push that names no service, the name is known once the package was read.
        let span = tracing::error_span!(parent: None, "push", service = options.name, id);
        let started = Arc::clone(&running);
        let work = async move {
            let outcome = catch_panic(pusher.run_and_record(&options, &by, archive, &running)).await;
            let failed = outcome.is_err();
            pusher.registry.end(&running, to_last_event(outcome));
            if failed && !pusher.cancel.is_cancelled() {
                // The layers of a failed push are no longer needed.
                pusher.collect_garbage().await;
            }
        };
        self.tasks.spawn(work.instrument(span));
        Ok(started)
    }

    /// Runs a push and keeps what it reports.
    async fn run_and_record(
        &self,
        options: &PushOptions,
        by: &Deployer,
        archive: Archive,
        running: &RunningPush,
    ) -> Result<PushResult, Error> {
        let (sender, mut events) = mpsc::channel(EVENTS_AHEAD);
        let report = Reporter::for_push(sender, running);
        let mut work = Box::pin(self.run(options, by, archive, &report, running));
        let mut accepted = false;
        let outcome = loop {
            tokio::select! {
                biased;
                Some(event) = events.recv() => self.registry.add_event(running, event),
                () = running.received.cancelled(), if !accepted => {
                    accepted = true;
                    self.registry.add_event(running, PushEvent::Accepted { number: running.number });
                }
                outcome = &mut work => break outcome,
            }
        };
        events.close();
        while let Some(event) = events.recv().await {
            self.registry.add_event(running, event);
        }
        outcome
    }

    /// Returns all pushes that run or ended lately, newest first.
    pub fn pushes(&self) -> Result<Vec<PushStatus>, Error> {
        self.registry.list()
    }

    /// Returns a running push.
    pub fn running_push(&self, number: u64) -> Option<Arc<RunningPush>> {
        self.registry.find(number)
    }

    /// Returns what a push that has ended printed, as JSON lines; `None` if it is not known.
    pub fn push_output(&self, number: u64) -> Result<Option<String>, Error> {
        self.registry.stored_output(number)
    }

    /// Reads what a refused client still sends, for a while: if the connection were closed at once, it might not see
    /// the response.
    pub fn discard(&self, archive: Archive) {
        let limit = self.options.archive;
        let ending = self.cancel.clone();
        self.tasks.spawn(receive::discard(archive, limit, ending));
    }

    /// Rejects what can be rejected before anything is received.
    pub fn check_request(&self, options: &PushOptions, by: &Deployer) -> Result<(), Error> {
        if self.cancel.is_cancelled() {
            return Err(Error::Ending);
        }
        if let Some(name) = &options.name {
            names::validate_service(name).map_err(catalogue::Error::from)?;
            by.check_may_publish(name)?;
        }
        if let Some(name) = &options.as_underlay {
            self.check_may_publish_underlay(name, by)?;
        }
        options.limits.check().map_err(OptionsError::from)?;
        if by.owner.is_some() {
            choreographer::limits::check_weight(&options.limits).map_err(OptionsError::from)?;
        }
        check_caps(options)?;
        check_sla(options)?;
        option_check::check_options(options)?;
        options.parse_requests().map_err(OptionsError::RequestPair)?;
        if let Some(terms) = &options.rollout {
            choreographer::check_terms(terms)?;
        }
        self.choreographer.check_grants(&options.grants)?;
        shared::check_options(options)?;
        Ok(self.choreographer.check_limits(&options.limits)?)
    }

    /// Runs a push from start to end.
    async fn run(
        &self,
        options: &PushOptions,
        by: &Deployer,
        archive: Archive,
        report: &Reporter,
        running: &RunningPush,
    ) -> Result<PushResult, Error> {
        let (id, cancel) = (&*running.id, &running.cancel);
        // Held until its files are gone: what a cancelled push leaves to be packed takes as much as a push.
        let mut entered = None;
        let push = Box::pin(self.push(id, options, (by, archive), report, &mut entered));
        let work = blocking::cancellable(push);
        let over = async {
            tokio::select! {
                () = self.cancel.cancelled() => Error::Ending,
                () = cancel.cancelled() => Error::Cancelled,
                reason = (by.over)() => Error::NotAllowed(reason),
            }
        };
        let outcome = run_until_revoked(work, over, &report.publishing).await;
        // The builder first: it removes its files when its containers have ended.
        report.building.close();
        report.building.wait().await;
        let mut removed = std::pin::pin!(self.builder.wait_removed(id));
        tokio::select! {
            biased;
            () = &mut removed => {}
            // What the push has left to be packed must not take what others need.
            _ = self.disks.wait_until_low() => {
                self.builder.give_up_packing(id);
                removed.await;
            }
        }
        let build = self.home.join("build").join(id);
        let removed = privilege::spawn_blocking(move || foreign::remove(&build)).await;
        if let Ok(Err(error)) = removed {
            tracing::warn!("leftovers of the push remain until the next start: {error}");
        }
        drop(entered);
        match outcome {
            Ok(published) => {
                self.published.fetch_add(1, Ordering::Relaxed);
                Ok(published)
            }
            Err(error) => {
                self.failed.fetch_add(1, Ordering::Relaxed);
                let name = options.name.as_deref().or(options.apt.as_deref()).or(options.as_underlay.as_deref());
                let what = match &error {
                    Error::Cancelled | Error::Ending => "was cancelled".to_owned(),
                    error => format!("failed: {error}"),
                };
                let message = format!("the push of {} {what}", name.unwrap_or(&options.source));
                let about = NewEvent { service: name, ..NewEvent::default() };
                self.journal.warning("push-failed", &message, &about);
                Err(error)
            }
        }
    }
}

/// Turns a panic into an error: a push without a last event would run forever for whoever follows or lists it.
async fn catch_panic<T>(work: impl Future<Output = Result<T, Error>>) -> Result<T, Error> {
    let outcome = AssertUnwindSafe(work).catch_unwind().await;
    outcome.unwrap_or(Err(Error::Internal("running a push")))
}

/// Runs the work unless `over` resolves before it begins to publish.
async fn run_until_revoked<T>(
    work: impl Future<Output = Result<T, Error>>,
    over: impl Future<Output = Error>,
    publishing: &CancellationToken,
) -> Result<T, Error> {
    tokio::pin!(work);
    tokio::select! {
        outcome = &mut work => return outcome,
        error = over => if !publishing.is_cancelled() {
            return Err(error);
        }
    }
    work.await
}

/// Rejects caps that contradict the limits.
fn check_caps(options: &PushOptions) -> Result<(), OptionsError> {
    let PushOptions { caps, limits, .. } = options;
    let most = Limits { cpus: caps.cpus, memory: caps.memory, ..Limits::default() };
    most.check().map_err(OptionsError::Caps)?;
    if let (Some(cpus), Some(most)) = (limits.cpus, caps.cpus)
        && cpus > most
    {
        return Err(OptionsError::CpusAboveCap { cpus, most });
    }
    if let (Some(memory), Some(most)) = (limits.memory, caps.memory)
        && memory > most
    {
        return Err(OptionsError::MemoryAboveCap { memory, most });
    }
    Ok(())
}

/// Rejects an SLA that cannot be a default for stubs.
fn check_sla(options: &PushOptions) -> Result<(), OptionsError> {
    let sla = &options.sla;
    sla.check().map_err(OptionsError::Sla)?;
    let times = Sla { rrt: sla.rrt, max_rrt: sla.max_rrt, ..Sla::default() };
    if *sla == times { Ok(()) } else { Err(OptionsError::SlaMeasures) }
}

#[cfg(test)]
mod tests {
    use api::{Caps, Size, Span};

    use super::*;

    #[tokio::test]
    async fn a_push_that_publishes_is_not_cancelled() {
        for (publishes, expected) in [(false, "nothing"), (true, "published")] {
            let (publishing, over) = (CancellationToken::new(), CancellationToken::new());
            let (done, awaited) = tokio::sync::oneshot::channel::<()>();
            let work = async {
                if publishes {
                    publishing.cancel();
                }
                over.cancel();
                // The client has disconnected while the database is still writing.
                let _ = awaited.await;
                Ok("published")
            };
            let ended = async {
                over.cancelled().await;
                let _ = done.send(());
                Error::Ending
            };
            let outcome = run_until_revoked(work, ended, &publishing).await;
            assert_eq!(outcome.unwrap_or("nothing"), expected);
        }
    }

    #[tokio::test]
    async fn a_push_that_panics_ends_with_an_error() {
        let ended = catch_panic(async { panic!("a bug") }).await;
        assert!(matches!(ended, Err::<(), _>(Error::Internal(_))), "{ended:?}");
        assert!(matches!(catch_panic(async { Ok(7) }).await, Ok(7)));
    }

    #[test]
    fn caps_below_the_pushs_own_limits_are_refused() {
        let check = |cpus, max_cpus, memory: Option<u64>, max_memory: Option<u64>| {
            let mib = |mib: u64| Size(mib << 20);
            check_caps(&PushOptions {
                limits: Limits { cpus, memory: memory.map(mib), ..Limits::default() },
                caps: Caps { cpus: max_cpus, memory: max_memory.map(mib) },
                ..PushOptions::default()
            })
        };
        check(None, None, None, None).expect("nothing is limited");
        check(Some(1.0), Some(1.0), Some(64), Some(64)).expect("they are equal");
        check(Some(9.0), None, None, Some(64)).expect("they are of different resources");
        for (refused, words) in [
            (check(Some(2.0), Some(1.5), None, None), "--cpus 2 is more than --max-cpus 1.5; lower it"),
            (check(None, None, Some(65), Some(64)), "--memory 65M is more than --max-memory 64M; lower it"),
            (check(None, Some(0.0), None, None), "max_cpus = 0 is not"),
            (check(None, None, None, Some(1)), "max_memory = 1M is too"),
        ] {
            let refused = refused.expect_err(words).to_string();
            assert!(refused.starts_with(words), "{refused}");
        }
    }

    #[test]
    fn what_stubs_cannot_promise_is_refused() {
        let check = |sla| check_sla(&PushOptions { sla, ..PushOptions::default() });
        let times = |rrt: u64, max_rrt: u64| Sla {
            rrt: Span::from_millis(rrt),
            max_rrt: Span::from_millis(max_rrt),
            ..Sla::default()
        };
        check(times(100, 300)).expect("times in order");
        let refused = check(times(300, 100)).expect_err("in disorder").to_string();
        assert!(refused.starts_with("--rrt (300ms) is greater than"), "{refused}");
        let rate = Sla { fps: Some(5.0), ..times(100, 300) };
        let refused = check(rate).expect_err("a rate").to_string();
        assert!(refused.contains("stub.toml"), "{refused}");
    }
}
