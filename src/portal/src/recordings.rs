//! Recordings of the last seconds of servants, in `HOME/recordings/NUMBER.mcap`; listed by `GET /api/v1/recordings`.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use access::{AccessAction, Grants, Operation};
use api::recordings::Recording;
use axum::extract::{Path, State};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use axum::{Extension, Json};
use choreographer::{Handle, Quota, QuotaFile, find_files_to_evict};
use recording::RecordingWriter;
use serde::Deserialize;
use store::{NewEvent, RecordingRecord};
use tokio_util::task::TaskTracker;
use utoipa::IntoParams;

use crate::app::App;
use crate::body::file_body;
use crate::caller::Caller;
use crate::errors::Error;
use crate::inside::{self, InsideTarget};
use crate::json::JsonResult;
use crate::observers::servants::BlackBoxOptions;
use crate::query::Query;

/// Directory of the recordings, below the state directory.
const DIRECTORY: &str = "recordings";
/// Name of the file being written.
const HALF: &str = "half.mcap";
/// Event kind: a recording was written.
const RECORDED_EVENT: &str = "recorded";
/// Event kind: a recording could not be written.
pub const NOT_RECORDED: &str = "not-recorded";

/// Query: which recordings.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct RecordingQuery {
    /// Only recordings of this service.
    service: Option<String>,
    /// Only recordings of this robot.
    robot: Option<String>,
}

/// Returns the subject of events about a servant.
pub fn event_subject(handle: &Handle) -> NewEvent<'_> {
    NewEvent { service: Some(handle.service()), servant: Some(&handle.id), robot: Some(&handle.robot) }
}

