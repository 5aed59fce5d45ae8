//! `GET /api/v1/servants/ID/topics`: every second, statistics of each of a servant's topics, until the caller
//! disconnects. To compute them, all messages are received besides the servant's robot. The caller sees those topics
//! to which it may subscribe there.

use std::sync::Arc;
use std::time::Duration;

use access::{ConnectionAccess, Grants, Operation};
use api::topics::{PublishedTopic, PublishedTopics};
use axum::Extension;
use axum::extract::{Path, State};
use axum::response::Response;
use observe::{Figures, TopicFigures};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::inside::{self, InsideTarget};
use crate::json::json_lines;
use crate::observers;

/// Period of one line.
const LINE_PERIOD: Duration = Duration::from_secs(1);

/// Streams the statistics of all topics, one line per second.
pub async fn topics(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let handle = app.choreographer.servant(&id)?;
    let Some(reach) = handle.reach() else {
        return Err(Error::NotThereYet(id));
    };
    let part = {
        let whose =
            InsideTarget { service: handle.service(), robot: &handle.robot, object: format_args!("servant {id}") };
        inside::inside_role(&app, &caller, whose)?
    };
    let place = app.inside.acquire(&id, &caller.who.principal.name)?;
    let Some(seen) = observers::observed_servant(&*reach).await else {
        return Err(Error::NotThereYet(id));
    };
    let figures = Figures::start(seen);
    let (lines_of, received) = mpsc::channel(1);
    // Not one of the sessions that the daemon waits for: it ends with the daemon.
    tokio::spawn(async move {
        let service = handle.service().to_owned();
        let told = async {
            loop {
                tokio::time::sleep(LINE_PERIOD).await;
                // The servant has ended, or another has its id.
                let ended = app.choreographer.servant(&id).is_err();
                // Checked each time because rules may have changed.
                let standing = app.principals.inside_access(&caller.who, &service, part);
                let ConnectionAccess::Granted(grants) = standing else {
                    return;
                };
                if ended || lines_of.send(to_published_topics(&figures, &grants)).await.is_err() {
                    return;
                }
            }
        };
        tokio::select! {
            () = told => {}
            () = caller.wait_for_end(&app, &service) => {}
            () = lines_of.closed() => {}
        }
        drop(place);
    });
    Ok(json_lines(ReceiverStream::new(received)))
}

fn to_published_topics(figures: &Figures, grants: &Grants) -> PublishedTopics {
    let (span, mut all) = figures.take();
    all.retain(|figures| grants.permits(Operation::Subscribe, &figures.topic));
    let seconds = span.as_secs_f64().max(f64::MIN_POSITIVE);
    let topic = |figures: TopicFigures| PublishedTopic {
        topic: figures.topic,
        of: figures.of,
        rate: figures.messages as f64 / seconds,
        bandwidth: figures.bytes as f64 / seconds,
        latency: figures.age,
    };
    PublishedTopics { seconds, topics: all.into_iter().map(topic).collect() }
}
