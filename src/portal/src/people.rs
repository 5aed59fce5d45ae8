//! `/api/v1/session`, `/api/v1/sessions`, `/api/v1/accounts`: people sign in and out, and admins manage accounts.

pub mod cookies;
pub mod identity_provider;
mod lanes;
pub mod passwords;
pub mod provider;

use std::sync::Arc;

use access::AccessAction;
use api::people::{Account, AccountChange, NewAccount, Session, SessionLine, SignIn};
use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use utoipa::IntoParams;

use crate::app::App;
use crate::audit::AuditObject;
use crate::body::read_body;
use crate::caller::{Caller, ConnectionPeer, PortalConnection};
use crate::errors::Error;
use crate::json::JsonResult;
use crate::principals::StartedSession;
use crate::principals::identity::Credential;
use crate::query::Query;
use passwords::{Attempt, PasswordVerdict};

/// Maximum size of a body in bytes: a name, a password, and service patterns.
const LARGEST: usize = 16 << 10;

async fn read_json<T: DeserializeOwned>(app: &App, caller: &Caller, body: Body, what: &str) -> Result<T, Error> {
    let body = read_body(app, caller, body, LARGEST).await?.bytes;
    serde_json::from_slice(&body).map_err(|error| Error::BadRequest(format!("the {what} cannot be read: {error}")))
}

/// Forbids caching of responses that reveal who is signed in.
fn no_store(answer: impl IntoResponse) -> Response {
    let no_store = HeaderValue::from_static("no-store");
    let mut response = answer.into_response();
    response.headers_mut().insert(header::CACHE_CONTROL, no_store);
    response
}

fn describe_session(app: &App, caller: &Caller, secret: Option<&str>) -> Session {
    let principal = &caller.who.principal;
    let expires = match caller.who.shown {
        Credential::Session { id } => app.principals.session_end(id),
        _ => None,
    };
    Session {
        name: caller.is_known().then(|| principal.name.clone()),
        role: principal.roles.first().copied(),
        csrf: secret.filter(|_| expires.is_some()).map(cookies::csrf_token),
        expires,
        needed: !app.principals.has_no_credentials(),
        accounts: app.principals.has_accounts(),
        loopback_robots: app.options.loopback_robots,
        provider: app.provider.as_ref().map(|provider| provider.link()),
    }
}

/// Tells who is signed in, if anybody.
pub async fn session(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Result<Response, Error> {
    let secret = cookies::session_cookie(&caller.connection(), &headers)?;
    Ok(no_store(Json(describe_session(&app, &caller, secret.as_deref()))))
}

/// Refuses to accept secrets, such as a password or a session's cookie, on a connection that can be intercepted.
fn check_confidential(connection: &PortalConnection) -> Result<(), Error> {
    let here = connection.peer.ip().is_loopback() && !connection.forwarded;
    if connection.secure || here {
        Ok(())
    } else {
        Err(Error::Foreign {
            what: "credentials that are sent without TLS can be read on the way".into(),
            next: "use https://".into(),
        })
    }
}

/// Completes a sign-in: ends an `earlier` session of the same browser and returns the new caller and the cookie.
/// `kind` describes the person in the audit log.
fn finish_sign_in(
    app: &App,
    caller: &Caller,
    begun: &StartedSession,
    earlier: Option<String>,
    did: &str,
    kind: &str,
) -> (Caller, HeaderValue) {
    if let Some(earlier) = earlier
        && let Err(error) = app.principals.end_session_by_secret(&earlier)
    {
        tracing::warn!("the previous session could not be ended: {error}");
    }
    let now = Caller { who: begun.identity.clone(), ..caller.clone() };
    let object = format!("{kind} {}", now.who.principal.name);
    app.audit.record(&now, AccessAction::Enter, did, &object, 200);
    let left = begun.expires.saturating_sub(store::now()) / 1000;
    let cookie = cookies::set_session(caller.secure, &begun.secret, left);
    (now, cookie)
}

/// Signs a person in. The browser always gets a new session.
pub async fn sign_in(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>, request: Request) -> Response {
    let (head, body) = request.into_parts();
    let signed = try_sign_in(&app, &caller, &head.headers, body).await;
    let did = "sign in";
    match signed {
        Ok((begun, earlier)) => {
            let (now, cookie) = finish_sign_in(&app, &caller, &begun, earlier, did, "account");
            let answer = describe_session(&app, &now, Some(&begun.secret));
            no_store(([(header::SET_COOKIE, cookie)], Json(answer)))
        }
        Err((account, error)) => {
            // The name may be a mistyped password, so only existing names are logged.
            let object = match account {
                Some(name) => format!("account {name}"),
                None => "an unknown account".to_owned(),
            };
            let status = error.problem().status;
            app.audit.record_throttled(&caller, AccessAction::Enter, did, &object, status);
            no_store(error)
        }
    }
}

type SignInFailure = (Option<String>, Error);

/// Returns the new session and the previous secret of the browser.
async fn try_sign_in(
    app: &App,
    caller: &Caller,
    headers: &HeaderMap,
    body: Body,
) -> Result<(StartedSession, Option<String>), SignInFailure> {
    let refused = |error| (None, error);
    let connection = caller.connection();
    check_confidential(&connection).map_err(refused)?;
    // Otherwise another site could sign a person in under another name, to watch what is done then.
    cookies::check_origin(&connection, headers, false).map_err(refused)?;
    let earlier = cookies::session_cookie(&connection, headers).map_err(refused)?;
    let asked: SignIn = read_json(app, caller, body, "name and password").await.map_err(refused)?;
    access::principal::check_name(&asked.name)
        .map_err(|_| refused(Error::BadRequest("no account can have such a name".into())))?;
    if asked.password.len() > passwords::LONGEST {
        return Err(refused(Error::BadRequest(format!("a password has at most {} bytes", passwords::LONGEST))));
    }
    let SignIn { name, password } = asked;
    let mut candidate = app.principals.candidate(&name);
    let known = candidate.is_some().then(|| name.clone());
    let from = caller.peer.ip();
    let attempt = Attempt {
        from,
        name: name.clone(),
        known: candidate.as_ref().map(|candidate| candidate.password.clone()),
        password,
    };
    let may_try = || Ok(app.principals.check_sign_in(&name, from, store::now())?);
    may_try().map_err(|error| (known.clone(), error))?;
    // Checked again when the turn comes: attempts made meanwhile count.
    let looked = app.passwords.verify(attempt, may_try).await;
    let looked = looked.map_err(|error| (known.clone(), error))?;
    let begun = match (looked, &mut candidate) {
        (PasswordVerdict::Wrong, _) | (_, None) => None,
        (looked, Some(candidate)) => {
            if let PasswordVerdict::Rehashed(better) = looked {
                let kept = app.principals.rehash(candidate, better);
                kept.map_err(|error| (known.clone(), error))?;
            }
            let begun = app.principals.begin_session(candidate, &caller.peer.to_string());
            begun.map_err(|error| (known.clone(), error))?
        }
    };
    match begun {
        Some(begun) => Ok((begun, earlier)),
        None => {
            app.principals.record_wrong_password(&name, from, store::now());
            Err((known, Error::WrongPassword))
        }
    }
}

/// Query: which sessions end.
#[derive(Debug, Deserialize, IntoParams)]
pub struct SignOutQuery {
    /// End all sessions of the person, including those in other browsers.
    #[serde(default)]
    everywhere: bool,
}

/// Signs out.
pub async fn sign_out(
    State(app): State<Arc<App>>,
    Query(ending): Query<SignOutQuery>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let Credential::Session { id } = caller.who.shown else {
        return Err(Error::BadRequest("the request has no session".into()));
    };
    let name = &caller.who.principal.name;
    if ending.everywhere {
        app.principals.end_sessions_of(name)?
    } else {
        app.principals.end_session(id)?
    }
    let object = format!("account {name}");
    app.audit.record(&caller, AccessAction::Enter, "sign out", &object, 204);
    let cookie = cookies::clear_session(caller.secure);
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]).into_response())
}

