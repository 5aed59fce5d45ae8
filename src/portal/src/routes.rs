//! Every address that the portal answers, in one table. The router is made of it, and a test checks for each row that it is
//! not answered without a token where tokens are configured.

use axum::extract::{DefaultBodyLimit, OriginalUri};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, any, delete, get, patch, post};

use std::sync::Arc;

use super::{App, api_v1, metrics, oci, page, push, robots, stubs};
use crate::errors::Error;

/// One method at one address.
pub struct Route {
    /// `GET`, …, or `ANY` where the handler tells methods apart. `GET` answers `HEAD`, too.
    #[cfg_attr(not(test), expect(dead_code, reason = "for those who read the table"))]
    pub method: &'static str,
    /// Its address as axum writes it; `{…}` is one segment.
    pub path: &'static str,
    /// Makes its handler.
    pub handler: fn() -> MethodRouter<Arc<App>>,
}

const fn at(
    method: &'static str,
    path: &'static str,
    handler: fn() -> MethodRouter<Arc<App>>,
) -> Route {
    Route {
        method,
        path,
        handler,
    }
}

/// All routes. Access is not decided here: [`super::guard`] refuses each address that it does not open by name.
pub const ROUTES: &[Route] = &[
    at("ANY", "/", || any(robots::root)),
    at("GET", "/healthz", || get(api_v1::health)),
    at("GET", "/metrics", || get(metrics::metrics)),
    at("ANY", "/assets", || any(nothing)),
    at("GET", "/assets/{name}", || get(page::asset)),
    at("ANY", "/api", || any(nothing)),
    at("GET", "/api/v1/status", || get(api_v1::status)),
    at("GET", "/api/v1/doctor", || get(api_v1::doctor)),
    at("GET", "/api/v1/clock", || get(api_v1::clock)),
    at("GET", "/api/v1/events", || get(api_v1::events)),
    at("GET", "/api/v1/services", || get(api_v1::services)),
    at("GET", "/api/v1/services/{name}", || get(api_v1::service)),
    at("DELETE", "/api/v1/services/{name}", || {
        delete(api_v1::remove_service)
    }),
    at("GET", "/api/v1/services/{name}/interface", || {
        get(api_v1::interface)
    }),
    at("POST", "/api/v1/services/{name}/rollback", || {
        post(api_v1::rollback)
    }),
    at("POST", "/api/v1/services/{name}/trial", || {
        post(api_v1::trial)
    }),
    at("GET", "/api/v1/servants", || get(api_v1::servants)),
    at("DELETE", "/api/v1/servants", || {
        delete(api_v1::stop_servants)
    }),
    at("GET", "/api/v1/servants/{id}", || get(api_v1::servant)),
    at("PATCH", "/api/v1/servants/{id}", || {
        patch(api_v1::set_limits)
    }),
    at("DELETE", "/api/v1/servants/{id}", || {
        delete(api_v1::stop_servant)
    }),
    at("GET", "/api/v1/servants/{id}/logs", || get(api_v1::logs)),
    at("GET", "/api/v1/robots/{name}/explain", || {
        get(api_v1::explain)
    }),
    at("POST", "/api/v1/push", || {
        post(push::push).layer(DefaultBodyLimit::disable())
    }),
    at("GET", "/api/v1/openapi.json", || get(api_v1::openapi)),
    at("GET", "/v2", || get(oci::version)),
    at("GET", "/v2/", || get(oci::version)),
    at("GET", "/v2/_catalog", || get(oci::catalog)),
    at("GET", "/v2/{name}/tags/list", || get(oci::tags)),
    at("GET", "/v2/{name}/manifests/{reference}", || {
        get(oci::manifest)
    }),
    at("GET", "/v2/{name}/blobs/{digest}", || get(oci::blob)),
    at("GET", "/stubs", || get(stubs::list)),
    at("GET", "/stubs/{file}", || get(stubs::archive)),
    at("ANY", "/{service}", || any(robots::service)),
    at("ANY", "/{service}/", || any(robots::service_with_slash)),
];

/// Answers paths that are in no row: 404.
pub async fn nothing(uri: OriginalUri) -> Response {
    if uri.path().starts_with("/v2/") {
        return oci::nothing(uri).await;
    }
    Error::UnknownPath {
        path: uri.path().to_owned(),
    }
    .into_response()
}
