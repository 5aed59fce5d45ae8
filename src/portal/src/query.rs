//! Query parameters of a request.

use std::borrow::Cow;
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
                let why = refused.source().map_or_else(|| refused.body_text(), ToString::to_string);
                Err(Error::BadRequest(format!("the query cannot be read: {why}")))
            }
        }
    }
}

/// Returns one decoded value of the query.
pub fn query_value(query: Option<&str>, name: &str) -> Option<String> {
    let (_, value) = query_pairs(query).find(|(key, _)| key == name)?;
    Some(value.into_owned())
}

/// Returns all parameters of a query in order.
pub fn query_pairs(query: Option<&str>) -> impl Iterator<Item = (Cow<'_, str>, Cow<'_, str>)> {
    form_urlencoded::parse(query.unwrap_or_default().as_bytes())
}
