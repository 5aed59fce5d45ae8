//! Clients of image registries (OCI distribution specification, 1.1): the errors that they understand.

use api::Problem;
use axum::Json;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde_json::json;

/// Challenge that makes registry clients ask for a token as the password of any user (RFC 7617). A bearer challenge
/// would need the URL of a token server, but the daemon's tokens are created by an operator.
const CHALLENGE: HeaderValue = HeaderValue::from_static(r#"Basic realm="cloudroid", charset="UTF-8""#);

/// Returns true if the path is the registry's.
pub fn is_registry_path(path: &str) -> bool {
    path == "/v2" || path.starts_with("/v2/")
}

/// Returns true if the request comes from a browser, which would show a dialog when challenged for a password; any page
/// could trigger that. All browsers identify themselves as Mozilla (RFC 9110, section 10.1.5).
fn is_browser(headers: &HeaderMap) -> bool {
    let agent = headers.get(header::USER_AGENT);
    agent.is_some_and(|agent| agent.as_bytes().starts_with(b"Mozilla/"))
}

/// Middleware that turns the problems of a registry request into the errors that registry clients read (OCI
/// distribution specification 1.1, "Error Codes"), whoever refused it: authentication, permissions or a handler.
pub async fn translate_problems(request: Request, next: Next) -> Response {
    let is_registry = is_registry_path(request.uri().path());
    let may_challenge = !is_browser(request.headers());
    let mut response = next.run(request).await;
    match response.extensions_mut().remove::<Problem>() {
        Some(problem) if is_registry => translate(&problem, may_challenge),
        _ => response,
    }
}

/// Builds the error response of a problem; `may_challenge` says whether a 401 asks for a password.
fn translate(problem: &Problem, may_challenge: bool) -> Response {
    let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    let code = match status {
        StatusCode::UNAUTHORIZED => "UNAUTHORIZED",
        StatusCode::FORBIDDEN => "DENIED",
        StatusCode::NOT_FOUND => "NAME_UNKNOWN",
        StatusCode::TOO_MANY_REQUESTS => "TOOMANYREQUESTS",
        StatusCode::SERVICE_UNAVAILABLE => "UNAVAILABLE",
        status if status.is_client_error() => "UNSUPPORTED",
        _ => "UNKNOWN",
    };
    let mut message = problem.to_string();
    if status == StatusCode::UNAUTHORIZED {
        message.push_str("; log in with a token as the password and any user name");
    } else if let Some(next) = &problem.next {
        message = format!("{message}; {next}");
    }
    let mut response = error_response(status, code, &message);
    let headers = response.headers_mut();
    if let Some(seconds) = problem.retry_after {
        headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    if status == StatusCode::UNAUTHORIZED && may_challenge {
        headers.insert(header::WWW_AUTHENTICATE, CHALLENGE);
    }
    response
}

/// Builds an error in the format of registry clients.
pub fn error_response(status: StatusCode, code: &str, message: &str) -> Response {
    (status, Json(json!({ "errors": [{ "code": code, "message": message }] }))).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::errors::Error;
    use crate::principals::refusals::AuthenticationError;

    async fn read_errors(response: Response) -> serde_json::Value {
        let body = axum::body::to_bytes(response.into_body(), 4096).await;
        let body: serde_json::Value = serde_json::from_slice(&body.expect("a body")).expect("a document");
        body["errors"][0].clone()
    }

    #[test]
    fn browsers_are_not_asked_for_a_password() {
        let agent = |agent: &'static str| HeaderMap::from_iter([(header::USER_AGENT, HeaderValue::from_static(agent))]);
        assert!(is_browser(&agent("Mozilla/5.0 (X11; Linux x86_64)")));
        assert!(!is_browser(&agent("skopeo/1.9.3")));
        assert!(!is_browser(&HeaderMap::new()));
        let needed = Error::Unauthorised("a token is needed").problem();
        let response = translate(&needed, false);
        assert!(!response.headers().contains_key(header::WWW_AUTHENTICATE));
    }

    #[tokio::test]
    async fn clients_of_registries_are_asked_for_a_password_in_their_words() {
        let response = translate(&Error::Unauthorised("a token is needed").problem(), true);
        assert_eq!(response.status(), StatusCode::UNAUTHORIZED);
        // A `Bearer` challenge without the URL of a token server makes skopeo and containerd give up.
        let challenges = response.headers().get_all(header::WWW_AUTHENTICATE);
        assert_eq!(challenges.iter().collect::<Vec<_>>(), [&CHALLENGE]);
        assert_eq!(read_errors(response).await["code"], "UNAUTHORIZED");
    }

    #[tokio::test]
    async fn clients_of_registries_read_each_refusal_in_their_format() {
        let slowed = Error::from(AuthenticationError::Slowed(3_001));
        let response = translate(&slowed.problem(), true);
        assert_eq!(response.status(), StatusCode::TOO_MANY_REQUESTS);
        assert_eq!(response.headers()[header::RETRY_AFTER], "4");
        assert_eq!(read_errors(response).await["code"], "TOOMANYREQUESTS");
        for (status, code) in
            [(403, "DENIED"), (404, "NAME_UNKNOWN"), (400, "UNSUPPORTED"), (503, "UNAVAILABLE"), (500, "UNKNOWN")]
        {
            let problem = Problem { status, detail: "no".into(), next: Some("ask".into()), ..Problem::default() };
            let response = translate(&problem, true);
            assert_eq!(response.status(), status);
            let error = read_errors(response).await;
            assert_eq!((&error["code"], &error["message"]), (&json!(code), &json!("no; ask")));
        }
    }
}
