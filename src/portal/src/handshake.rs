//! WebSocket opening handshake (RFC 6455, section 4.2).

use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderValue, Method, StatusCode, header};
use axum::response::Response;
use base64_simd::STANDARD;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use crate::errors::Error;

/// Length of the decoded key in bytes.
const KEY: usize = 16;

/// Returns the value of `Sec-WebSocket-Accept` that accepts the handshake.
pub fn accept(request: &Request) -> Result<HeaderValue, Error> {
    let bad = |what: &str| Error::BadRequest(format!("not a WebSocket handshake: {what}"));
    let text = |name| request.headers().get(name).and_then(|value| value.to_str().ok());
    if request.method() != Method::GET {
        return Err(bad("the method is not GET"));
    }
    let connection = text(header::CONNECTION).unwrap_or_default();
    if !connection.split(',').any(|option| option.trim().eq_ignore_ascii_case("upgrade")) {
        return Err(bad("the header Connection has no Upgrade"));
    }
    if text(header::SEC_WEBSOCKET_VERSION) != Some("13") {
        return Err(Error::WebSocketVersion);
    }
    let key = text(header::SEC_WEBSOCKET_KEY).map(str::trim).ok_or_else(|| bad("Sec-WebSocket-Key is missing"))?;
    if !STANDARD.decode_to_vec(key).is_ok_and(|bytes| bytes.len() == KEY) {
        return Err(bad("Sec-WebSocket-Key is not 16 bytes in base64"));
    }
    derive_accept_key(key.as_bytes()).parse().map_err(|_| bad("Sec-WebSocket-Key is malformed"))
}

/// Creates the response that turns the connection into a WebSocket; `accepted` is the value of [`accept`].
pub fn switch_protocols(accepted: HeaderValue, subprotocol: Option<&'static str>) -> Response {
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    let headers = response.headers_mut();
    headers.insert(header::CONNECTION, HeaderValue::from_static("Upgrade"));
    headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
    headers.insert(header::SEC_WEBSOCKET_ACCEPT, accepted);
    if let Some(subprotocol) = subprotocol {
        let subprotocol = HeaderValue::from_static(subprotocol);
        headers.insert(header::SEC_WEBSOCKET_PROTOCOL, subprotocol);
    }
    response
}

#[cfg(test)]
mod tests {
    use axum::response::IntoResponse;

    use super::*;

    fn request(headers: &[(&str, &str)]) -> Request {
        let mut request = Request::builder().uri("/opencv_apps");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        request.body(Body::empty()).expect("a request")
    }

    const GOOD: [(&str, &str); 4] = [
        ("connection", "keep-alive, Upgrade"),
        ("upgrade", "websocket"),
        ("sec-websocket-version", "13"),
        ("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ=="),
    ];

    /// Creates the valid handshake with one header replaced or removed.
    fn with_header(header: &str, value: Option<&'static str>) -> Request {
        let headers: Vec<_> = GOOD
            .into_iter()
            .filter_map(
                |(name, good)| {
                    if name == header { value.map(|value| (name, value)) } else { Some((name, good)) }
                },
            )
            .collect();
        request(&headers)
    }

    #[test]
    fn it_is_answered_as_the_standard_says() {
        // The example of RFC 6455, section 1.3.
        assert_eq!(accept(&request(&GOOD)).expect("good"), "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
    }

    #[test]
    fn half_of_it_is_refused() {
        for missing in ["connection", "sec-websocket-key"] {
            let refused = accept(&with_header(missing, None)).expect_err(missing);
            assert_eq!(refused.problem().status, 400, "{missing}");
        }
    }

    #[test]
    fn another_version_is_refused_with_the_one_that_is_spoken() {
        for version in [None, Some("8"), Some("14")] {
            let refused = accept(&with_header("sec-websocket-version", version)).expect_err("refused");
            let response = refused.into_response();
            assert_eq!(response.status(), 426, "{version:?}");
            assert_eq!(response.headers()["sec-websocket-version"], "13");
            assert_eq!(response.headers()["upgrade"], "websocket");
        }
    }

    #[test]
    fn a_key_that_is_not_16_bytes_is_refused() {
        let keys = ["", "x", "dGhlIHNhbXBsZQ==", "dGhlIHNhbXBsZSBub25jZSE=", "!!!!!!!!!!!!!!!!!!!!!!=="];
        for key in keys {
            let refused = accept(&with_header("sec-websocket-key", Some(key))).expect_err(key);
            assert_eq!(refused.problem().status, 400, "{key:?}");
        }
    }
}
