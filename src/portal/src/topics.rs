//! `GET /api/v1/servants/ID/topics`: each second, what was published on each topic of a servant, until whoever asks leaves. To count it, all of
//! it is heard beside the servant's robot. Whoever asks is told of those topics that it may hear there.

use std::sync::Arc;
use std::time::Duration;

use access::{Grants, Operation, Standing};
use api::topics::{PublishedTopic, PublishedTopics};
use axum::Extension;
use axum::extract::{Path, State};
use axum::response::Response;
use observe::{Figures, TopicFigures};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use crate::api_v1::lines;
use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use crate::inside::{self, Whose};
use crate::observers;

/// What one line tells of.
const EACH: Duration = Duration::from_secs(1);

/// Figures of all topics, a line each second.
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
        let whose = Whose {
            service: handle.service(),
            robot: &handle.robot,
            object: format_args!("servant {id}"),
        };
        inside::part(&app, &caller, whose)?
    };
    let place = app.inside.place(&id, &caller.who.principal.name)?;
    let Some(seen) = observers::seen(&*reach).await else {
        return Err(Error::NotThereYet(id));
    };
    let figures = Figures::of(seen);
    let (lines_of, received) = mpsc::channel(1);
    // None of the sessions that the daemon waits for when it ends: it ends with the daemon.
    tokio::spawn(async move {
        let service = handle.service().to_owned();
        let told = async {
            loop {
                tokio::time::sleep(EACH).await;
                // There is none any more, or another of the same id.
                let ended = app.choreographer.servant(&id).is_err();
                // Asked anew each time: rules may have changed.
                let standing = app.principals.standing_inside(&caller.who, &service, part);
                let Standing::Granted(grants) = standing else {
                    return;
                };
                if ended || lines_of.send(told(&figures, &grants)).await.is_err() {
                    return;
                }
            }
        };
        tokio::select! {
            () = told => {}
            () = caller.over(&app, &service) => {}
            () = lines_of.closed() => {}
        }
        drop(place);
    });
    Ok(lines(ReceiverStream::new(received)))
}

fn told(figures: &Figures, grants: &Grants) -> PublishedTopics {
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
    PublishedTopics {
        seconds,
        topics: all.into_iter().map(topic).collect(),
    }
}
