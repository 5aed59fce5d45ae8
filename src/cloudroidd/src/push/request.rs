//! A push as an HTTP request: options in the query, the archive in the body, events as JSON lines in the answer.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use api::{PushEvent, PushOptions};
use axum::body::Body;
use axum::extract::{OriginalUri, State as Extracted};
use axum::response::{IntoResponse, Response};
use catalogue::names;
use futures_util::StreamExt;
use rootfs_builder::blocking;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

use super::{EVENTS_AHEAD, Published, Pusher, bounds, receive};
use crate::errors::Error;
use crate::portal::App;
use crate::views;
use store::NewEvent;

/// How long the last event waits for a client that does not read.
const FAREWELL: Duration = Duration::from_secs(5);

/// Tells the client what is being done. It may have gone away: that cancels the push by itself.
#[derive(Clone)]
pub(super) struct Tell(pub(super) mpsc::Sender<PushEvent>);

impl Tell {
    pub(super) async fn step(&self, title: &str) {
        self.event(PushEvent::Step {
            title: title.to_owned(),
        })
        .await;
    }

    pub(super) async fn warning(&self, message: String) {
        self.event(PushEvent::Warning { message }).await;
    }

    pub(super) async fn event(&self, event: PushEvent) {
        let _ = self.0.send(event).await;
    }

    /// The last event. A client that does not read it must not keep the push, and with it the daemon, from ending.
    async fn farewell(&self, event: PushEvent) {
        let _ = tokio::time::timeout(FAREWELL, self.event(event)).await;
    }
}

/// Answers a push.
pub async fn handle(
    Extracted(app): Extracted<Arc<App>>,
    OriginalUri(uri): OriginalUri,
    body: Body,
) -> Response {
    let options = match read_options(uri.query())
        .and_then(|options| app.pusher.check(&options).map(|()| options))
    {
        Ok(options) => options,
        Err(error) => {
            // The client is still sending. Were it cut off, it might not see why.
            app.pusher.tasks.spawn(receive::discard(
                body,
                app.config.push.archive,
                app.ending.clone(),
            ));
            return error.into_response();
        }
    };
    let (sender, receiver) = mpsc::channel(EVENTS_AHEAD);
    let cancel = app.pusher.cancel.child_token();
    // Lives in the answer: when the client goes away the answer is dropped, and the push with it.
    let guard = cancel.clone().drop_guard();
    let tracker = app.pusher.tasks.clone();
    tracker.spawn(async move {
        let pusher = Arc::clone(&app.pusher);
        let published = pusher.run(&app, options, body, Tell(sender), cancel).await;
        if !published && !pusher.cancel.is_cancelled() {
            // What the failed push had made is of no use any more.
            pusher.collect_garbage().await;
        }
    });
    crate::portal::lines(ReceiverStream::new(receiver).map(move |event| {
        let _ = &guard;
        event
    }))
}

fn read_options(query: Option<&str>) -> Result<PushOptions, Error> {
    let uri: axum::http::Uri = format!("/?{}", query.unwrap_or_default())
        .parse()
        .map_err(|_| Error::BadRequest("the push options cannot be read".to_owned()))?;
    match crate::portal::query(&uri, "options") {
        Some(text) => serde_json::from_str(&text).map_err(|error| {
            Error::BadRequest(format!("the push options cannot be read: {error}"))
        }),
        None => Ok(PushOptions::default()),
    }
}

impl Pusher {
    /// Refuses what can be refused before anything is received.
    fn check(&self, options: &PushOptions) -> Result<(), Error> {
        if self.cancel.is_cancelled() {
            return Err(Error::Ending);
        }
        if let Some(name) = &options.name {
            names::service(name).map_err(catalogue::Error::from)?;
        }
        choreographer::limits::check(&options.limits)
            .map_err(|error| Error::BadRequest(error.to_string()))?;
        self.choreographer.grant(&options.grants)?;
        Ok(self.choreographer.check_limits(&options.limits)?)
    }

    /// Pushes when it is its turn, within what a push may use.
    async fn bounded(
        &self,
        id: &str,
        options: &PushOptions,
        body: Body,
        tell: &Tell,
    ) -> Result<Published, Error> {
        let _place = self.places.take(tell).await?;
        let directory = self.home.join("build").join(id);
        tokio::select! {
            outcome = self.push(id, options, body, tell) => outcome,
            error = bounds::exceeded(&self.config.push, &directory) => Err(error),
        }
    }

    /// Pushes from beginning to end; whether it was published.
    async fn run(
        &self,
        app: &App,
        options: PushOptions,
        body: Body,
        tell: Tell,
        cancel: CancellationToken,
    ) -> bool {
        let began = Instant::now();
        let id = format!("push-{}", names::random(8));
        let outcome = tokio::select! {
            outcome = blocking::cancellable(self.bounded(&id, &options, body, &tell)) => outcome,
            () = cancel.cancelled() => Err(Error::Ending),
        };
        // First what the builder has in there: it goes when its containers have ended.
        self.builder.removed(&id).await;
        let build = self.home.join("build").join(&id);
        let removed = tokio::task::spawn_blocking(move || foreign::remove(&build)).await;
        if let Ok(Err(error)) = removed {
            tracing::warn!("what the push {id} left remains until the next start: {error}");
        }
        let finished = outcome
            .and_then(|published| Ok((views::service(app, &published.service)?, published.layers)));
        match finished {
            Ok((service, layers)) => {
                self.published.fetch_add(1, Ordering::Relaxed);
                let took = began.elapsed().as_millis() as u64;
                tell.farewell(PushEvent::Done {
                    service: Box::new(service),
                    layers,
                    took,
                })
                .await;
                true
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
                self.journal.warning(
                    "push-failed",
                    &message,
                    &NewEvent {
                        service: name,
                        ..NewEvent::default()
                    },
                );
                tell.farewell(PushEvent::Error {
                    problem: error.problem(),
                })
                .await;
                false
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_come_in_the_query() {
        let options =
            read_options(Some("options=%7B%22apt%22%3A%22opencv_apps%22%7D")).expect("valid");
        assert_eq!(options.apt.as_deref(), Some("opencv_apps"));
        assert_eq!(read_options(None).expect("none"), PushOptions::default());
        let refused = read_options(Some("options=%7B%22nope%22%3A1%7D"))
            .expect_err("unknown")
            .problem();
        assert_eq!(refused.status, 400);
        assert!(refused.detail.contains("nope"), "{refused:?}");
    }
}
