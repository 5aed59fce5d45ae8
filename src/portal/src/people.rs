//! `/api/v1/session`, `/api/v1/sessions`, `/api/v1/accounts`: people sign in and out, and admins see to their accounts.

pub mod cookies;
mod lanes;
pub mod passwords;
pub mod provider;

use std::sync::Arc;

use access::Action;
use api::people::{Account, AccountChange, NewAccount, Session, SessionLine, SignIn};
use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use utoipa::IntoParams;

use super::api_v1::{Answer, held};
use super::guard::{Caller, Connection, Peer};
use crate::app::App;
use crate::audit::About;
use crate::errors::Error;
use crate::principals::{Begun, Shown};
use crate::query::Query;
use passwords::{Attempt, Looked};

/// The longest body: a name, a password, and patterns of services.
const LARGEST: usize = 16 << 10;

async fn read<T: DeserializeOwned>(
    app: &App,
    caller: &Caller,
    body: Body,
    what: &str,
) -> Result<T, Error> {
    let body = held(app, caller, body, LARGEST).await?.bytes;
    serde_json::from_slice(&body)
        .map_err(|error| Error::BadRequest(format!("the {what} cannot be read: {error}")))
}

/// What says who is signed in is kept by nobody on the way.
fn unkept(answer: impl IntoResponse) -> Response {
    let no_store = HeaderValue::from_static("no-store");
    let mut response = answer.into_response();
    response
        .headers_mut()
        .insert(header::CACHE_CONTROL, no_store);
    response
}

fn described(app: &App, caller: &Caller, secret: Option<&str>) -> Session {
    let principal = &caller.who.principal;
    let expires = match caller.who.shown {
        Shown::Session { id } => app.principals.session_end(id),
        _ => None,
    };
    Session {
        name: caller.is_known().then(|| principal.name.clone()),
        role: principal.roles.first().copied(),
        csrf: secret.filter(|_| expires.is_some()).map(cookies::csrf),
        expires,
        needed: !app.principals.names_nobody(),
        accounts: app.principals.has_accounts(),
        provider: app.provider.as_ref().map(|provider| provider.link()),
    }
}

/// Who is signed in, if anybody is.
pub async fn session(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Result<Response, Error> {
    let secret = cookies::shown(&caller.connection(), &headers)?;
    Ok(unkept(Json(described(&app, &caller, secret.as_deref()))))
}

/// Refuses to hear what others could read on the way: a password, or by what a session is known.
fn check_way(connection: &Connection) -> Result<(), Error> {
    let here = connection.peer.ip().is_loopback() && !connection.forwarded;
    match connection.secure || here {
        true => Ok(()),
        false => Err(Error::Foreign {
            what: "what somebody signs in by can be read by anybody on the way where it is sent without TLS".into(),
            next: "ask at https://".into(),
        }),
    }
}

/// Lets somebody in whose session has begun, in place of an `earlier` one of the same browser: who asks from now on, and the cookie. `kind`:
/// of whom the audit log is told.
fn enter(
    app: &App,
    caller: &Caller,
    begun: &Begun,
    earlier: Option<String>,
    did: &str,
    kind: &str,
) -> (Caller, HeaderValue) {
    if let Some(earlier) = earlier
        && let Err(error) = app.principals.end_shown(&earlier)
    {
        tracing::warn!("the session before this one could not be ended: {error}");
    }
    let now = Caller {
        who: begun.identity.clone(),
        ..caller.clone()
    };
    let object = format!("{kind} {}", now.who.principal.name);
    app.audit.record(&now, Action::Enter, did, &object, 200);
    let left = begun.expires.saturating_sub(store::now()) / 1000;
    let cookie = cookies::kept(caller.secure, &begun.secret, left);
    (now, cookie)
}

/// Signs somebody in: gives the browser another session than it may have had.
pub async fn sign_in(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Response {
    let (head, body) = request.into_parts();
    let (path, headers) = (head.uri.path(), &head.headers);
    let signed = signed_in(&app, &caller, headers, body).await;
    let did = format!("{} {path}", head.method);
    match signed {
        Ok((begun, earlier)) => {
            let (now, cookie) = enter(&app, &caller, &begun, earlier, &did, "account");
            let answer = described(&app, &now, Some(&begun.secret));
            unkept(([(header::SET_COOKIE, cookie)], Json(answer)))
        }
        Err((account, error)) => {
            // Somebody may have written a password in the name's place: only names that there are stand in the log.
            let object = match account {
                Some(name) => format!("account {name}"),
                None => "an account that there is not".to_owned(),
            };
            let status = error.problem().status;
            app.audit
                .record_sparingly(&caller, Action::Enter, &did, &object, status);
            unkept(error)
        }
    }
}

type Refused = (Option<String>, Error);

/// The session that begins, and what the browser has shown until now.
async fn signed_in(
    app: &App,
    caller: &Caller,
    headers: &HeaderMap,
    body: Body,
) -> Result<(Begun, Option<String>), Refused> {
    let refused = |error| (None, error);
    let connection = caller.connection();
    check_way(&connection).map_err(refused)?;
    // Else another site could sign somebody in as somebody else, to see what is done then.
    cookies::check_origin(&connection, headers, false).map_err(refused)?;
    let earlier = cookies::shown(&connection, headers).map_err(refused)?;
    let asked: SignIn = read(app, caller, body, "name and password")
        .await
        .map_err(refused)?;
    access::principal::check_name(&asked.name)
        .map_err(|_| refused(Error::BadRequest("no account has such a name".into())))?;
    if asked.password.len() > passwords::LONGEST {
        return Err(refused(Error::BadRequest(format!(
            "a password has at most {} bytes",
            passwords::LONGEST
        ))));
    }
    let SignIn { name, password } = asked;
    let mut candidate = app.principals.candidate(&name);
    let known = candidate.is_some().then(|| name.clone());
    let from = caller.peer.ip();
    let attempt = Attempt {
        from,
        name: name.clone(),
        known: candidate
            .as_ref()
            .map(|candidate| candidate.password.clone()),
        password,
    };
    let may_try = || Ok(app.principals.may_try(&name, from, store::now())?);
    may_try().map_err(|error| (known.clone(), error))?;
    // Asked once more when it is its turn: what was tried meanwhile counts.
    let looked = app.passwords.look(attempt, may_try).await;
    let looked = looked.map_err(|error| (known.clone(), error))?;
    let begun = match (looked, &mut candidate) {
        (Looked::Wrong, _) | (_, None) => None,
        (looked, Some(candidate)) => {
            if let Looked::Rehashed(better) = looked {
                let kept = app.principals.rehash(candidate, better);
                kept.map_err(|error| (known.clone(), error))?;
            }
            let begun = app.principals.begin(candidate, &caller.peer.to_string());
            begun.map_err(|error| (known.clone(), error))?
        }
    };
    match begun {
        Some(begun) => Ok((begun, earlier)),
        None => {
            app.principals.wrong_password(&name, from, store::now());
            Err((known, Error::WrongPassword))
        }
    }
}

/// Which sessions end.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Ending {
    /// All of the person, also those of its other browsers.
    #[serde(default)]
    everywhere: bool,
}

/// Signs out.
pub async fn sign_out(
    State(app): State<Arc<App>>,
    Query(ending): Query<Ending>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let Shown::Session { id } = caller.who.shown else {
        return Err(Error::BadRequest(
            "nobody is signed in by this request: it shows no session".into(),
        ));
    };
    let name = &caller.who.principal.name;
    match ending.everywhere {
        true => app.principals.end_sessions_of(name)?,
        false => app.principals.end_session(id)?,
    }
    let object = format!("account {name}");
    app.audit.record(
        &caller,
        Action::Enter,
        "DELETE /api/v1/session",
        &object,
        204,
    );
    let cookie = cookies::forgotten(caller.secure);
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]).into_response())
}

