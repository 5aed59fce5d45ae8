//! `/api/v1`: what cloudroidctl and the page ask.

use std::collections::BTreeMap;
use std::sync::Arc;

use access::{Action, Object};
use api::{NDJSON, Rollback, ServiceDetail, Status, Stopped};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use futures_util::StreamExt;
use reach::{Material, Picture};
use serde::Deserialize;
use servant::engine::LogStart;
use tokio_stream::wrappers::ReceiverStream;
use utoipa::{IntoParams, ToSchema};

use super::audit::About;
use super::body::{self, Held};
use super::guard::Caller;
use crate::app::App;
use crate::errors::Error;
use crate::query::Query;
use crate::{recordings, views};

pub(super) type Answer<T> = Result<Json<T>, Error>;

/// Lines of a log when nobody says how many.
const LOG_LINES: usize = 10_000;
/// Bytes that a line of a log takes beside its text, about.
const LOG_LINE: usize = 150;

/// `/healthz`.
pub async fn health(State(app): State<Arc<App>>) -> Result<&'static str, Error> {
    app.state.service_names()?;
    Ok("ok\n")
}

/// The daemon at a glance.
pub async fn status(State(app): State<Arc<App>>) -> Answer<Status> {
    Ok(Json(views::status(&app).await?))
}

/// The time here.
pub async fn clock() -> Json<api::Clock> {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    Json(api::Clock {
        now: since.map_or(0.0, |since| since.as_secs_f64() * 1000.0),
    })
}

/// All checks of the machine, made anew.
pub async fn doctor(State(app): State<Arc<App>>) -> Answer<api::Doctor> {
    let doctor = privilege::blocking(move || (app.examine)())
        .await
        .map_err(|_| Error::Internal("examining the machine"))?;
    Ok(Json(doctor))
}

