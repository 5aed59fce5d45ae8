//! `/api/v1/services/NAME/sla`: a service's dictionary.

use std::sync::Arc;

use api::Stated;
use api::dictionary::{Explained, NewRows, Row};
use api::sla::KEYS;
use axum::body::Body;
use axum::extract::{OriginalUri, Path, State};
use axum::{Extension, Json};
use choreographer::{MOST_ROWS, check_row};
use store::{Journal, NewEvent};
use utoipa::IntoParams;
use utoipa::openapi::Required;
use utoipa::openapi::path::{Parameter, ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::{ObjectBuilder, Type};

use super::audit::AuditObject;
use crate::app::App;
use crate::body::read_body;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::JsonResult;
use crate::query;

/// Maximum size of a body with rows.
const LARGEST: usize = 1 << 20;

/// Lists all rows.
pub async fn rows(State(app): State<Arc<App>>, Path(name): Path<String>) -> JsonResult<Vec<Row>> {
    app.catalogue.current_revision(&name)?;
    Ok(Json(app.state.dictionary(&name)?))
}

/// Writes rows and returns all rows.
pub async fn write(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<Vec<Row>> {
    let revision = app.catalogue.current_revision(&name)?;
    let body = read_body(&app, &caller, body, LARGEST).await?.bytes;
    let new: NewRows = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("cannot read the entries: {error}")))?;
    about.set_value(&format!("SLA table of service {name}"), &new);
    for row in &new.rows {
        check_row(row).map_err(|reason| Error::BadRequest(format!("entry for {row}: {reason}")))?;
    }
    let there = if new.replace { 0 } else { app.state.dictionary(&name)?.len() };
    if there + new.rows.len() > MOST_ROWS {
        return Err(Error::BadRequest(format!(
            "{there} entries and {} more exceed the limit of {MOST_ROWS} for a service; remove some with: cloudroidctl \
                sla rm {name} NUMBER",
            new.rows.len()
        )));
    }
    app.state.write_dictionary(&name, revision.number, &new)?;
    let rows = app.state.dictionary(&name)?;
    let message =
        format!("{} entries of the SLA table of {name} were written; it now has {}", new.rows.len(), rows.len());
    let about = NewEvent { service: Some(&name), ..NewEvent::default() };
    Journal::new(Arc::clone(&app.state)).info("dictionary-written", &message, &about);
    Ok(Json(rows))
}

/// Removes a row and returns those that are left.
pub async fn remove(
    State(app): State<Arc<App>>,
    Path((name, id)): Path<(String, String)>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<Row>> {
    about.set(format!("entry {id} of the SLA table of service {name}"));
    app.catalogue.current_revision(&name)?;
    let number = id.parse().ok();
    let removed = match number {
        Some(number) => app.state.remove_from_dictionary(&name, number)?,
        None => false,
    };
    let rows = app.state.dictionary(&name)?;
    if !removed {
        return Err(Error::UnknownRow {
            service: name,
            id,
            exists: rows.iter().map(|row| row.id.to_string()).collect(),
        });
    }
    let message = format!("entry {id} of the SLA table of {name} was removed");
    let about = NewEvent { service: Some(&name), ..NewEvent::default() };
    Journal::new(Arc::clone(&app.state)).info("dictionary-written", &message, &about);
    Ok(Json(rows))
}

/// Query: requirements as in the query of a robot's handshake; auxiliary parameters are `aux.KEY`.
pub struct StatedQuery;

impl IntoParams for StatedQuery {
    fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
        let parameters = KEYS.iter().map(|key| {
            let kind = if key.is_number { Type::Number } else { Type::String };
            ParameterBuilder::new()
                .name(key.name)
                .parameter_in(ParameterIn::Query)
                .required(Required::False)
                .description(Some(key.description))
                .schema(Some(ObjectBuilder::new().schema_type(kind)))
                .build()
        });
        parameters.collect()
    }
}

/// Explains what a robot that states these requirements would get.
pub async fn explain(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    OriginalUri(uri): OriginalUri,
) -> JsonResult<Explained> {
    let stated = Stated::read(query::query_pairs(uri.query())).map_err(Error::Unstatable)?;
    Ok(Json(app.choreographer.explain_terms(&name, &stated)?))
}
