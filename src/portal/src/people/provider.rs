//! `/api/v1/oidc/login`, `/api/v1/oidc/callback`: people sign in through an identity provider, which sends them back
//! with a code.

use std::sync::Arc;

use access::AccessAction;
use axum::Extension;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use oidc::Person;
use serde::Deserialize;
use utoipa::IntoParams;

use super::identity_provider::{IdentityProvider, LOGIN};
use super::{check_confidential, cookies, finish_sign_in, no_store};
use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::principals::StartedSession;
use crate::query::{Query, query_value};

/// Path to which the provider sends browsers back, below the portal's own origin.
pub const CALLBACK: &str = "/api/v1/oidc/callback";
/// Maximum number of groups listed in a refusal.
const MAX_NAMED_GROUPS: usize = 20;
/// Content-Security-Policy of the pages: no scripts, styles or frames.
const POLICY: &str = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// Words of the audit log for both steps of a sign-in.
const SIGN_IN: &str = "sign in by the identity provider";

/// Query of a sign-in.
#[derive(Debug, Deserialize, IntoParams)]
pub struct LoginQuery {
    /// Set if the browser was redirected here from another address of this portal.
    #[serde(default)]
    again: bool,
}

/// Query of the provider's redirect (RFC 6749, section 4.1.2; RFC 9207).
#[derive(Debug, IntoParams)]
#[allow(dead_code, reason = "read as they stand, since a provider adds others")]
pub struct CallbackQuery {
    /// State with which the sign-in was started.
    state: String,
    /// Authorization code.
    code: Option<String>,
    /// Error code if the sign-in failed.
    error: Option<String>,
    /// Description of the error.
    error_description: Option<String>,
    /// Issuer identifier of the provider.
    iss: Option<String>,
}

fn redirect(url: &str) -> Result<Response, Error> {
    let location = HeaderValue::from_str(url).map_err(|_| Error::Internal("redirecting a browser"))?;
    Ok((StatusCode::SEE_OTHER, [(header::LOCATION, location)]).into_response())
}

