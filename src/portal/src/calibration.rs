//! `POST /api/v1/services/NAME/calibration`: options in the query, a recording or pictures in the body, events as
//! JSON lines in the response.

use std::sync::Arc;
use std::time::Duration;

use api::calibration::Source;
use api::{CalibrationEvent, CalibrationOptions, Size};
use axum::Extension;
use axum::body::Body;
use axum::extract::{OriginalUri, Path, State};
use axum::response::Response;
use choreographer::{CalibrationRequests, CaptureBounds};
use futures_util::StreamExt;
use reach::{MAX_RECORDED, Material, Picture};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::task::AbortOnDropHandle;

use crate::app::App;
use crate::body::{BufferedBody, read_recording};
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::json_lines;
use crate::query::query_value;

/// Queue size of events that the client has not read.
const EVENTS_AHEAD: usize = 64;
/// Duration of capturing a robot's requests in seconds: default and maximum.
const SECONDS: f64 = 20.0;
const LONGEST: f64 = 600.0;
/// Default limit on the captured bytes.
const BYTES: Size = Size(256 << 20);
/// Maximum time in seconds that a servant is kept under its last limit.
const MAX_KEEP_TIME: f64 = 600.0;
/// Minimum memory limit in bytes that can be measured; nothing starts with less.
const LEAST_MEMORY: f64 = (16 << 20) as f64;
/// Maximum number of limits measured in one calibration, and of requests at each.
const MOST_LIMITS: usize = 32;
const MOST_REQUESTS: usize = 10_000;

/// Runs a calibration.
pub async fn calibration(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    OriginalUri(uri): OriginalUri,
    body: Body,
) -> Result<Response, Error> {
    let options = read_options(uri.query())?;
    app.catalogue.current_revision(&name)?;
    let given = match options.source {
        Source::Live => None,
        Source::Bag | Source::Frames => Some(read_recording(&app, &caller, body).await?),
    };
    let (events, receiver) = mpsc::channel(EVENTS_AHEAD);
    let ending = caller.wait_for_end(&app, &name);
    let work = async move {
        let outcome = async {
            let requests = match given {
                Some(held) => read_material(options.source, held, &events).await?,
                None => capture_live(&app, &caller, &name, &options, &events).await?,
            };
            let choreographer = &app.choreographer;
            let calibration = choreographer.calibrate(&name, requests, &options, &events);
            Ok::<_, Error>(calibration.await?)
        };
        let event = match outcome.await {
            Ok(calibration) => CalibrationEvent::Done { calibration: Box::new(calibration) },
            Err(error) => CalibrationEvent::Error { problem: error.problem() },
        };
        let _ = events.send(event).await;
    };
    // Owned by the response: if the client disconnects, the calibration is aborted with it.
    let work = AbortOnDropHandle::new(tokio::spawn(work));
    let events = ReceiverStream::new(receiver).take_until(Box::pin(ending));
    Ok(json_lines(events.map(move |event| {
        let _ = &work;
        event
    })))
}

async fn send_step(events: &mpsc::Sender<CalibrationEvent>, title: String) {
    let _ = events.send(CalibrationEvent::Step { title }).await;
}

/// Parses the body into messages.
async fn read_material(
    source: Source,
    held: BufferedBody,
    events: &mpsc::Sender<CalibrationEvent>,
) -> Result<CalibrationRequests, Error> {
    let BufferedBody { bytes, permit } = held;
    let reading = tokio::task::spawn_blocking(move || match source {
        Source::Frames => Picture::read_all(&bytes)
            .map(|(pictures, count)| (Some((pictures.len(), count)), Material::Pictures(pictures)))
            .map_err(|error| Error::BadRequest(error.to_string())),
        Source::Bag | Source::Live => ros::bag::read(&bytes, MAX_RECORDED)
            .map(|recorded| (None, Material::Bag(recorded)))
            .map_err(|error| Error::BadRequest(error.to_string())),
    });
    let (pictures, material) = reading.await.map_err(|_| Error::Internal("reading the input of a calibration"))??;
    if let Some((used, count)) = pictures.filter(|(used, count)| used < count) {
        send_step(events, format!("using the first {used} of {count} pictures: more do not fit into memory")).await;
    }
    Ok(CalibrationRequests {
        material,
        network: None,
        // The messages share the body's memory.
        permit,
    })
}

