//! Files of the last seconds of servants, `HOME/recordings/NUMBER.mcap`: `GET /api/v1/recordings` lists them.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use access::{Action, Grants, Operation};
use api::recordings::Recording;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use axum::{Extension, Json};
use choreographer::Handle;
use futures_util::StreamExt;
use recording::Writer;
use serde::Deserialize;
use store::{NewEvent, RecordingRecord};
use tokio_util::io::ReaderStream;
use tokio_util::task::TaskTracker;
use utoipa::IntoParams;

use crate::api_v1::Answer;
use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use crate::inside::{self, Whose};
use crate::observers::BlackBoxOptions;
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

/// Writes what is kept of a servant into a file. To be awaited to its end: else the next one would begin while this one is written.
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
    let written =
        tokio::task::spawn_blocking(move || kept.write(Writer::of(&path, file, kept.format())?))
            .await;
    let frozen = match written {
        Ok(Ok(frozen)) => frozen,
        error => {
            remove_file(half).await;
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
        topics: Some(frozen.topics),
    };
    match admit(app, handle, &record).await {
        Ok(number) => record.id = number,
        Err(error) => {
            remove_file(half).await;
            return Err(error);
        }
    }
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

/// Makes room for a new file, and remembers it; its number. Its service may have been removed while it was written, and another may be of that
/// name by now: whose servant is gone, of that nothing is kept.
async fn admit(app: &App, handle: &Handle, record: &RecordingRecord) -> Result<u64, Error> {
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
                "the file has {}, and all of them may have {} (disk of [black_box])",
                api::Size(record.bytes),
                api::Size(options.disk)
            ),
        });
    }
    let known = app.state.recordings()?;
    for number in in_the_way(&known, record, options) {
        forget(app, number).await?;
    }
    Ok(app.state.add_recording(record)?)
}