/// All sessions.
pub async fn sessions(State(app): State<Arc<App>>) -> Json<Vec<SessionLine>> {
    Json(app.principals.sessions())
}

/// All accounts.
pub async fn accounts(State(app): State<Arc<App>>) -> Json<Vec<Account>> {
    Json(app.principals.accounts())
}

/// Makes an account; gives all there are.
pub async fn create(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<Vec<Account>> {
    check_way(&caller.connection())?;
    let new: NewAccount = read(&app, &caller, body, "account").await?;
    app.principals.check_account(&new)?;
    about.is(format!("account {} ({})", new.name, new.role));
    passwords::check(&new.name, &new.password).map_err(Error::BadRequest)?;
    let hash = app.passwords.hash(new.password.clone()).await?;
    let first = app.principals.names_nobody();
    app.principals.create_account(&new, &hash)?;
    if first {
        tracing::warn!(
            "the first account was made: from now on every request over TCP needs a session or a token"
        );
    }
    Ok(Json(app.principals.accounts()))
}

/// Changes an account and ends its sessions; gives all there are.
pub async fn change(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    body: Body,
) -> Answer<Vec<Account>> {
    check_way(&caller.connection())?;
    app.principals.check_known(&name)?;
    let change: AccountChange = read(&app, &caller, body, "change").await?;
    let what = [
        change.password.is_some().then(|| "password".to_owned()),
        change.role.map(|role| role.to_string()),
        change
            .disabled
            .map(|disabled| if disabled { "disabled" } else { "enabled" }.to_owned()),
    ];
    let what: Vec<String> = what.into_iter().flatten().collect();
    about.is(format!("account {name}: {}", what.join(", ")));
    let hash = match &change.password {
        Some(password) => {
            passwords::check(&name, password).map_err(Error::BadRequest)?;
            Some(app.passwords.hash(password.clone()).await?)
        }
        None => None,
    };
    app.principals
        .change_account(&name, &change, hash.as_deref())?;
    Ok(Json(app.principals.accounts()))
}

/// Removes an account and ends its sessions; gives those that are left.
pub async fn remove(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Vec<Account>> {
    about.is(format!("account {name}"));
    app.principals.remove_account(&name)?;
    Ok(Json(app.principals.accounts()))
}

/// Ends all sessions of a person; gives those of others.
pub async fn end_sessions(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Vec<SessionLine>> {
    about.is(format!("sessions of {name}"));
    app.principals.end_sessions_of(&name)?;
    Ok(Json(app.principals.sessions()))
}

impl Caller {
    /// The connection that it asks by.
    fn connection(&self) -> Connection {
        Connection {
            secure: self.secure || matches!(self.peer, Peer::Unix(_)),
            forwarded: self.forwarded,
            ..Connection::plain(self.peer)
        }
    }
}
