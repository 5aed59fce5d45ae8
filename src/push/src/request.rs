//! Life cycle of a push: a task that is started, bounded, cancelled as a whole, and reported on.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use api::{Limits, PushEvent, PushOptions, Sla};
use catalogue::names;
use futures_util::future::BoxFuture;
use package::requests::{Reason, Request};
use rootfs_builder::blocking;
use store::NewEvent;
use tokio::sync::mpsc;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use super::{Archive, Error, Pusher, receive, shared};

/// Reports progress to the client. A client that has disconnected cancels the push separately.
#[derive(Clone)]
pub(super) struct Reporter {
    events: mpsc::Sender<PushEvent>,
    /// Tracks the build of this push while it runs.
    pub(super) building: TaskTracker,
    /// Cancelled when the push begins to publish, after which it can no longer be cancelled.
    pub(super) publishing: CancellationToken,
}

impl Reporter {
    pub(super) fn new(events: mpsc::Sender<PushEvent>) -> Self {
        Self {
            events,
            building: TaskTracker::new(),
            publishing: CancellationToken::new(),
        }
    }

    pub(super) async fn step(&self, title: &str) {
        self.event(PushEvent::Step {
            title: title.to_owned(),
        })
        .await;
    }

    pub(super) async fn warning(&self, message: String) {
        self.event(PushEvent::Warning { message }).await;
    }

    /// Sends a warning if the client keeps up; publication does not wait for a slow client.
    pub(super) fn try_warning(&self, message: String) {
        let _ = self.events.try_send(PushEvent::Warning { message });
    }

    /// Reports a request pair.
    pub(super) async fn request(&self, request: &Request) {
        let words = request.to_string();
        match request.reason {
            Reason::Guessed => self.warning(words).await,
            Reason::Stated | Reason::Watched | Reason::Alone => {
                self.event(PushEvent::Log { line: words }).await;
            }
        }
    }

    pub(super) async fn event(&self, event: PushEvent) {
        let _ = self.events.send(event).await;
    }
}

/// Checks whether a service name may be published; returns the reason if not.
type PublishCheck = dyn Fn(&str) -> Result<(), String> + Send + Sync;

/// Future that resolves with the reason when the deployer's credentials are revoked.
type Revocation = dyn Fn() -> BoxFuture<'static, String> + Send + Sync;

/// Principal that pushes.
pub struct Deployer {
    /// Owner of services that are published for the first time; `None` for operators.
    pub owner: Option<String>,
    /// Check of the services that it may publish.
    pub may: Box<PublishCheck>,
    /// Resolves with the reason when its credentials are no longer valid.
    pub over: Box<Revocation>,
}

impl Deployer {
    pub(super) fn check_may_publish(&self, name: &str) -> Result<(), Error> {
        (self.may)(name).map_err(Error::NotAllowed)
    }
}

/// Result of a push.
#[derive(Debug)]
pub struct PushResult {
    /// Name of the service.
    pub service: String,
    /// Layers of the image.
    pub layers: Vec<api::push::Layer>,
    /// Duration, including the time spent waiting for other pushes.
    pub took: Duration,
}

