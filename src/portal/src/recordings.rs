//! Files of the last seconds of servants, `HOME/recordings/NUMBER.mcap`: `GET /api/v1/recordings` lists them.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use access::Action;
use api::recordings::Recording;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use axum::{Extension, Json};
use choreographer::Handle;
use recording::Writer;
use serde::Deserialize;
use store::{NewEvent, RecordingRecord};
use tokio_util::io::ReaderStream;
use utoipa::IntoParams;

use crate::api_v1::Answer;
use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use crate::query::Query;

/// Where files are, below the state directory.
const DIRECTORY: &str = "recordings";
/// The one that is being written.
const HALF: &str = "half.mcap";
/// Event: a file was written.
const RECORDED: &str = "recorded";
/// Event: a file could not be written.
pub const NOT_RECORDED: &str = "not-recorded";
/// Bytes of a file that are sent at a time.
const CHUNK: usize = 256 << 10;

/// Which files.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct Which {
    /// Of this service.
    service: Option<String>,
    /// Of this robot.
    robot: Option<String>,
}

/// What events say they are about.
pub fn about(handle: &Handle) -> NewEvent<'_> {
    NewEvent {
        service: Some(handle.service()),
        servant: Some(&handle.id),
        robot: Some(&handle.robot),
    }
}

/// Writes what is kept of a servant into a file.
pub async fn write(app: &Arc<App>, handle: &Handle, why: &str) -> Result<Recording, Error> {
    let Some(kept) = app.observers.black_box(&handle.id) else {
        return Err(Error::NoBlackBox(handle.id.clone()));
    };
    let failed = |reason: String| Error::NotRecorded {
        servant: handle.id.clone(),
        reason,
    };
    let _turn = app.observers.writing.lock().await;
    let half = directory(app).join(HALF);
    // The directory is root's. What is written, strangers have said: only the file is made with root's rights.
    let path = half.clone();
    let file = privileged(move || make(&path)).await;
    let file = file.map_err(|error| failed(format!("{}: {error}", half.display())))?;
    let path = half.clone();
    let written = tokio::task::spawn_blocking(move || kept.write(Writer::of(&path, file)?)).await;
    let frozen = match written {
        Ok(Ok(frozen)) => frozen,
        error => {
            let path = half.clone();
            let _ = privileged(move || std::fs::remove_file(path)).await;
            return Err(failed(match error {
                Ok(Err(error)) => error.to_string(),
                _ => "the daemon's task broke".to_owned(),
            }));
        }
    };
    let mut record = RecordingRecord {
        id: 0,
        service: handle.service().to_owned(),
        robot: handle.robot.clone(),
        servant: handle.id.clone(),
        time: store::now(),
        why: why.to_owned(),
        span: u64::try_from(frozen.span.as_millis()).unwrap_or(u64::MAX),
        messages: frozen.summary.messages,
        bytes: frozen.summary.size,
    };
    make_room(app, record.bytes).await?;
    record.id = app.state.add_recording(&record)?;
    let whole = path_of(app, record.id);
    if let Err(error) = privileged(move || std::fs::rename(half, whole)).await {
        app.state.forget_recording(record.id)?;
        return Err(failed(error.to_string()));
    }
    let left_out = match frozen.left_out {
        0 => String::new(),
        many => format!("; {many} messages so far found no room (memory of [black_box])"),
    };
    let words = format!(
        "recording {}: the last {:.1} s ({} messages), because {why}{left_out}",
        record.id,
        frozen.span.as_secs_f64(),
        record.messages
    );
    let journal = app.choreographer.journal();
    journal.info(RECORDED, &words, &about(handle));
    Ok(told(record))
}

fn directory(app: &App) -> PathBuf {
    app.home.join(DIRECTORY)
}

fn path_of(app: &App, number: u64) -> PathBuf {
    directory(app).join(format!("{number}.mcap"))
}

/// Does this with root's rights.
async fn privileged<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> io::Result<T> {
    match privilege::blocking(work).await {
        Ok(done) => done,
        Err(error) => Err(io::Error::other(error)),
    }
}

fn make(path: &std::path::Path) -> io::Result<File> {
    if let Some(directory) = path.parent() {
        store::private::make_directory(directory)?;
    }
    let mut options = OpenOptions::new();
    // One that is there is of a daemon that was killed.
    options.write(true).create(true).truncate(true).open(path)
}

