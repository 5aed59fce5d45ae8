//! JSON in the bodies of requests and responses.

use api::NDJSON;
use axum::Json;
use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use serde::de::DeserializeOwned;

use crate::app::App;
use crate::body::{LARGEST_WORDS, read_body};
use crate::caller::Caller;
use crate::errors::Error;

/// JSON, or an error that becomes a problem document.
pub type JsonResult<T> = Result<Json<T>, Error>;

/// Reads a value of at most 64 KiB of JSON; `what` names it in an error.
pub async fn read_json<T: DeserializeOwned>(app: &App, caller: &Caller, body: Body, what: &str) -> Result<T, Error> {
    let body = read_body(app, caller, body, LARGEST_WORDS).await?.bytes;
    serde_json::from_slice(&body).map_err(|error| Error::BadRequest(format!("the {what} cannot be read: {error}")))
}

/// Builds a response that streams values as JSON lines.
pub fn json_lines<T: serde::Serialize + Send + 'static>(
    values: impl futures_util::Stream<Item = T> + Send + 'static,
) -> Response {
    let encoded = values.map(|value| {
        let mut line = serde_json::to_vec(&value)?;
        line.push(b'\n');
        Ok::<_, serde_json::Error>(line)
    });
    ([(header::CONTENT_TYPE, NDJSON)], Body::from_stream(encoded)).into_response()
}
