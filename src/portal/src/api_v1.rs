//! Handlers of `/api/v1`, used by cloudroidctl and the page.

use std::sync::Arc;

use access::{AccessAction, AccessObject};
use api::{Rollback, ServiceDetail, Status, Stopped};
use axum::body::Body;
use axum::extract::{OriginalUri, Path, State};
use axum::{Extension, Json};
use reach::{Material, Picture};
use serde::Deserialize;
use utoipa::{IntoParams, ToSchema};

use super::audit::AuditObject;
use super::body::{BufferedBody, LARGEST_WORDS, read_body, read_recording};
use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::JsonResult;
use crate::query::{Query, query_pairs};
use crate::{recordings, views};

/// `/healthz`.
pub async fn health(State(app): State<Arc<App>>) -> Result<&'static str, Error> {
    app.state.service_names()?;
    Ok("ok\n")
}

/// The daemon's status.
pub async fn status(State(app): State<Arc<App>>) -> JsonResult<Status> {
    Ok(Json(views::status(&app).await?))
}

/// The daemon's clock.
pub async fn clock() -> Json<api::Clock> {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    Json(api::Clock { now: since.map_or(0.0, |since| since.as_secs_f64() * 1000.0) })
}

/// Runs all checks of the machine anew.
pub async fn doctor(State(app): State<Arc<App>>) -> JsonResult<api::Doctor> {
    let doctor = privilege::spawn_blocking(move || (app.examine)())
        .await
        .map_err(|_| Error::Internal("examining the machine"))?;
    Ok(Json(doctor))
}