/// The files that go for a new one, among those that there are, the newest first: of the service that takes most, the new one counted, the
/// oldest. However many files come of a service, they drive out none of those that take less.
fn in_the_way(
    known: &[RecordingRecord],
    new: &RecordingRecord,
    options: &BlackBoxOptions,
) -> Vec<u64> {
    let mut left: Vec<&RecordingRecord> = known.iter().collect();
    let mut gone = Vec::new();
    loop {
        let sum: u64 = left.iter().map(|one| one.bytes).sum();
        let many = left.len() >= options.files;
        if !many && sum.saturating_add(new.bytes) <= options.disk {
            return gone;
        }
        let taken = |service: &str| {
            let all = left.iter().copied().chain([new]);
            all.filter(|one| one.service == service)
                .map(|one| if many { 1 } else { one.bytes })
                .sum::<u64>()
        };
        // Of equals its own.
        let most = left
            .iter()
            .map(|one| one.service.as_str())
            .max_by_key(|service| (taken(service), *service == new.service));
        let oldest = left.iter().rposition(|one| Some(&*one.service) == most);
        let Some(oldest) = oldest else {
            return gone;
        };
        gone.push(left.remove(oldest).id);
    }
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

async fn remove_file(path: PathBuf) {
    let _ = privileged(move || std::fs::remove_file(path)).await;
}

async fn forget(app: &App, number: u64) -> Result<(), Error> {
    // Forgotten first: what is listed is there.
    if app.state.forget_recording(number)? {
        remove_file(path_of(app, number)).await;
    }
    Ok(())
}

/// Removes those of a service, which is there no more.
pub async fn forget_service(app: &App, service: &str) -> Result<(), Error> {
    // One that is being written is forgotten, too.
    let _turn = app.observers.writing.lock().await;
    let mut all = app.state.recordings()?;
    all.retain(|one| one.service == service);
    for one in all {
        forget(app, one.id).await?;
    }
    Ok(())
}

/// Removes files that nobody knows of, and those of services that there are not: of a daemon that was killed in between.
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

/// Refuses a file to who may not hear all that is in it: what somebody may not hear inside the robot's servants, it may not have later.
fn check_heard(app: &App, caller: &Caller, record: &RecordingRecord) -> Result<(), Error> {
    let grants = inside::grants(
        app,
        caller,
        Whose {
            service: &record.service,
            robot: &record.robot,
            object: format_args!("recording {}", record.id),
        },
    )?;
    match &record.topics {
        Some(topics) if may_hear(&grants, topics) => Ok(()),
        Some(_) => {
            let who = &caller.who.principal.name;
            Err(Error::Forbidden {
                what: format!(
                    "recording {} holds topics that {who} may not hear (granted: {grants}); an admin can grant them: cloudroidctl policy allow {who} 'subscribe:/**' --service {}",
                    record.id, record.service
                ),
            })
        }
        None => caller.may_at(app, Action::Operate, &record.service, None),
    }
}

/// Whether all of these may be heard.
fn may_hear(grants: &Grants, topics: &[String]) -> bool {
    let mut all = topics.iter();
    all.all(|topic| grants.permits(Operation::Subscribe, topic))
}

/// Those that the caller may have, the newest first.
fn seen(app: &App, caller: &Caller) -> Result<Vec<RecordingRecord>, Error> {
    let mut all = app.state.recordings()?;
    all.retain(|one| {
        caller.may_of(app, Action::See, &one.service, &one.robot)
            && check_heard(app, caller, one).is_ok()
    });
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

/// All files that the caller may have, the newest first.
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
    Extension(caller): Extension<Caller>,
    Path(number): Path<String>,
) -> Result<Response, Error> {
    let record = known(&app, &number)?;
    check_heard(&app, &caller, &record)?;
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
    // It breaks off when what was shown is not good any more.
    let ended = {
        let (app, service) = (Arc::clone(&app), record.service.clone());
        async move { app.principals.ended(&caller.who, &service, false).await }
    };
    let stream = stream.take_until(Box::pin(ended));
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
    app.observers.may_take(&id)?;
    let why = format!("{} asked for it", caller.who.principal.name);
    let taken = {
        let app = Arc::clone(&app);
        async move { write(&app, &handle, &why).await }
    };
    match to_its_end(&app.sessions, taken).await {
        Some(taken) => taken.map(Json),
        None => Err(Error::Internal("writing a recording")),
    }
}

/// What comes of it, also where whoever waits for that has left. None: it broke.
pub async fn to_its_end<T: Send + 'static>(
    tasks: &TaskTracker,
    work: impl Future<Output = T> + Send + 'static,
) -> Option<T> {
    tasks.spawn(work).await.ok()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use access::Grant;
    use futures_util::FutureExt;
    use tokio::sync::Notify;

    use super::*;

    fn record(id: u64, service: &str, bytes: u64) -> RecordingRecord {
        RecordingRecord {
            id,
            service: service.to_owned(),
            robot: "rover".to_owned(),
            servant: format!("{service}-1"),
            time: id,
            why: "a test".to_owned(),
            span: 1,
            messages: 1,
            bytes,
            topics: None,
        }
    }

    fn options(files: usize, disk: u64) -> BlackBoxOptions {
        BlackBoxOptions {
            span: Duration::from_secs(1),
            memory: 1,
            topics: Vec::new(),
            files,
            disk,
        }
    }

    #[test]
    fn the_service_that_takes_most_loses_its_oldest() {
        let gone = |all: &[(u64, &str, u64)], new: (&str, u64), (files, disk)| {
            let all: Vec<_> = all
                .iter()
                .map(|(id, service, bytes)| record(*id, service, *bytes))
                .collect();
            in_the_way(&all, &record(0, new.0, new.1), &options(files, disk))
        };
        let all = [
            (5, "busy", 10),
            (4, "busy", 10),
            (3, "busy", 10),
            (2, "quiet", 25),
            (1, "quiet", 1),
        ];
        // There is room.
        assert_eq!(gone(&all, ("busy", 4), (6, 60)), [] as [u64; 0]);
        // By number: the busy one has most, whoever comes.
        assert_eq!(gone(&all, ("busy", 1), (5, 60)), [3]);
        assert_eq!(gone(&all, ("new", 1), (5, 60)), [3]);
        assert_eq!(gone(&all, ("quiet", 1), (5, 60)), [1]);
        // By bytes.
        assert_eq!(gone(&all, ("busy", 10), (9, 60)), [3]);
        assert_eq!(gone(&all, ("new", 15), (9, 60)), [3, 1]);
        // One that needs so much alone.
        assert_eq!(gone(&all, ("busy", 40), (9, 60)), [3, 4, 5, 1, 2]);
        // However often the busy one comes, the quiet one's stay.
        let mut known = vec![record(1, "quiet", 10)];
        for id in 2..50 {
            let new = record(id, "busy", 10);
            let gone = in_the_way(&known, &new, &options(3, 1000));
            known.retain(|one| !gone.contains(&one.id));
            known.insert(0, new);
        }
        let left: Vec<_> = known.iter().map(|one| one.id).collect();
        assert_eq!(left, [49, 48, 1]);
    }

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
        assert!(may_hear(&narrow, &map));
        assert!(!may_hear(&narrow, &both));
        assert!(may_hear(&grants(&["subscribe:/**"]), &both));
        assert!(!may_hear(&grants(&["call:/**"]), &map));
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
        let mut waiting = Box::pin(to_its_end(&tasks, work));
        assert!((&mut waiting).now_or_never().is_none());
        drop(waiting);
        go.notify_one();
        done.notified().await;
    }
}
