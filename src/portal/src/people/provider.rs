//! `/api/v1/oidc/login`, `/api/v1/oidc/callback`: people sign in by an identity provider, and come back with a code.

use std::sync::Arc;

use access::Action;
use api::people::ProviderLink;
use axum::Extension;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use oidc::{Person, Roles};
use serde::Deserialize;
use utoipa::IntoParams;

use super::{check_way, cookies, enter, unkept};
use crate::app::App;
use crate::errors::Error;
use crate::guard::{self, Caller};
use crate::principals::Begun;
use crate::query::Query;

/// Where it begins.
const LOGIN: &str = "/api/v1/oidc/login";
/// Where the provider sends browsers back to, behind the portal's own address.
pub const CALLBACK: &str = "/api/v1/oidc/callback";
/// Groups that a refusal names.
const NAMED: usize = 20;
/// Scripts, styles and frames: nothing of it.
const POLICY: &str =
    "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// An identity provider, and what its people may do.
pub struct IdentityProvider {
    /// Who asks it.
    pub provider: oidc::Provider,
    /// As people know it.
    pub name: String,
    /// What its groups may do.
    pub roles: Roles,
    /// The portal's own address, as browsers write it (RFC 6454): `https://HOST[:PORT]`.
    pub origin: String,
    /// The claim that has the groups, for those who have none.
    pub groups_claim: String,
}

impl IdentityProvider {
    /// What the page needs for a link.
    pub fn link(&self) -> ProviderLink {
        ProviderLink {
            name: self.name.clone(),
            path: LOGIN.to_owned(),
        }
    }
}

/// How a sign-in begins.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Beginning {
    /// Set where the browser has come here from another address of this portal.
    #[serde(default)]
    again: bool,
}

/// With what a browser comes back (RFC 6749, section 4.1.2; RFC 9207).
#[derive(Debug, IntoParams)]
#[allow(dead_code, reason = "read as they stand, since a provider adds others")]
pub struct ComingBack {
    /// What the sign-in began with.
    state: String,
    /// By which the provider tells who it is.
    code: Option<String>,
    /// Why nobody signed in.
    error: Option<String>,
    /// The same in words.
    error_description: Option<String>,
    /// The provider's issuer identifier.
    iss: Option<String>,
}

fn goes_to(url: &str) -> Result<Response, Error> {
    let location =
        HeaderValue::from_str(url).map_err(|_| Error::Internal("sending a browser on"))?;
    Ok((StatusCode::SEE_OTHER, [(header::LOCATION, location)]).into_response())
}

