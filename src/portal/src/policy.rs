//! `/api/v1/tokens`, `/api/v1/policy`, `/api/v1/whoami`: tokens and the access policy.

use std::sync::Arc;

use api::access::{NewRule, NewToken, Rule, Secret, Token, Whoami};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::{Extension, Json};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::app::App;
use crate::audit::AuditObject;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::{JsonResult, read_json};
use crate::query::Query;

/// Query: where the caller wants to act.
#[derive(Debug, Deserialize, IntoParams)]
pub struct WhoamiQuery {
    /// Service at which the actions are performed (default: one that the caller publishes itself).
    service: Option<String>,
}

/// Returns the caller's identity and what it may do.
pub async fn whoami(
    State(app): State<Arc<App>>,
    Query(place): Query<WhoamiQuery>,
    Extension(caller): Extension<Caller>,
) -> Json<Whoami> {
    let principal = &caller.who.principal;
    let may = caller.permitted_actions(&app, place.service.as_deref());
    Json(Whoami {
        may: may.iter().map(|action| action.name().to_owned()).collect(),
        name: principal.name.clone(),
        roles: principal.roles.clone(),
        services: principal.scope.services.clone(),
        robot: principal.scope.robot.clone(),
    })
}

/// Lists all tokens, including revoked ones.
pub async fn tokens(State(app): State<Arc<App>>) -> Json<Vec<Token>> {
    Json(app.principals.tokens())
}

/// Creates a token.
pub async fn create(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<Secret> {
    let new: NewToken = read_json(&app, &caller, body, "token").await?;
    about.set_value(&format!("token {}", new.name), &new);
    let first = app.principals.has_no_credentials();
    let made = app.principals.create_token(&new)?;
    if first {
        tracing::warn!("the first token was created: from now on every request over TCP needs one");
    }
    Ok(Json(made))
}

/// Replaces the secret of a token.
pub async fn rotate(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Secret> {
    about.set(format!("token {name}"));
    Ok(Json(app.principals.rotate_token(&name)?))
}

/// Revokes a token, which closes the connections that use it, and returns all tokens.
pub async fn revoke(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<Token>> {
    about.set(format!("token {name}"));
    app.principals.revoke_token(&name)?;
    Ok(Json(app.principals.tokens()))
}

/// Lists all rules.
pub async fn rules(State(app): State<Arc<App>>) -> Json<Vec<Rule>> {
    Json(app.principals.rules())
}

/// Adds a rule and returns all rules.
pub async fn add_rule(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<Vec<Rule>> {
    let new: NewRule = read_json(&app, &caller, body, "rule").await?;
    let allow: Vec<String> = new.allow.iter().map(ToString::to_string).collect();
    about.set(format!("{} at {}: {}", new.who, new.services, allow.join(" ")));
    app.principals.add_rule(&new)?;
    Ok(Json(app.principals.rules()))
}

/// Removes a rule and returns those that are left.
pub async fn remove_rule(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<Rule>> {
    let number = id.parse().ok();
    let named = app.principals.rules().into_iter().find(|rule| Some(rule.id) == number);
    match named {
        Some(rule) => about.set_value("rule", &rule),
        None => about.set(format!("rule {id}")),
    }
    let removed = match number {
        Some(number) => app.principals.remove_rule(number)?,
        None => false,
    };
    let rules = app.principals.rules();
    if !removed {
        return Err(Error::UnknownRule { id, exists: rules.iter().map(|rule| rule.id.to_string()).collect() });
    }
    Ok(Json(rules))
}