impl Pusher {
    /// Starts a push; `events` receives its progress, `finished` its result. The push is cancelled when the returned
    /// guard is dropped.
    pub fn start<F>(
        self: &Arc<Self>,
        options: PushOptions,
        by: Deployer,
        archive: Archive,
        events: mpsc::Sender<PushEvent>,
        finished: impl FnOnce(Result<PushResult, Error>) -> F + Send + 'static,
    ) -> DropGuard
    where
        F: Future<Output = ()> + Send,
    {
        let cancel = self.cancel.child_token();
        let guard = cancel.clone().drop_guard();
        let pusher = Arc::clone(self);
        self.tasks.spawn(async move {
            let outcome = pusher
                .run(&options, &by, archive, &Reporter::new(events), cancel)
                .await;
            let failed = outcome.is_err();
            finished(outcome).await;
            if failed && !pusher.cancel.is_cancelled() {
                // The layers of a failed push are no longer needed.
                pusher.collect_garbage().await;
            }
        });
        guard
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
        choreographer::limits::check(&options.limits)
            .map_err(|error| Error::Options(error.to_string()))?;
        if by.owner.is_some() {
            choreographer::limits::check_weight(&options.limits)
                .map_err(|error| Error::Options(error.to_string()))?;
        }
        check_caps(options).map_err(Error::Options)?;
        check_sla(options).map_err(Error::Options)?;
        options
            .parse_requests()
            .map_err(|error| Error::Options(format!("--request {error}")))?;
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
        cancel: CancellationToken,
    ) -> Result<PushResult, Error> {
        let id = format!("push-{}", names::random(8));
        let push = Box::pin(self.push(&id, options, by, archive, report));
        let work = blocking::cancellable(push);
        let over = async {
            tokio::select! {
                () = cancel.cancelled() => Error::Ending,
                reason = (by.over)() => Error::NotAllowed(reason),
            }
        };
        let outcome = run_until_revoked(work, over, &report.publishing).await;
        // The builder first: it removes its files when its containers have ended.
        report.building.close();
        report.building.wait().await;
        self.builder.wait_removed(&id).await;
        let build = self.home.join("build").join(&id);
        let removed = privilege::spawn_blocking(move || foreign::remove(&build)).await;
        if let Ok(Err(error)) = removed {
            tracing::warn!("leftovers of the push {id} remain until the next start: {error}");
        }
        match outcome {
            Ok(published) => {
                self.published.fetch_add(1, Ordering::Relaxed);
                Ok(published)
            }
            Err(error) => {
                self.failed.fetch_add(1, Ordering::Relaxed);
                let name = options.name.as_deref().or(options.apt.as_deref());
                let what = if cancel.is_cancelled() {
                    "was cancelled".to_owned()
                } else {
                    format!("failed: {error}")
                };
                let message = format!("the push of {} {what}", name.unwrap_or(&options.source));
                let about = NewEvent {
                    service: name,
                    ..NewEvent::default()
                };
                self.journal.warning("push-failed", &message, &about);
                Err(error)
            }
        }
    }
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
fn check_caps(options: &PushOptions) -> Result<(), String> {
    let PushOptions { caps, limits, .. } = options;
    let most = Limits {
        cpus: caps.cpus,
        memory: caps.memory,
        ..Limits::default()
    };
    choreographer::limits::check(&most).map_err(|error| format!("max_{error}"))?;
    if let (Some(cpus), Some(most)) = (limits.cpus, caps.cpus)
        && cpus > most
    {
        return Err(format!(
            "--cpus {cpus} is more than --max-cpus {most}; lower it, or raise --max-cpus"
        ));
    }
    if let (Some(memory), Some(most)) = (limits.memory, caps.memory)
        && memory > most
    {
        return Err(format!(
            "--memory {memory} is more than --max-memory {most}; lower it, or raise --max-memory"
        ));
    }
    Ok(())
}

/// Rejects an SLA that cannot be a default for stubs.
fn check_sla(options: &PushOptions) -> Result<(), String> {
    let sla = &options.sla;
    sla.check().map_err(|error| format!("--{error}"))?;
    let times = Sla {
        rrt: sla.rrt,
        max_rrt: sla.max_rrt,
        ..Sla::default()
    };
    if *sla == times {
        Ok(())
    } else {
        Err(
            "sla may have only rrt and max_rrt; the robot sets rates and ages in its stub.toml"
                .into(),
        )
    }
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

    #[test]
    fn caps_below_the_pushs_own_limits_are_refused() {
        let check = |cpus, max_cpus, memory: Option<u64>, max_memory: Option<u64>| {
            let mib = |mib: u64| Size(mib << 20);
            check_caps(&PushOptions {
                limits: Limits {
                    cpus,
                    memory: memory.map(mib),
                    ..Limits::default()
                },
                caps: Caps {
                    cpus: max_cpus,
                    memory: max_memory.map(mib),
                },
                ..PushOptions::default()
            })
        };
        assert_eq!(check(None, None, None, None), Ok(()));
        assert_eq!(check(Some(1.0), Some(1.0), Some(64), Some(64)), Ok(()));
        assert_eq!(check(Some(9.0), None, None, Some(64)), Ok(()));
        for (refused, words) in [
            (
                check(Some(2.0), Some(1.5), None, None),
                "--cpus 2 is more than --max-cpus 1.5; lower it",
            ),
            (
                check(None, None, Some(65), Some(64)),
                "--memory 65M is more than --max-memory 64M; lower it",
            ),
            (check(None, Some(0.0), None, None), "max_cpus = 0 is not"),
            (check(None, None, None, Some(1)), "max_memory = 1M is too"),
        ] {
            let refused = refused.expect_err(words);
            assert!(refused.starts_with(words), "{refused}");
        }
    }

    #[test]
    fn what_stubs_cannot_promise_is_refused() {
        let check = |sla| {
            check_sla(&PushOptions {
                sla,
                ..PushOptions::default()
            })
        };
        let times = |rrt: u64, max_rrt: u64| Sla {
            rrt: Span::from_millis(rrt),
            max_rrt: Span::from_millis(max_rrt),
            ..Sla::default()
        };
        assert_eq!(check(times(100, 300)), Ok(()));
        let refused = check(times(300, 100)).expect_err("in disorder");
        assert!(
            refused.starts_with("--rrt (300ms) is greater than"),
            "{refused}"
        );
        let rate = Sla {
            fps: Some(5.0),
            ..times(100, 300)
        };
        let refused = check(rate).expect_err("a rate");
        assert!(refused.contains("stub.toml"), "{refused}");
    }
}