/// Sends the browser to the provider.
pub async fn login(
    State(app): State<Arc<App>>,
    Query(beginning): Query<Beginning>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Response {
    match begin(&app, &caller, &headers, beginning.again).await {
        Ok(response) => unkept(response),
        Err(error) => refuse(&app, &caller, &headers, LOGIN, error),
    }
}

async fn begin(
    app: &App,
    caller: &Caller,
    headers: &HeaderMap,
    again: bool,
) -> Result<Response, Error> {
    let known = app.provider.as_ref().ok_or(Error::NoProvider)?;
    let connection = caller.connection();
    // The cookie of this sign-in must be this origin's: the provider sends the browser back there.
    let here = cookies::origin(&connection, headers);
    if !here.eq_ignore_ascii_case(&known.origin) {
        return match again {
            false => goes_to(&format!("{}{LOGIN}?again=true", known.origin)),
            true => Err(Error::Foreign {
                what: format!(
                    "this portal is asked at {here}, and [oidc] redirect of its configuration says {}",
                    known.origin
                ),
                next: "correct redirect; a proxy in front must pass Host on and be named in trusted_proxies".into(),
            }),
        };
    }
    check_way(&connection)?;
    app.principals.may_come(caller.peer.ip(), store::now())?;
    let browser = cookies::signing_in(&connection, headers)?;
    let earlier = cookies::shown(&connection, headers)?;
    let begun = known
        .provider
        .begin(browser.as_deref(), caller.peer.ip(), earlier)
        .await?;
    let cookie = cookies::kept_signing_in(caller.secure, &begun.browser);
    Ok(([(header::SET_COOKIE, cookie)], goes_to(&begun.url)?).into_response())
}

/// Signs in whoever comes back from the provider.
pub async fn callback(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    uri: Uri,
    headers: HeaderMap,
) -> Response {
    match signed_in(&app, &caller, &uri, &headers).await {
        Ok((begun, earlier)) => {
            let did = format!("GET {CALLBACK}");
            let (_, cookie) = enter(&app, &caller, &begun, earlier, &did, "person");
            // Browsers show a cookie of SameSite=Strict to no page that another site has sent them to, and the provider has sent them
            // here. The page that goes on from here is asked for by our own.
            let body = "<meta http-equiv=\"refresh\" content=\"0; url=/\">\n<title>Signed in</title>\n\
                        <h1>You are signed in</h1>\n<p><a id=\"go-on\" href=\"/\">Go on to the portal</a></p>\n";
            unkept(([(header::SET_COOKIE, cookie)], page(StatusCode::OK, body)))
        }
        Err(error) => {
            if let Error::Provider(refused) = &error
                && refused.is_guess()
            {
                app.principals
                    .mistaken_sign_in(caller.peer.ip(), store::now());
            }
            refuse(&app, &caller, &headers, CALLBACK, error)
        }
    }
}

async fn signed_in(
    app: &App,
    caller: &Caller,
    uri: &Uri,
    headers: &HeaderMap,
) -> Result<(Begun, Option<String>), Error> {
    let known = app.provider.as_ref().ok_or(Error::NoProvider)?;
    let connection = caller.connection();
    check_way(&connection)?;
    cookies::check_visit(headers)?;
    let from = caller.peer.ip();
    app.principals.may_come(from, store::now())?;
    let asked = |name: &str| guard::query(uri.query(), name);
    let browser = cookies::signing_in(&connection, headers)?;
    let state = asked("state").unwrap_or_default();
    let mut started = known.provider.take(&state, browser.as_deref())?;
    if let Some(error) = asked("error") {
        let reason = match asked("error_description") {
            Some(words) => format!("{error}: {words}"),
            None => error,
        };
        return Err(oidc::Error::denied(&reason).into());
    }
    known.provider.check_issuer(asked("iss").as_deref())?;
    let earlier = started.earlier.take();
    let code = asked("code").unwrap_or_default();
    let person = known.provider.finish(started, code).await?;
    let granted = known
        .roles
        .of(&person.groups)
        .ok_or_else(|| without_role(known, &person))?;
    let issuer = known.provider.issuer();
    let peer = caller.peer.to_string();
    let begun = app
        .principals
        .begin_provided(issuer, &person, &granted, &peer)?;
    Ok((begun, earlier))
}

fn without_role(known: &IdentityProvider, person: &Person) -> Error {
    let plain = |text: &str| -> String { text.chars().filter(|c| !c.is_control()).collect() };
    let groups: Vec<String> = person.groups.iter().map(|group| plain(group)).collect();
    let has = match groups.len() {
        0 => format!(
            "{} names none in the claim {}",
            known.name, known.groups_claim
        ),
        1..=NAMED => format!("{} says {}", known.name, groups.join(", ")),
        more => format!(
            "{} says {}, and {} more",
            known.name,
            groups[..NAMED].join(", "),
            more - NAMED
        ),
    };
    Error::NoRole {
        who: access::principal::provided_name(&person.name),
        has,
    }
}

/// Refuses, to a browser by a page, and writes it down.
fn refuse(app: &App, caller: &Caller, headers: &HeaderMap, path: &str, error: Error) -> Response {
    let problem = error.problem();
    let object = match &error {
        Error::NoRole { who, .. } => format!("person {who}"),
        _ => "a person of the identity provider".to_owned(),
    };
    let did = format!("GET {path}");
    app.audit
        .record_sparingly(caller, Action::Enter, &did, &object, problem.status);
    if let Error::Provider(refused) = &error
        && refused.is_providers()
    {
        tracing::warn!("nobody is signed in: {refused}; {}", refused.next());
    }
    let accept = headers
        .get(header::ACCEPT)
        .and_then(|value| value.to_str().ok());
    if !accept.is_some_and(|accept| accept.contains("text/html")) {
        return unkept(error);
    }
    let next = problem.next.as_deref().unwrap_or_default();
    let body = format!(
        "<title>Not signed in</title>\n<h1>You are not signed in</h1>\n<p id=\"why\">{}</p>\n<p id=\"next\">{}</p>\n\
         <p><a href=\"/\">Back to the portal</a></p>\n",
        escaped(&problem.detail),
        escaped(next)
    );
    let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::BAD_REQUEST);
    let mut response = unkept(page(status, &body));
    if let Some(after) = problem.retry_after {
        response
            .headers_mut()
            .insert(header::RETRY_AFTER, after.into());
    }
    response
}

fn page(status: StatusCode, body: &str) -> Response {
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8"),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        // Its address has the code.
        (header::REFERRER_POLICY, "no-referrer"),
    ];
    let text = format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n{body}</html>\n"
    );
    (status, headers, text).into_response()
}

/// A text within a page.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            c => safe.push(c),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_provider_says_is_text_in_a_page() {
        assert_eq!(
            escaped("<script>\"a\" & 'b'</script>"),
            "&lt;script&gt;&quot;a&quot; &amp; &#39;b&#39;&lt;/script&gt;"
        );
    }
}