/// Lists all sessions.
pub async fn sessions(State(app): State<Arc<App>>) -> Json<Vec<SessionLine>> {
    Json(app.principals.sessions())
}

/// Lists all accounts.
pub async fn accounts(State(app): State<Arc<App>>) -> Json<Vec<Account>> {
    Json(app.principals.accounts())
}

/// Creates an account and returns all accounts.
pub async fn create(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<Vec<Account>> {
    check_confidential(&caller.connection())?;
    let new: NewAccount = read_json(&app, &caller, body, "account").await?;
    app.principals.check_account(&new)?;
    about.set(format!("account {} ({})", new.name, new.role));
    passwords::check_strength(&new.name, &new.password)?;
    let hash = app.passwords.hash(new.password.clone()).await?;
    let first = app.principals.has_no_credentials();
    app.principals.create_account(&new, &hash)?;
    if first {
        tracing::warn!("the first account was created: from now on every request over TCP needs a session or a token");
    }
    Ok(Json(app.principals.accounts()))
}

/// Changes an account, which ends its sessions, and returns all accounts.
pub async fn change(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<Vec<Account>> {
    check_confidential(&caller.connection())?;
    app.principals.check_account_exists(&name)?;
    let change: AccountChange = read_json(&app, &caller, body, "change").await?;
    let what = [
        change.password.is_some().then(|| "password".to_owned()),
        change.role.map(|role| role.to_string()),
        change.disabled.map(|disabled| if disabled { "disabled" } else { "enabled" }.to_owned()),
    ];
    let what: Vec<String> = what.into_iter().flatten().collect();
    about.set(format!("account {name}: {}", what.join(", ")));
    let hash = match &change.password {
        Some(password) => {
            passwords::check_strength(&name, password)?;
            Some(app.passwords.hash(password.clone()).await?)
        }
        None => None,
    };
    app.principals.change_account(&name, &change, hash.as_deref())?;
    Ok(Json(app.principals.accounts()))
}

/// Removes an account, which ends its sessions, and returns those that are left.
pub async fn remove(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<Account>> {
    about.set(format!("account {name}"));
    app.principals.remove_account(&name)?;
    Ok(Json(app.principals.accounts()))
}

/// Ends all sessions of a person and returns those of others.
pub async fn end_sessions(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<SessionLine>> {
    about.set(format!("sessions of {name}"));
    app.principals.end_sessions_of(&name)?;
    Ok(Json(app.principals.sessions()))
}

impl Caller {
    /// Returns the properties of the caller's connection.
    fn connection(&self) -> PortalConnection {
        PortalConnection {
            secure: self.secure || matches!(self.peer, ConnectionPeer::Unix(_)),
            forwarded: self.forwarded,
            ..PortalConnection::without_tls(self.peer)
        }
    }
}
