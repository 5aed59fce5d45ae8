//! `/api/v1/tokens`, `/api/v1/policy`, `/api/v1/whoami`: who may do what, and changing it.

use std::sync::Arc;

use api::access::{NewRule, NewToken, Rule, Secret, Token, Whoami};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::{Extension, Json};
use serde::de::DeserializeOwned;

use super::api_v1::{Answer, held};
use super::guard::Caller;
use crate::app::App;
use crate::audit::About;
use crate::errors::Error;

/// The longest body.
const LARGEST: usize = 64 << 10;

pub(super) async fn read<T: DeserializeOwned>(
    app: &App,
    caller: &Caller,
    body: Body,
    what: &str,
) -> Result<T, Error> {
    let body = held(app, caller, body, LARGEST).await?.bytes;
    serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the {what} cannot be read: {error}")))
}

/// Who asks.
pub async fn whoami(Extension(caller): Extension<Caller>) -> Json<Whoami> {
    let principal = &caller.who.principal;
    Json(Whoami {
        name: principal.name.clone(),
        roles: principal.roles.clone(),
        services: principal.scope.services.clone(),
        robot: principal.scope.robot.clone(),
    })
}

/// All tokens there ever were.
pub async fn tokens(State(app): State<Arc<App>>) -> Json<Vec<Token>> {
    Json(app.principals.tokens())
}

/// Makes a token.
pub async fn create(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<Secret> {
    let new: NewToken = read(&app, &caller, body, "token").await?;
    about.is_set(&format!("token {}", new.name), &new);
    let first = app.principals.names_nobody();
    let made = app.principals.create(&new)?;
    if first {
        tracing::warn!("the first token was made: from now on every request over TCP needs one");
    }
    Ok(Json(made))
}

/// Gives a token another secret.
pub async fn rotate(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Secret> {
    about.is(format!("token {name}"));
    Ok(Json(app.principals.rotate(&name)?))
}

/// Ends a token, and the connections that show it; gives all there are.
pub async fn revoke(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Vec<Token>> {
    about.is(format!("token {name}"));
    app.principals.revoke(&name)?;
    Ok(Json(app.principals.tokens()))
}

/// All rules.
pub async fn rules(State(app): State<Arc<App>>) -> Json<Vec<Rule>> {
    Json(app.principals.rules())
}

/// Writes a rule; gives all there are.
pub async fn add_rule(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<Vec<Rule>> {
    let new: NewRule = read(&app, &caller, body, "rule").await?;
    let allow: Vec<String> = new.allow.iter().map(ToString::to_string).collect();
    about.is(format!(
        "{} at {}: {}",
        new.who,
        new.services,
        allow.join(" ")
    ));
    app.principals.add_rule(&new)?;
    Ok(Json(app.principals.rules()))
}

/// Removes a rule; gives those that are left.
pub async fn remove_rule(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Vec<Rule>> {
    let number = id.parse().ok();
    let named = app
        .principals
        .rules()
        .into_iter()
        .find(|rule| Some(rule.id) == number);
    match named {
        Some(rule) => about.is_set("rule", &rule),
        None => about.is(format!("rule {id}")),
    }
    let removed = match number {
        Some(number) => app.principals.remove_rule(number)?,
        None => false,
    };
    let rules = app.principals.rules();
    if !removed {
        return Err(Error::UnknownRule {
            id,
            exists: rules.iter().map(|rule| rule.id.to_string()).collect(),
        });
    }
    Ok(Json(rules))
}