/// Removes the oldest files until there is room for one more of this size.
async fn make_room(app: &App, bytes: u64) -> Result<(), Error> {
    let options = &app.options.black_box;
    let mut known = app.state.recordings()?;
    let mut sum: u64 = known.iter().map(|one| one.bytes).sum();
    while let Some(oldest) = known.last()
        && (known.len() >= options.files || sum.saturating_add(bytes) > options.disk)
    {
        forget(app, oldest.id).await?;
        sum -= oldest.bytes;
        known.pop();
    }
    Ok(())
}

async fn forget(app: &App, number: u64) -> Result<(), Error> {
    // Forgotten first: what is listed is there.
    if app.state.forget_recording(number)? {
        let path = path_of(app, number);
        let _ = privileged(move || std::fs::remove_file(path)).await;
    }
    Ok(())
}

/// Removes those of a service.
pub async fn forget_service(app: &App, service: &str) -> Result<(), Error> {
    let mut all = app.state.recordings()?;
    all.retain(|one| one.service == service);
    for one in all {
        forget(app, one.id).await?;
    }
    Ok(())
}

/// Removes files that nobody knows of: of a daemon that was killed in between.
pub async fn sweep(app: &App) {
    let Ok(known) = app.state.recordings() else {
        return;
    };
    let directory = directory(app);
    let swept = privileged(move || {
        for file in std::fs::read_dir(directory)?.flatten() {
            let name = file.file_name();
            let is_known = known.iter().any(|one| *name == *format!("{}.mcap", one.id));
            if !is_known {
                let _ = std::fs::remove_file(file.path());
            }
        }
        Ok(())
    });
    // Where there is no directory, there is nothing to sweep.
    let _ = swept.await;
}

fn told(record: RecordingRecord) -> Recording {
    Recording {
        number: record.id,
        service: record.service,
        robot: record.robot,
        servant: record.servant,
        time: record.time,
        why: record.why,
        seconds: record.span as f64 / 1e3,
        messages: record.messages,
        bytes: api::Size(record.bytes),
    }
}

/// Those that the caller may see, the newest first.
fn seen(app: &App, caller: &Caller) -> Result<Vec<RecordingRecord>, Error> {
    let mut all = app.state.recordings()?;
    all.retain(|one| caller.may_of(app, Action::See, &one.service, &one.robot));
    Ok(all)
}

/// The one of this number, as it stands in an address.
pub fn known(app: &App, number: &str) -> Result<RecordingRecord, Error> {
    let mut all = app.state.recordings()?.into_iter();
    let found = number
        .parse()
        .ok()
        .and_then(|number: u64| all.find(|one| one.id == number));
    found.ok_or_else(|| Error::UnknownRecording(number.to_owned()))
}

/// All files that the caller may see, the newest first.
pub async fn list(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Query(which): Query<Which>,
) -> Answer<Vec<Recording>> {
    let mut all = seen(&app, &caller)?;
    let of =
        |wanted: &Option<String>, is: &str| wanted.as_deref().is_none_or(|wanted| wanted == is);
    all.retain(|one| of(&which.service, &one.service) && of(&which.robot, &one.robot));
    Ok(Json(all.into_iter().map(told).collect()))
}

/// A file.
pub async fn file(
    State(app): State<Arc<App>>,
    Path(number): Path<String>,
) -> Result<Response, Error> {
    let record = known(&app, &number)?;
    let path = path_of(&app, record.id);
    let opened = privileged(move || {
        let file = File::open(path)?;
        let size = file.metadata()?.len();
        Ok((file, size))
    });
    // It may have been removed by hand.
    let (file, size) = opened
        .await
        .map_err(|_| Error::UnknownRecording(number.clone()))?;
    let stream = ReaderStream::with_capacity(tokio::fs::File::from_std(file), CHUNK);
    let mut response = Response::new(Body::from_stream(stream));
    let headers = response.headers_mut();
    let kind = HeaderValue::from_static("application/octet-stream");
    headers.insert(header::CONTENT_TYPE, kind);
    headers.insert(header::CONTENT_LENGTH, size.into());
    let name = format!("attachment; filename=\"{}-{number}.mcap\"", record.service);
    if let Ok(name) = HeaderValue::from_str(&name) {
        headers.insert(header::CONTENT_DISPOSITION, name);
    }
    Ok(response)
}

/// Removes a file; gives those that are left.
pub async fn remove(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(number): Path<String>,
) -> Answer<Vec<Recording>> {
    forget(&app, known(&app, &number)?.id).await?;
    let left = seen(&app, &caller)?;
    Ok(Json(left.into_iter().map(told).collect()))
}

/// Writes a file of the last seconds of a servant now.
pub async fn take(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
) -> Answer<Recording> {
    let handle = app.choreographer.servant(&id)?;
    let why = format!("{} asked for it", caller.who.principal.name);
    write(&app, &handle, &why).await.map(Json)
}