/// Captures what a robot sends.
async fn capture_live(
    app: &App,
    caller: &Caller,
    service: &str,
    options: &CalibrationOptions,
    events: &mpsc::Sender<CalibrationEvent>,
) -> Result<CalibrationRequests, Error> {
    let robot = options.robot.as_deref().unwrap_or_default();
    let bounds = CaptureBounds {
        time: Duration::from_secs_f64(options.seconds.unwrap_or(SECONDS)),
        bytes: options.bytes.unwrap_or(BYTES).0 as usize,
        messages: MAX_RECORDED,
    };
    send_step(
        events,
        format!("recording what robot {robot} sends to {service}, for at most {} s", bounds.time.as_secs_f64()),
    )
    .await;
    let budget = app.choreographer.memory().client(&caller.peer.budget_name(None));
    let captured = app.choreographer.capture(service, robot, bounds, &budget);
    Ok(captured.await?)
}

fn read_options(query_of: Option<&str>) -> Result<CalibrationOptions, Error> {
    let options = match query_value(query_of, "options") {
        Some(text) => serde_json::from_str(&text)
            .map_err(|error| Error::BadRequest(format!("the calibration's options cannot be read: {error}")))?,
        None => CalibrationOptions::default(),
    };
    check(&options)?;
    Ok(options)
}

/// Refuses options that cannot be measured.
fn check(options: &CalibrationOptions) -> Result<(), Error> {
    let refused = |words: String| Err(Error::BadRequest(words));
    let positive = |name: &str, value: Option<f64>, least: f64, most: f64| match value {
        Some(value) if !(least..=most).contains(&value) => {
            refused(format!("{name} = {value} is not between {least} and {most}"))
        }
        _ => Ok(()),
    };
    for cpus in &options.cpus {
        positive("cpus", Some(*cpus), 0.01, 4096.0)?;
    }
    if options.cpus.len() > MOST_LIMITS {
        return refused(format!("at most {MOST_LIMITS} limits are measured at once"));
    }
    positive("rate", options.rate, 0.01, 10_000.0)?;
    positive("seconds", options.seconds, 0.1, LONGEST)?;
    positive("keep", options.keep, 0.1, MAX_KEEP_TIME)?;
    let memory = options.memory.map(|memory| memory.0 as f64);
    positive("memory", memory, LEAST_MEMORY, f64::MAX)?;
    positive("network", options.network, 0.0, 3_600_000.0)?;
    let requests = options.requests.map(|requests| requests as f64);
    positive("requests", requests, 10.0, MOST_REQUESTS as f64)?;
    if options.own && !options.cpus.is_empty() {
        return refused("own and cpus exclude each other".to_owned());
    }
    if options.rate.is_some() && options.fast {
        return refused("rate and fast exclude each other".to_owned());
    }
    match (options.source, &options.robot) {
        (Source::Live, None) => refused("live needs robot, whose requests are recorded".to_owned()),
        (Source::Bag | Source::Frames, Some(_)) => refused("robot can be given with live only".to_owned()),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_that_cannot_be_measured_are_refused() {
        let read = |options: &str| {
            let query = form_urlencoded::Serializer::new(String::new()).append_pair("options", options).finish();
            read_options(Some(&query)).map_err(|error| error.problem().detail)
        };
        assert_eq!(read_options(None).expect("none"), CalibrationOptions::default());
        let live = read(r#"{"source":"live","robot":"r1","seconds":5}"#).expect("valid");
        assert_eq!((live.source, live.seconds), (Source::Live, Some(5.0)));
        for (options, words) in [
            (r#"{"cpus":[0.5,0]}"#, "cpus = 0 is not between 0.01 and 4096"),
            (r#"{"rate":-1}"#, "rate = -1"),
            (r#"{"seconds":1e9}"#, "seconds = 1000000000 is not between 0.1 and 600"),
            (r#"{"network":-3}"#, "network = -3"),
            (r#"{"keep":0}"#, "keep = 0 is not between"),
            (r#"{"memory":1024}"#, "memory = 1024 is not between"),
            (r#"{"requests":3}"#, "requests = 3 is not between 10 and 10000"),
            (r#"{"rate":5,"fast":true}"#, "exclude each other"),
            (r#"{"own":true,"cpus":[1]}"#, "exclude each other"),
            (r#"{"source":"live"}"#, "live needs robot"),
            (r#"{"robot":"r1"}"#, "with live only"),
            (r#"{"limits":[1]}"#, "`limits`"),
            (r#"{"source":"video"}"#, "`video`"),
        ] {
            let refused = read(options).expect_err(options);
            assert!(refused.contains(words), "{options}: {refused}");
        }
        let many = format!(r#"{{"cpus":[{}]}}"#, vec!["1"; 33].join(","));
        assert!(read(&many).expect_err("many").contains("32 limits"));
    }
}