/// Lists all services.
pub async fn services(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> JsonResult<Vec<api::ServiceSummary>> {
    let mut services = Vec::new();
    for name in app.state.service_names()? {
        if !caller.can_see(&app, &name) {
            continue;
        }
        if let Some(revision) = app.state.current_revision(&name)? {
            services.push(views::summary(&app, &revision));
        }
    }
    Ok(Json(services))
}

/// One service.
pub async fn service(State(app): State<Arc<App>>, Path(name): Path<String>) -> JsonResult<ServiceDetail> {
    Ok(Json(views::service(&app, &name)?))
}

/// A service's interface with all definitions.
pub async fn interface(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
) -> JsonResult<package::interface::Interface> {
    Ok(Json(app.catalogue.current_revision(&name)?.interface.clone()))
}

/// Query: which revision.
#[derive(Debug, Deserialize, IntoParams)]
pub struct RevisionQuery {
    /// Number of the revision (default: the current one).
    revision: Option<u64>,
}

/// The part of a revision that is not in its image.
pub async fn record(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Query(of): Query<RevisionQuery>,
) -> JsonResult<push::ServiceRecord> {
    let current = app.catalogue.current_revision(&name)?;
    let revision = match of.revision {
        Some(number) => app.catalogue.revision(&name, number)?,
        None => current,
    };
    let rows = app.state.dictionary(&name)?;
    Ok(Json(push::ServiceRecord::from_revision(&revision, rows)))
}

/// Removes a service, its servants and its images.
pub async fn remove_service(State(app): State<Arc<App>>, Path(name): Path<String>) -> JsonResult<Stopped> {
    app.catalogue.current_revision(&name)?;
    let removed = {
        let app = Arc::clone(&app);
        async move {
            let stopped = app.pusher.remove(&name).await?;
            // The next service of this name may belong to somebody else.
            recordings::forget_service(&app, &name).await?;
            app.choreographer.forget_logs(&name).await;
            Ok(Json(Stopped { stopped }))
        }
    };
    let removed = recordings::run_to_end(&app.sessions, removed).await;
    removed.unwrap_or(Err(Error::Internal("removing a service")))
}

/// Makes an earlier revision the current one.
pub async fn rollback(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<ServiceDetail> {
    let body = read_body(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let asked: Rollback = if body.is_empty() {
        Rollback::default()
    } else {
        serde_json::from_slice(&body)
            .map_err(|error| Error::BadRequest(format!("the rollback cannot be read: {error}")))?
    };
    let current = app.pusher.rollback(&name, asked.revision).await?;
    about.set(format!("service {name}: to revision {current}"));
    Ok(Json(views::service(&app, &name)?))
}

/// The rollout of a service's next revision.
pub async fn rollout(State(app): State<Arc<App>>, Path(name): Path<String>) -> JsonResult<api::Rollout> {
    Ok(Json(app.choreographer.rollout(&name)?))
}

/// Starts a rollout, promotes its canary, or aborts it.
pub async fn order_rollout(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<api::Rollout> {
    use api::rollout::RolloutOrder;
    let body = read_body(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let order: RolloutOrder = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the order cannot be read: {error}")))?;
    about.set_value(&format!("service {name}"), &order);
    let choreographer = &app.choreographer;
    Ok(Json(match order {
        RolloutOrder::Start { revision, terms } => choreographer.begin_rollout(&name, None, revision, terms).await?,
        RolloutOrder::Promote => choreographer.promote_rollout(&name).await?,
        RolloutOrder::Abort => choreographer.abort_rollout(&name).await?,
    }))
}

/// Query of a trial.
#[derive(Debug, Deserialize, IntoParams)]
pub struct TrialQuery {
    /// Content of the body.
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

/// Tells whether another servant of a service would fit.
pub async fn fit(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    OriginalUri(uri): OriginalUri,
    Extension(caller): Extension<Caller>,
) -> JsonResult<api::Fit> {
    let stated = query_pairs(uri.query());
    let stated = api::Stated::read(stated).map_err(Error::Unstatable)?;
    let mut fit = app.choreographer.fit(&name, stated).await?;
    let sees = |id: &str| {
        let servant = app.choreographer.servant(id);
        servant.is_ok_and(|servant| caller.can_see_servant(&app, &servant))
    };
    fit.costs.retain(|cost| sees(&cost.servant));
    fit.ends.retain(|id| sees(id));
    Ok(Json(fit))
}

/// Runs a service on a recording or a picture and reports the output and its timing.
pub async fn trial(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Query(with): Query<TrialQuery>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> JsonResult<api::trial::Trial> {
    let BufferedBody { bytes, permit } = read_recording(&app, &caller, body).await?;
    let material = tokio::task::spawn_blocking(move || match with.kind {
        Kind::Image => Picture::read(&bytes)
            .map(|picture| Material::Pictures(vec![picture]))
            .map_err(|error| Error::BadRequest(error.to_string())),
        Kind::Bag => ros::bag::read(&bytes, reach::MAX_RECORDED)
            .map(Material::Bag)
            .map_err(|error| Error::BadRequest(error.to_string())),
    });
    let material = material.await.map_err(|_| Error::Internal("reading the input of a trial"))??;
    let trial = app.choreographer.trial(&name, material).await;
    // The messages of a recording share the body's memory.
    drop(permit);
    Ok(Json(trial?))
}

/// Lists all servants.
pub async fn servants(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>) -> Json<Vec<api::Servant>> {
    let mut handles = app.choreographer.servants();
    handles.retain(|handle| caller.can_see_servant(&app, handle));
    let described = handles.iter().map(|handle| app.choreographer.describe(handle));
    Json(futures_util::future::join_all(described).await)
}

/// Lists services and robots whose servants failed repeatedly and are not restarted yet.
pub async fn back_offs(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>) -> Json<Vec<api::BackOff>> {
    let mut back_offs = app.choreographer.back_offs();
    back_offs.retain(|of| caller.can_act_for_robot(&of.robot) && caller.can_see(&app, &of.service));
    Json(back_offs)
}

/// One servant.
pub async fn servant(State(app): State<Arc<App>>, Path(id): Path<String>) -> JsonResult<api::Servant> {
    let handle = app.choreographer.servant(&id)?;
    Ok(Json(app.choreographer.describe(&handle).await))
}

/// Changes limits of a running servant.
pub async fn set_limits(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<api::Servant> {
    let body = read_body(&app, &caller, body, LARGEST_WORDS).await?.bytes;
    let change: api::Limits = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the limits cannot be read: {error}")))?;
    about.set_value(&format!("servant {id}"), &change);
    change.check().map_err(|error| Error::BadRequest(error.to_string()))?;
    let moves_cores = change.cpu_weight.is_some() || change.cpus.is_some();
    if moves_cores && !caller.who.principal.is_unscoped() {
        let asked = app.choreographer.servant(&id)?.requested_limits_after(change);
        choreographer::limits::check_weight(&asked).map_err(|error| Error::BadRequest(error.to_string()))?;
    }
    app.choreographer.set_limits(&id, change).await?;
    let handle = app.choreographer.servant(&id)?;
    Ok(Json(app.choreographer.describe(&handle).await))
}

/// Explains why a robot is slow, or on its local original.
pub async fn explain(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
) -> JsonResult<api::explain::Explanation> {
    Ok(Json(crate::explain::explain_robot(&app, &caller, &name).await?))
}

/// Stops one servant.
pub async fn stop_servant(State(app): State<Arc<App>>, Path(id): Path<String>) -> JsonResult<Stopped> {
    app.choreographer.servant(&id)?;
    Ok(Json(Stopped { stopped: app.choreographer.stop("it was stopped", |handle| handle.id == id).await }))
}

/// Query: whose servants.
#[derive(Debug, Deserialize, IntoParams)]
pub struct ServiceQuery {
    /// Only servants of this service.
    service: Option<String>,
}

/// Stops all servants, or all of one service.
pub async fn stop_servants(
    State(app): State<Arc<App>>,
    Query(of): Query<ServiceQuery>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Stopped> {
    about.set(match &of.service {
        Some(service) => format!("servants of service {service}"),
        None => "all servants".to_owned(),
    });
    match &of.service {
        Some(service) => caller.check_service_access(&app, AccessAction::Operate, service, None)?,
        None => caller.check_access(AccessAction::Operate, &AccessObject::MACHINE)?,
    }
    if let Some(service) = &of.service {
        app.catalogue.current_revision(service)?;
    }
    let chosen = |handle: &choreographer::Handle| of.service.as_ref().is_none_or(|service| handle.service() == service);
    Ok(Json(Stopped { stopped: app.choreographer.stop("it was stopped", chosen).await }))
}
