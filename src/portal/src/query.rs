//! Query parameters of a request.

use std::error::Error as _;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use serde::de::DeserializeOwned;

use crate::errors::Error;

/// Extractor of query parameters; one that cannot be parsed is refused by name with an [`api::Problem`], like all
/// errors.
#[derive(Debug)]
pub struct Query<T>(pub T);

impl<T: DeserializeOwned, S: Sync> FromRequestParts<S> for Query<T> {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Error> {
        match axum::extract::Query::try_from_uri(&parts.uri) {
            Ok(axum::extract::Query(parameters)) => Ok(Query(parameters)),
            Err(refused) => {
                let why = refused
                    .source()
                    .map_or_else(|| refused.body_text(), ToString::to_string);
                Err(Error::BadRequest(format!(
                    "the query cannot be read: {why}"
                )))
            }
        }
    }
}
