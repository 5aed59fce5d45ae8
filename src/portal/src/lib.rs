//! The portal: everything served on the port and on the daemon's Unix socket, with one router.
//!
//! ```text
//!  TLS, TCP, Unix ─▶ hyper ─▶ guard ─▶ allowed ─┬─▶ /            the page, or the default service
//!                         authenticate authorise├─▶ /healthz /metrics /assets
//!                                               ├─▶ /api/v1      requests of cloudroidctl and the page
//!                                               ├─▶ /v2          images, read-only (OCI distribution)
//!                                               ├─▶ /foxglove    viewers, beside a servant's robot
//!                                               ├─▶ /stubs       stubs that robots install in place of a package
//!                                               └─▶ /<service>   upgrade ─▶ lease ─▶ bridge
//! ```

#![deny(unsafe_code)]

mod api_v1;
mod app;
mod audit;
mod auth;
mod authorisation;
mod bases;
mod body;
mod calibration;
mod caller;
mod connections;
mod dictionary;
mod differences;
mod errors;
mod events;
mod exec;
mod explain;
mod goals;
mod guard;
mod handshake;
mod headers;
mod history;
mod inside;
mod json;
mod log_levels;
mod logs;
mod looks;
mod machines;
mod metrics;
mod observers;
mod oci;
mod openapi;
mod page;
mod peer_groups;
mod people;
mod permissions;
mod policy;
mod principals;
mod proxies;
mod push;
mod pushes;
mod query;
mod recordings;
mod registry_clients;
mod robots;
mod route_access;
mod routes;
mod shadow;
mod slots;
mod strangers;
mod stream;
mod stubs;
mod tls;
mod tokens;
mod topics;
mod underlays;
mod viewers;
mod views;

use std::sync::Arc;

use route_access::{DescribeRequest, FindAccess};

pub use axum::Router;
pub use axum::http::Uri;

pub use ::tls::Fingerprint;
pub use app::{App, MachineChecks, Options, RobotAuthority};
pub use audit::Audit;
pub use connections::{serve_challenges, serve_tcp, serve_unix};
pub use history::record_history as keep_history;
pub use inside::connections::InsideConnections;
pub use observers::run_observers as keep_observers;
pub use observers::servants::{BlackBoxOptions, Observers};
pub use people::identity_provider::IdentityProvider;
pub use people::passwords::Passwords;
pub use people::provider::CALLBACK;
pub use principals::{Principals, SessionLifetimes};
pub use proxies::{IpNetwork, ParseIpNetworkError, Proxies};
pub use slots::Slots;
pub use strangers::Strangers;
pub use stream::live::LiveSamples;
pub use tls::{Challenge, Tls, TlsError};
pub use tokens::{TokenError, Tokens};

/// Builds the router, behind the guard.
pub fn router(app: Arc<App>) -> Router {
    let served = routes::ROUTES.iter().fold(Router::new(), |router, route| {
        let row = (Arc::clone(&app), route.access, routes::words::describe_request as DescribeRequest);
        let allowed = axum::middleware::from_fn_with_state(row, authorisation::authorise);
        router.route(route.path, (route.handler)().layer(allowed))
    });
    served
        .fallback(routes::not_found)
        .method_not_allowed_fallback(routes::other_method)
        .layer(axum::middleware::from_fn_with_state(
            (Arc::clone(&app), routes::find_access as FindAccess, routes::words::describe_request as DescribeRequest),
            guard::guard,
        ))
        .layer(axum::middleware::from_fn(registry_clients::translate_problems))
        .with_state(app)
}