/// Redirects the browser to the provider.
pub async fn login(
    State(app): State<Arc<App>>,
    Query(beginning): Query<LoginQuery>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Response {
    match begin_sign_in(&app, &caller, &headers, beginning.again).await {
        Ok(response) => no_store(response),
        Err(error) => refuse(&app, &caller, &headers, error),
    }
}

async fn begin_sign_in(app: &App, caller: &Caller, headers: &HeaderMap, again: bool) -> Result<Response, Error> {
    let known = app.provider.as_ref().ok_or(Error::NoProvider)?;
    let connection = caller.connection();
    // The provider sends the browser back to this origin, so the cookie must belong to it.
    let here = cookies::origin(&connection, headers);
    if !here.eq_ignore_ascii_case(&known.origin) {
        return if again {
            Err(Error::Foreign {
                what: format!(
                    "this portal was reached at {here}, but redirect in [oidc] of its configuration is {}",
                    known.origin
                ),
                next: "correct redirect; a proxy in front must pass Host on and be named in trusted_proxies".into(),
            })
        } else {
            redirect(&format!("{}{LOGIN}?again=true", known.origin))
        };
    }
    check_confidential(&connection)?;
    app.principals.check_provider_sign_in(caller.peer.ip(), store::now())?;
    let browser = cookies::signing_in_cookie(&connection, headers)?;
    let earlier = cookies::session_cookie(&connection, headers)?;
    let begun = known.provider.begin(browser.as_deref(), caller.peer.ip(), earlier).await?;
    let cookie = cookies::set_signing_in(caller.secure, &begun.browser);
    Ok(([(header::SET_COOKIE, cookie)], redirect(&begun.url)?).into_response())
}

/// Signs in the person whom the provider has sent back.
pub async fn callback(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    uri: Uri,
    headers: HeaderMap,
) -> Response {
    match complete_sign_in(&app, &caller, &uri, &headers).await {
        Ok((begun, earlier)) => {
            let (_, cookie) = finish_sign_in(&app, &caller, &begun, earlier, SIGN_IN, "person");
            // Browsers do not send a cookie with SameSite=Strict when another site, such as the provider, has led to
            // the page. So this page reloads from our own site.
            let body = "<meta http-equiv=\"refresh\" content=\"0; url=/\">\n<title>Signed in</title>\n\
                        <h1>You are signed in</h1>\n<p><a id=\"go-on\" href=\"/\">Go on to the portal</a></p>\n";
            no_store(([(header::SET_COOKIE, cookie)], page(StatusCode::OK, body)))
        }
        Err(error) => {
            if let Error::Provider(refused) = &error
                && refused.is_guess()
            {
                app.principals.record_failed_sign_in(caller.peer.ip(), store::now());
            }
            refuse(&app, &caller, &headers, error)
        }
    }
}

async fn complete_sign_in(
    app: &App,
    caller: &Caller,
    uri: &Uri,
    headers: &HeaderMap,
) -> Result<(StartedSession, Option<String>), Error> {
    let known = app.provider.as_ref().ok_or(Error::NoProvider)?;
    let connection = caller.connection();
    check_confidential(&connection)?;
    cookies::check_visit(headers)?;
    let from = caller.peer.ip();
    app.principals.check_provider_sign_in(from, store::now())?;
    let asked = |name: &str| query_value(uri.query(), name);
    let browser = cookies::signing_in_cookie(&connection, headers)?;
    let state = asked("state").unwrap_or_default();
    let mut started = known.provider.resume(&state, browser.as_deref())?;
    if let Some(error) = asked("error") {
        let reason = match asked("error_description") {
            Some(words) => format!("{error}: {words}"),
            None => error,
        };
        return Err(oidc::Error::from_denial(&reason).into());
    }
    known.provider.check_issuer(asked("iss").as_deref())?;
    let earlier = started.earlier.take();
    let code = asked("code").unwrap_or_default();
    let person = known.provider.finish(started, code).await?;
    let granted = known.roles.grant_for_groups(&person.groups).ok_or_else(|| no_role_error(known, &person))?;
    let issuer = known.provider.issuer();
    let peer = caller.peer.to_string();
    let begun = app.principals.begin_provider_session(issuer, &person, &granted, &peer)?;
    Ok((begun, earlier))
}

fn no_role_error(known: &IdentityProvider, person: &Person) -> Error {
    let plain = |text: &str| -> String { text.chars().filter(|c| !c.is_control()).collect() };
    let groups: Vec<String> = person.groups.iter().map(|group| plain(group)).collect();
    let has = match groups.len() {
        0 => format!("{} gives none in the claim {}", known.name, known.groups_claim),
        1..=MAX_NAMED_GROUPS => format!("{} says {}", known.name, groups.join(", ")),
        more => format!(
            "{} lists {} and {} more",
            known.name,
            groups[..MAX_NAMED_GROUPS].join(", "),
            more - MAX_NAMED_GROUPS
        ),
    };
    Error::NoRole { who: access::principal::oidc_principal_name(&person.name), has }
}

/// Refuses a sign-in, as an HTML page for browsers, and records it.
fn refuse(app: &App, caller: &Caller, headers: &HeaderMap, error: Error) -> Response {
    let problem = error.problem();
    let object = match &error {
        Error::NoRole { who, .. } => format!("person {who}"),
        _ => "a person of the identity provider".to_owned(),
    };
    app.audit.record_throttled(caller, AccessAction::Enter, SIGN_IN, &object, problem.status);
    if let Error::Provider(refused) = &error
        && refused.is_provider_fault()
    {
        tracing::warn!("sign-in failed: {refused}; {}", refused.next_step());
    }
    let accept = headers.get(header::ACCEPT).and_then(|value| value.to_str().ok());
    if !accept.is_some_and(|accept| accept.contains("text/html")) {
        return no_store(error);
    }
    let next = problem.next.as_deref().unwrap_or_default();
    let body = format!(
        "<title>Not signed in</title>\n<h1>You are not signed in</h1>\n<p id=\"why\">{}</p>\n<p id=\"next\">{}</p>\n\
         <p><a href=\"/\">Back to the portal</a></p>\n",
        escape_html(&problem.detail),
        escape_html(next)
    );
    let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::BAD_REQUEST);
    let mut response = no_store(page(status, &body));
    if let Some(after) = problem.retry_after {
        response.headers_mut().insert(header::RETRY_AFTER, after.into());
    }
    response
}

fn page(status: StatusCode, body: &str) -> Response {
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8"),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        // The URL contains the code.
        (header::REFERRER_POLICY, "no-referrer"),
    ];
    let text = format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n{body}</html>\n"
    );
    (status, headers, text).into_response()
}

/// Escapes text for HTML.
fn escape_html(text: &str) -> String {
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
            escape_html("<script>\"a\" & 'b'</script>"),
            "&lt;script&gt;&quot;a&quot; &amp; &#39;b&#39;&lt;/script&gt;"
        );
    }
}