/// All services.
pub async fn services(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> Answer<Vec<api::ServiceSummary>> {
    let mut services = Vec::new();
    for name in app.state.service_names()? {
        if !caller.sees(&app, &name) {
            continue;
        }
        if let Some(revision) = app.state.current(&name)? {
            services.push(views::summary(&app, &revision));
        }
    }
    Ok(Json(services))
}

/// One service.
pub async fn service(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
) -> Answer<ServiceDetail> {
    Ok(Json(views::service(&app, &name)?))
}

/// A service's interface with all definitions.
pub async fn interface(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
) -> Answer<package::interface::Interface> {
    Ok(Json(app.catalogue.current(&name)?.interface.clone()))
}

/// Which revision.
#[derive(Debug, Deserialize, IntoParams)]
pub struct OfRevision {
    /// Its number; that of the current one by default.
    revision: Option<u64>,
}

/// What of a revision is not in its image.
pub async fn record(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Query(of): Query<OfRevision>,
) -> Answer<push::ServiceRecord> {
    let current = app.catalogue.current(&name)?;
    let revision = match of.revision {
        Some(number) => app.catalogue.revision(&name, number)?,
        None => current,
    };
    let rows = app.state.dictionary(&name)?;
    Ok(Json(push::ServiceRecord::of(&revision, rows)))
}

/// Removes a service, its servants and its images.
pub async fn remove_service(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
) -> Answer<Stopped> {
    app.catalogue.current(&name)?;
    let removed = {
        let app = Arc::clone(&app);
        async move {
            let stopped = app.pusher.remove(&name).await?;
            // The next of this name may be somebody else's.
            recordings::forget_service(&app, &name).await?;
            Ok(Json(Stopped { stopped }))
        }
    };
    let removed = recordings::to_its_end(&app.sessions, removed).await;
    removed.unwrap_or(Err(Error::Internal("removing a service")))
}

/// Makes an earlier revision the current one.
pub async fn rollback(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<ServiceDetail> {
    let body = held(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let asked: Rollback = if body.is_empty() {
        Rollback::default()
    } else {
        serde_json::from_slice(&body)
            .map_err(|error| Error::BadRequest(format!("the rollback cannot be read: {error}")))?
    };
    let current = app.pusher.rollback(&name, asked.revision).await?;
    about.is(format!("service {name}: to revision {current}"));
    Ok(Json(views::service(&app, &name)?))
}

/// How a service comes to its next revision.
pub async fn rollout(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
) -> Answer<api::Rollout> {
    Ok(Json(app.choreographer.rollout(&name)?))
}

/// Begins a rollout, promotes its canary, or takes it back.
pub async fn order_rollout(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<api::Rollout> {
    use api::rollout::RolloutOrder;
    let body = held(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let order: RolloutOrder = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the order cannot be read: {error}")))?;
    about.is_set(&format!("service {name}"), &order);
    let choreographer = &app.choreographer;
    Ok(Json(match order {
        RolloutOrder::Start { revision, terms } => {
            choreographer
                .begin_rollout(&name, None, revision, terms)
                .await?
        }
        RolloutOrder::Promote => choreographer.promote_rollout(&name).await?,
        RolloutOrder::Abort => choreographer.abort_rollout(&name).await?,
    }))
}

/// The largest recording for a trial or a calibration, where its sender may have so much: it is held in memory.
const LARGEST_TRIAL: usize = 512 << 20;
/// The longest of other bodies.
pub(super) const LARGEST_WORDS: usize = 64 << 10;

/// A body, within what its sender may have held.
pub(super) async fn held(
    app: &App,
    caller: &Caller,
    body: Body,
    max: usize,
) -> Result<Held, Error> {
    let memory = app.choreographer.memory();
    let budget = memory.client(&caller.peer.client(None));
    body::read(body, max, &budget, memory.unfinished).await
}

/// A recording or pictures.
pub(super) async fn recording(app: &App, caller: &Caller, body: Body) -> Result<Held, Error> {
    let memory = app.choreographer.memory();
    let max = LARGEST_TRIAL.min(memory.client(&caller.peer.client(None)).most());
    let read = held(app, caller, body, max).await;
    read.map_err(|error| match error {
        Error::BodyTooLarge { limit } => Error::TrialTooLarge { limit },
        error => error,
    })
}

/// With what a service is tried.
#[derive(Debug, Deserialize, IntoParams)]
pub struct With {
    /// What the body is.
    #[param(inline)]
    kind: Kind,
}

#[derive(Debug, Clone, Copy, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
enum Kind {
    /// A recording (rosbag 2.0).
    Bag,
    /// A picture (PNG).
    Image,
}

/// What a robot would state; auxiliary parameters are `aux.KEY`.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Statement {
    /// T_desire, such as `100ms`.
    rrt: Option<String>,
    /// T_max.
    max_rrt: Option<String>,
    /// Frames per second.
    fps: Option<String>,
    /// Age of an output.
    age: Option<String>,
    /// A class of the configuration.
    class: Option<String>,
    /// Cores outright.
    cpus: Option<String>,
    /// Memory outright.
    memory: Option<String>,
    #[serde(flatten)]
    #[param(ignore)]
    others: BTreeMap<String, String>,
}

impl Statement {
    fn read(self) -> Result<api::Stated, Error> {
        let known = [
            ("rrt", self.rrt),
            ("max_rrt", self.max_rrt),
            ("fps", self.fps),
            ("age", self.age),
            ("class", self.class),
            ("cpus", self.cpus),
            ("memory", self.memory),
        ];
        let known = known
            .into_iter()
            .filter_map(|(key, value)| Some((key.to_owned(), value?)));
        api::Stated::read(known.chain(self.others)).map_err(Error::Unstatable)
    }
}

/// Whether one more servant of a service would fit.
pub async fn fit(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Query(statement): Query<Statement>,
    Extension(caller): Extension<Caller>,
) -> Answer<api::Fit> {
    let mut fit = app.choreographer.fit(&name, statement.read()?).await?;
    let sees = |id: &str| {
        let servant = app.choreographer.servant(id);
        servant.is_ok_and(|servant| caller.sees_servant(&app, &servant))
    };
    fit.costs.retain(|cost| sees(&cost.servant));
    fit.ends.retain(|id| sees(id));
    Ok(Json(fit))
}

/// What a service makes of a recording or a picture, and how fast.
pub async fn trial(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Query(with): Query<With>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> Answer<api::trial::Trial> {
    let Held { bytes, permit } = recording(&app, &caller, body).await?;
    let material = tokio::task::spawn_blocking(move || match with.kind {
        Kind::Image => Picture::read(&bytes)
            .map(|picture| Material::Pictures(vec![picture]))
            .map_err(|error| Error::BadRequest(error.to_string())),
        Kind::Bag => ros::bag::read(&bytes, reach::RECORDED)
            .map(Material::Bag)
            .map_err(|error| Error::BadRequest(error.to_string())),
    });
    let material = material
        .await
        .map_err(|_| Error::Internal("reading what a service is tried with"))??;
    let trial = app.choreographer.trial(&name, material).await;
    // Messages of a recording were cut from the body.
    drop(permit);
    Ok(Json(trial?))
}

/// All servants.
pub async fn servants(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> Json<Vec<api::Servant>> {
    let mut handles = app.choreographer.servants();
    handles.retain(|handle| caller.sees_servant(&app, handle));
    let described = handles
        .iter()
        .map(|handle| app.choreographer.describe(handle));
    Json(futures_util::future::join_all(described).await)
}

/// Whose servants have failed again and again, and are not started again yet.
pub async fn back_offs(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> Json<Vec<api::BackOff>> {
    let mut back_offs = app.choreographer.back_offs();
    back_offs.retain(|of| caller.is_robot_of(&of.robot) && caller.sees(&app, &of.service));
    Json(back_offs)
}

/// One servant.
pub async fn servant(State(app): State<Arc<App>>, Path(id): Path<String>) -> Answer<api::Servant> {
    let handle = app.choreographer.servant(&id)?;
    Ok(Json(app.choreographer.describe(&handle).await))
}

/// Changes limits of one servant while it runs.
pub async fn set_limits(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<api::Servant> {
    let body = held(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let change: api::Limits = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the limits cannot be read: {error}")))?;
    about.is_set(&format!("servant {id}"), &change);
    choreographer::limits::check(&change).map_err(|error| Error::BadRequest(error.to_string()))?;
    let moves_cores = change.cpu_weight.is_some() || change.cpus.is_some();
    if moves_cores && !caller.who.principal.is_unscoped() {
        let asked = app.choreographer.servant(&id)?.asked_after(change);
        choreographer::limits::check_weight(&asked)
            .map_err(|error| Error::BadRequest(error.to_string()))?;
    }
    app.choreographer.set_limits(&id, change).await?;
    let handle = app.choreographer.servant(&id)?;
    Ok(Json(app.choreographer.describe(&handle).await))
}

/// Why a robot is slow, or on its local original.
pub async fn explain(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
) -> Answer<api::explain::Explanation> {
    Ok(Json(crate::explain::robot(&app, &caller, &name).await?))
}

/// Ends one servant.
pub async fn stop_servant(State(app): State<Arc<App>>, Path(id): Path<String>) -> Answer<Stopped> {
    app.choreographer.servant(&id)?;
    Ok(Json(Stopped {
        stopped: app
            .choreographer
            .stop("it was stopped", |handle| handle.id == id)
            .await,
    }))
}

/// Whose servants.
#[derive(Debug, Deserialize, IntoParams)]
pub struct OfService {
    /// Only those of this service.
    service: Option<String>,
}

/// Ends all servants, or all of one service.
pub async fn stop_servants(
    State(app): State<Arc<App>>,
    Query(of): Query<OfService>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
) -> Answer<Stopped> {
    about.is(match &of.service {
        Some(service) => format!("servants of service {service}"),
        None => "all servants".to_owned(),
    });
    match &of.service {
        Some(service) => caller.may_at(&app, Action::Operate, service, None)?,
        None => caller.may(Action::Operate, &Object::MACHINE)?,
    }
    if let Some(service) = &of.service {
        app.catalogue.current(service)?;
    }
    let chosen = |handle: &choreographer::Handle| {
        of.service
            .as_ref()
            .is_none_or(|service| handle.service() == service)
    };
    Ok(Json(Stopped {
        stopped: app.choreographer.stop("it was stopped", chosen).await,
    }))
}

/// Which part of a log.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Part {
    /// Go on as lines come.
    #[serde(default)]
    follow: bool,
    /// So many of the last lines; 10000 by default.
    tail: Option<usize>,
}

/// What a servant's nodes print, as JSON lines.
pub async fn logs(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Query(part): Query<Part>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let handle = app.choreographer.servant(&id)?;
    handle.check_container()?;
    let Some(container) = handle.container() else {
        return Ok(lines(futures_util::stream::empty::<api::LogLine>()));
    };
    let count = part.tail.unwrap_or(LOG_LINES);
    // Whoever reads slowly keeps files open and lines in memory for as long.
    let place = app.live.place(&caller)?;
    if part.follow {
        let printed = ReceiverStream::new(container.follow(LogStart::Last(count)));
        let printed = printed.map(move |line| {
            let _held = &place;
            views::log_line(line)
        });
        // A follower must not keep the daemon from ending.
        let ending = caller.over(&app, handle.service());
        return Ok(lines(printed.take_until(ending)));
    }
    let past = container.logs(count, None).await;
    let budget = app.choreographer.memory().client(&caller.peer.client(None));
    let held = budget.take(past.iter().map(|line| line.line.len() + LOG_LINE).sum())?;
    let past = futures_util::stream::iter(past).map(move |line| {
        let _held = (&place, &held);
        views::log_line(line)
    });
    Ok(lines(past))
}

/// A stream of values as JSON lines.
pub fn lines<T: serde::Serialize + Send + 'static>(
    values: impl futures_util::Stream<Item = T> + Send + 'static,
) -> Response {
    let encoded = values.map(|value| {
        let mut line = serde_json::to_vec(&value)?;
        line.push(b'\n');
        Ok::<_, serde_json::Error>(line)
    });
    ([(header::CONTENT_TYPE, NDJSON)], Body::from_stream(encoded)).into_response()
}
