//! `/api/v1/underlays`: compiled workspaces that other packages are compiled and run upon.

use std::sync::Arc;

use api::Underlay;
use axum::extract::{Path, State};
use axum::{Extension, Json};

use crate::app::App;
use crate::audit::AuditObject;
use crate::caller::Caller;
use crate::json::JsonResult;
use crate::push::deployer;

/// Lists the underlays that the caller may see.
pub async fn list(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>) -> JsonResult<Vec<Underlay>> {
    let by = deployer(&app, caller);
    Ok(Json(app.pusher.list_underlays(&by).await?))
}

/// Removes an underlay on which no service stands.
pub async fn remove(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Underlay> {
    about.set(format!("underlay {name}"));
    let by = deployer(&app, caller);
    Ok(Json(app.pusher.remove_underlay(&name, &by).await?))
}
