//! `/api/v1/services/NAME/sla`: the dictionary of a service.

use std::sync::Arc;

use api::Stated;
use api::dictionary::{Explained, NewRows, Row};
use axum::body::Body;
use axum::extract::{OriginalUri, Path, State};
use axum::{Extension, Json};
use choreographer::{MOST_ROWS, check_row};
use serde::Deserialize;
use store::{Journal, NewEvent};
use utoipa::IntoParams;

use super::api_v1::{Answer, held};
use super::audit::About;
use super::guard::{self, Caller};
use crate::app::App;
use crate::errors::Error;

/// The longest body of rows.
const LARGEST: usize = 1 << 20;

/// All rows.
pub async fn rows(State(app): State<Arc<App>>, Path(name): Path<String>) -> Answer<Vec<Row>> {
    app.catalogue.current(&name)?;
    Ok(Json(app.state.dictionary(&name)?))
}

/// Writes rows; answers all that there are then.
pub async fn write(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<Vec<Row>> {
    let revision = app.catalogue.current(&name)?;
    let body = held(&app, &caller, body, LARGEST).await?.bytes;
    let new: NewRows = serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the rows cannot be read: {error}")))?;
    about.is_set(&format!("dictionary of service {name}"), &new);
    for row in &new.rows {
        check_row(row).map_err(|reason| Error::BadRequest(format!("row of {row}: {reason}")))?;
    }
    let there = match new.replace {
        true => 0,
        false => app.state.dictionary(&name)?.len(),
    };
    if there + new.rows.len() > MOST_ROWS {
        return Err(Error::BadRequest(format!(
            "{there} rows and {} more are too many; a service may have {MOST_ROWS}. Remove some with: cloudroidctl sla rm {name} NUMBER",
            new.rows.len()
        )));
    }
    app.state.write_dictionary(&name, revision.number, &new)?;
    let rows = app.state.dictionary(&name)?;
    let message = format!(
        "{} rows of the dictionary of {name} were written; it has {}",
        new.rows.len(),
        rows.len()
    );
    let about = NewEvent {
        service: Some(&name),
        ..NewEvent::default()
    };
    Journal::new(Arc::clone(&app.state)).info("dictionary-written", &message, &about);
    Ok(Json(rows))
}

/// Removes a row; answers those that are left.
pub async fn remove(
    State(app): State<Arc<App>>,
    Path((name, id)): Path<(String, String)>,
    Extension(about): Extension<About>,
) -> Answer<Vec<Row>> {
    about.is(format!("row {id} of the dictionary of service {name}"));
    app.catalogue.current(&name)?;
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
    let message = format!("row {id} of the dictionary of {name} was removed");
    let about = NewEvent {
        service: Some(&name),
        ..NewEvent::default()
    };
    Journal::new(Arc::clone(&app.state)).info("dictionary-written", &message, &about);
    Ok(Json(rows))
}

/// What is stated, as in the query of a robot's handshake.
#[derive(Debug, Deserialize, IntoParams)]
#[allow(dead_code, reason = "it is for the document; what is read is `Stated`")]
pub struct Stating {
    /// T_desire, such as `100ms`.
    rrt: Option<String>,
    /// T_max.
    max_rrt: Option<String>,
    /// Frames per second that are wished for.
    fps: Option<f64>,
    /// The least that is acceptable.
    min_fps: Option<f64>,
    /// Age of an output that is wished for.
    age: Option<String>,
    /// The greatest that is acceptable.
    max_age: Option<String>,
    /// A class of the configuration.
    class: Option<String>,
    /// Cores outright.
    cpus: Option<f64>,
    /// Memory outright, such as `512M`.
    memory: Option<String>,
}

/// What a robot would get that states this, and why.
pub async fn explain(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    OriginalUri(uri): OriginalUri,
) -> Answer<Explained> {
    let stated = Stated::read(guard::pairs(uri.query())).map_err(Error::Unstatable)?;
    Ok(Json(app.choreographer.explain_terms(&name, &stated)?))
}