/// Writes a servant's black box to a file. Must be polled to completion: otherwise the next recording would start
/// while this one is still written.
pub async fn write_recording(app: &Arc<App>, handle: &Handle, why: &str) -> Result<Recording, Error> {
    let Some(kept) = app.observers.black_box(&handle.id) else {
        return Err(Error::NoBlackBox(handle.id.clone()));
    };
    let failed = |reason: String| Error::NotRecorded { servant: handle.id.clone(), reason };
    let _turn = app.observers.writing.lock().await;
    let half = directory(app).join(HALF);
    // The directory belongs to root. The content comes from strangers, so only creating the file needs root's
    // privileges.
    let path = half.clone();
    let file = run_privileged(move || create_file(&path)).await;
    let file = file.map_err(|error| failed(format!("{}: {error}", half.display())))?;
    let path = half.clone();
    let written =
        tokio::task::spawn_blocking(move || kept.write(RecordingWriter::from_file(&path, file, kept.format())?)).await;
    let frozen = match written {
        Ok(Ok(frozen)) => frozen,
        error => {
            remove_file(half).await;
            return Err(failed(match error {
                Ok(Err(error)) => error.to_string(),
                _ => "a task of the daemon failed".to_owned(),
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
        topics: Some(frozen.topics),
    };
    match admit_recording(app, handle, &record).await {
        Ok(number) => record.id = number,
        Err(error) => {
            remove_file(half).await;
            return Err(error);
        }
    }
    let whole = recording_path(app, record.id);
    if let Err(error) = run_privileged(move || std::fs::rename(half, whole)).await {
        app.state.forget_recording(record.id)?;
        return Err(failed(error.to_string()));
    }
    let left_out = match frozen.left_out {
        0 => String::new(),
        many => format!("; so far {} did not fit (memory in [black_box])", api::count(many, "message")),
    };
    let words = format!(
        "recording {}: the last {:.1} s ({}), because {why}{left_out}",
        record.id,
        frozen.span.as_secs_f64(),
        api::count(record.messages, "message")
    );
    let journal = app.choreographer.journal();
    journal.info(RECORDED_EVENT, &words, &event_subject(handle));
    Ok(to_api_recording(record))
}

/// Makes room for a new file, records it and returns its number. The service may have been removed while the file was
/// written, and another may have its name by now; if the servant is gone, nothing is kept.
async fn admit_recording(app: &App, handle: &Handle, record: &RecordingRecord) -> Result<u64, Error> {
    let now = app.choreographer.servant(&handle.id)?;
    let is_published = app.state.service_package(handle.service())?.is_some();
    if !is_published || !std::ptr::eq(Arc::as_ptr(&now), handle) {
        return Err(Error::NotThereYet(handle.id.clone()));
    }
    let options = &app.options.black_box;
    if record.bytes > options.disk {
        return Err(Error::NotRecorded {
            servant: handle.id.clone(),
            reason: format!(
                "the file has {}, but all recordings together may have {} (disk in [black_box])",
                api::Size(record.bytes),
                api::Size(options.disk)
            ),
        });
    }
    let known = app.state.recordings()?;
    let evicted = files_to_evict(&known, record, options).ok_or_else(|| Error::NotRecorded {
        servant: handle.id.clone(),
        reason: format!(
            "the file has {}, and the recordings of services that use less leave no room for it in the {} of all (disk \
             and files in [black_box]); remove some (cloudroidctl recordings rm)",
            api::Size(record.bytes),
            api::Size(options.disk)
        ),
    })?;
    for number in evicted {
        forget_recording(app, number).await?;
    }
    Ok(app.state.add_recording(record)?)
}

/// Returns the files to remove for a new one, or `None` if that is not to be kept. `known` lists the existing files,
/// newest first.
fn files_to_evict(known: &[RecordingRecord], new: &RecordingRecord, options: &BlackBoxOptions) -> Option<Vec<u64>> {
    fn file(one: &RecordingRecord) -> QuotaFile<'_> {
        QuotaFile { owner: "", service: &one.service, bytes: one.bytes }
    }
    let files: Vec<QuotaFile<'_>> = known.iter().map(file).collect();
    let quota = Quota { files: options.files, bytes: options.disk };
    let evicted = find_files_to_evict(&files, file(new), quota)?;
    Some(evicted.into_iter().map(|place| known[place].id).collect())
}

fn directory(app: &App) -> PathBuf {
    app.home.join(DIRECTORY)
}

fn recording_path(app: &App, number: u64) -> PathBuf {
    directory(app).join(format!("{number}.mcap"))
}

/// Runs `work` with root's privileges.
async fn run_privileged<T: Send + 'static>(work: impl FnOnce() -> io::Result<T> + Send + 'static) -> io::Result<T> {
    match privilege::spawn_blocking(work).await {
        Ok(done) => done,
        Err(error) => Err(io::Error::other(error)),
    }
}

fn create_file(path: &std::path::Path) -> io::Result<File> {
    if let Some(directory) = path.parent() {
        store::private::make_directory(directory)?;
    }
    let mut options = OpenOptions::new();
    // An existing file was left by a daemon that was killed.
    options.write(true).create(true).truncate(true).open(path)
}

async fn remove_file(path: PathBuf) {
    let _ = run_privileged(move || std::fs::remove_file(path)).await;
}

async fn forget_recording(app: &App, number: u64) -> Result<(), Error> {
    // The record is removed first, so that every listed recording exists.
    if app.state.forget_recording(number)? {
        remove_file(recording_path(app, number)).await;
    }
    Ok(())
}

/// Removes the recordings of a service that no longer exists.
pub async fn forget_service(app: &App, service: &str) -> Result<(), Error> {
    // Waits for one being written, to remove it as well.
    let _turn = app.observers.writing.lock().await;
    let mut all = app.state.recordings()?;
    all.retain(|one| one.service == service);
    for one in all {
        forget_recording(app, one.id).await?;
    }
    Ok(())
}

/// Removes orphaned files, and recordings of services that no longer exist, as left by a daemon that was killed.
pub async fn sweep(app: &App) {
    let _turn = app.observers.writing.lock().await;
    let Ok(mut known) = app.state.recordings() else {
        return;
    };
    known.retain(|one| {
        let is_gone = matches!(app.state.service_package(&one.service), Ok(None));
        !(is_gone && app.state.forget_recording(one.id).is_ok())
    });
    let directory = directory(app);
    let swept = run_privileged(move || {
        for file in std::fs::read_dir(directory)?.flatten() {
            let name = file.file_name();
            let is_known = known.iter().any(|one| *name == *format!("{}.mcap", one.id));
            if !is_known {
                let _ = std::fs::remove_file(file.path());
            }
        }
        Ok(())
    });
    // Without a directory there is nothing to sweep.
    let _ = swept.await;
}

fn to_api_recording(record: RecordingRecord) -> Recording {
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

/// Refuses a recording to callers who may not subscribe to all its topics: what a caller may not see inside the
/// robot's servants, it may not see later either.
fn check_topics(app: &App, caller: &Caller, record: &RecordingRecord) -> Result<(), Error> {
    let grants = inside::inside_grants(
        app,
        caller,
        InsideTarget {
            service: &record.service,
            robot: &record.robot,
            object: format_args!("recording {}", record.id),
        },
    )?;
    match &record.topics {
        Some(topics) if can_hear_all(&grants, topics) => Ok(()),
        Some(_) => {
            let who = &caller.who.principal.name;
            Err(Error::Forbidden {
                what: format!(
                    "recording {} contains topics that {who} may not subscribe to (granted: {grants}); an admin can \
                        grant them: cloudroidctl policy allow {who} 'subscribe:/**' --service {}",
                    record.id, record.service
                ),
            })
        }
        None => caller.check_service_access(app, AccessAction::Operate, &record.service, None),
    }
}

/// Returns true if all topics may be subscribed to.
fn can_hear_all(grants: &Grants, topics: &[String]) -> bool {
    let mut all = topics.iter();
    all.all(|topic| grants.permits(Operation::Subscribe, topic))
}

/// Returns the recordings that the caller may have, newest first.
fn visible_recordings(app: &App, caller: &Caller) -> Result<Vec<RecordingRecord>, Error> {
    let mut all = app.state.recordings()?;
    all.retain(|one| {
        caller.is_allowed_for_robot(app, AccessAction::See, &one.service, &one.robot)
            && check_topics(app, caller, one).is_ok()
    });
    Ok(all)
}

/// Returns the recording with this number, as written in a path.
pub fn find_recording(app: &App, number: &str) -> Result<RecordingRecord, Error> {
    let mut all = app.state.recordings()?.into_iter();
    let found = number.parse().ok().and_then(|number: u64| all.find(|one| one.id == number));
    found.ok_or_else(|| Error::UnknownRecording(number.to_owned()))
}

/// Lists the recordings that the caller may have, newest first.
pub async fn list(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Query(which): Query<RecordingQuery>,
) -> JsonResult<Vec<Recording>> {
    let mut all = visible_recordings(&app, &caller)?;
    let of = |wanted: &Option<String>, is: &str| wanted.as_deref().is_none_or(|wanted| wanted == is);
    all.retain(|one| of(&which.service, &one.service) && of(&which.robot, &one.robot));
    Ok(Json(all.into_iter().map(to_api_recording).collect()))
}

/// Downloads a recording.
pub async fn file(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(number): Path<String>,
) -> Result<Response, Error> {
    let record = find_recording(&app, &number)?;
    check_topics(&app, &caller, &record)?;
    let path = recording_path(&app, record.id);
    let opened = run_privileged(move || {
        let file = File::open(path)?;
        let size = file.metadata()?.len();
        Ok((file, size))
    });
    // The file may have been removed by hand.
    let (file, size) = opened.await.map_err(|_| Error::UnknownRecording(number.clone()))?;
    // The download is cut off when the caller's credential becomes invalid.
    let mut response = Response::new(file_body(file, caller.wait_for_end(&app, &record.service)));
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

/// Removes a recording and returns those that are left.
pub async fn remove(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(number): Path<String>,
) -> JsonResult<Vec<Recording>> {
    forget_recording(&app, find_recording(&app, &number)?.id).await?;
    let left = visible_recordings(&app, &caller)?;
    Ok(Json(left.into_iter().map(to_api_recording).collect()))
}

/// Records the last seconds of a servant now.
pub async fn take(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
) -> JsonResult<Recording> {
    let handle = app.choreographer.servant(&id)?;
    app.observers.check_take(&id)?;
    let why = format!("{} asked for it", caller.who.principal.name);
    let taken = {
        let app = Arc::clone(&app);
        async move { write_recording(&app, &handle, &why).await }
    };
    match run_to_end(&app.sessions, taken).await {
        Some(taken) => taken.map(Json),
        None => Err(Error::Internal("writing a recording")),
    }
}

/// Runs `work` to completion even if the caller stops waiting. Returns `None` if it panicked.
pub async fn run_to_end<T: Send + 'static>(
    tasks: &TaskTracker,
    work: impl Future<Output = T> + Send + 'static,
) -> Option<T> {
    tasks.spawn(work).await.ok()
}

#[cfg(test)]
mod tests {
    use access::Grant;
    use futures_util::FutureExt;
    use tokio::sync::Notify;

    use super::*;

    #[test]
    fn a_file_is_had_by_who_may_hear_all_that_is_in_it() {
        let grants = |all: &[&str]| {
            let all = all.iter().map(|grant| grant.parse::<Grant>());
            Grants::new(all.map(|grant| grant.expect("a grant")))
        };
        let topics = |all: &[&str]| all.iter().map(|topic| (*topic).to_owned()).collect();
        let map: Vec<String> = topics(&["/map"]);
        let both: Vec<String> = topics(&["/map", "/camera/image"]);
        let narrow = grants(&["subscribe:/map", "publish:/camera/**"]);
        assert!(can_hear_all(&narrow, &map));
        assert!(!can_hear_all(&narrow, &both));
        assert!(can_hear_all(&grants(&["subscribe:/**"]), &both));
        assert!(!can_hear_all(&grants(&["call:/**"]), &map));
    }

    #[tokio::test]
    async fn what_was_begun_is_done_when_nobody_waits_any_more() {
        let tasks = TaskTracker::new();
        let (go, done) = (Arc::new(Notify::new()), Arc::new(Notify::new()));
        let work = {
            let (go, done) = (Arc::clone(&go), Arc::clone(&done));
            async move {
                go.notified().await;
                done.notify_one();
            }
        };
        let mut waiting = Box::pin(run_to_end(&tasks, work));
        assert!((&mut waiting).now_or_never().is_none());
        drop(waiting);
        go.notify_one();
        done.notified().await;
    }
}
