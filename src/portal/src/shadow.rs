//! `POST /api/v1/services/NAME/shadow`: options as JSON in the body, events as JSON lines in the response.

use std::sync::Arc;

use api::{ShadowEvent, ShadowOptions};
use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::response::Response;
use futures_util::StreamExt;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::task::AbortOnDropHandle;

use crate::app::App;
use crate::body::{LARGEST_WORDS, read_body};
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::json_lines;

/// Queue size of events that the client has not read.
const EVENTS_AHEAD: usize = 64;
/// Maximum duration of a comparison in seconds.
const LONGEST: f64 = 86_400.0;
/// Maximum number of fields left out.
const MOST_FIELDS: usize = 100;

/// Compares a revision with the one that a robot uses.
pub async fn shadow(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> Result<Response, Error> {
    let body = read_body(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let options: ShadowOptions = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the options cannot be read: {error}")))?;
    check(&options)?;
    app.catalogue.current_revision(&name)?;
    let (events, receiver) = mpsc::channel(EVENTS_AHEAD);
    let ending = caller.wait_for_end(&app, &name);
    let work = async move {
        let choreographer = &app.choreographer;
        let budget = choreographer.memory().client(&caller.peer.budget_name(None));
        let shadow = choreographer.shadow(&name, &options, &budget, &events);
        let event = match shadow.await {
            Ok(shadow) => ShadowEvent::Done { shadow: Box::new(shadow) },
            Err(error) => ShadowEvent::Error { problem: Error::from(error).problem() },
        };
        let _ = events.send(event).await;
    };
    // Owned by the response: if the client disconnects, the candidate is stopped with it.
    let work = AbortOnDropHandle::new(tokio::spawn(work));
    let events = ReceiverStream::new(receiver).take_until(Box::pin(ending));
    Ok(json_lines(events.map(move |event| {
        let _ = &work;
        event
    })))
}

/// Refuses options that make no comparison possible.
fn check(options: &ShadowOptions) -> Result<(), Error> {
    let refused = |words: String| Err(Error::BadRequest(words));
    let between = |name: &str, value: f64, least: f64, most: f64| match value {
        value if (least..=most).contains(&value) => Ok(()),
        value => refused(format!("{name} = {value} is not between {least} and {most}")),
    };
    if options.revision == 0 {
        return refused("revision says which one is the candidate; they are counted from 1".to_owned());
    }
    between("seconds", options.seconds, 0.1, LONGEST)?;
    between("tolerance", options.tolerance, 0.0, 1e9)?;
    between("bound", options.bound, 0.0, 1e6)?;
    if options.requests == Some(0) {
        return refused("requests = 0 would compare nothing".to_owned());
    }
    if options.ignore.len() > MOST_FIELDS {
        return refused(format!("at most {MOST_FIELDS} fields may be left out"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_that_make_no_comparison_are_refused() {
        let good = ShadowOptions { revision: 2, ..ShadowOptions::default() };
        check(&good).expect("a comparison");
        type Spoil = fn(&mut ShadowOptions);
        let spoilt: [(Spoil, &str); 8] = [
            (|options| options.revision = 0, "counted from 1"),
            (|options| options.seconds = 0.0, "seconds = 0"),
            (|options| options.seconds = f64::NAN, "seconds = NaN"),
            (|options| options.tolerance = -1.0, "tolerance = -1"),
            (|options| options.tolerance = f64::INFINITY, "tolerance"),
            (|options| options.bound = -0.1, "bound = -0.1"),
            (|options| options.requests = Some(0), "requests = 0"),
            (|options| options.ignore = vec!["x".to_owned(); 101], "100 fields"),
        ];
        for (spoil, words) in spoilt {
            let mut options = good.clone();
            spoil(&mut options);
            let refused = check(&options).expect_err(words).to_string();
            assert!(refused.contains(words), "{refused}");
        }
    }
}
