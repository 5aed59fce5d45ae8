//! The portal's page: the output of `make web` in `web/`, compiled in. Each file is included both plain and
//! compressed, so that no request needs compression.

use axum::extract::Path;
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::response::{IntoResponse, Response};
use include_dir::{Dir, include_dir};

use crate::errors::Error;

/// Empty if cargo was run without make.
static BUILT_PAGE: Dir<'_> = include_dir!("$CARGO_MANIFEST_DIR/../../web/dist");

const INDEX: &str = "index.html";
/// Placeholder for a page that was not built.
const UNBUILT: &[u8] = include_bytes!("page/unbuilt.html");
/// Content-Security-Policy: only our own files, and no framing of the page.
const POLICY: &str = "default-src 'none'; style-src 'self'; script-src 'self'; img-src 'self'; connect-src 'self'; \
                      frame-ancestors 'none'; base-uri 'none'; form-action 'none'";
/// The one asset whose name does not change: licences of third-party code.
const LICENCES: &str = "licences.txt";
/// Caching of the other assets, whose names change with their content.
const FOR_GOOD: &str = "public, max-age=31536000, immutable";
/// Suffixes by `Accept-Encoding` (RFC 9110, 12.5.3), best compression first.
const ENCODINGS: [(&str, &str); 2] = [("br", ".br"), ("gzip", ".gz")];

/// `/`.
pub fn index(method: &Method, headers: &HeaderMap) -> Response {
    if !matches!(*method, Method::GET | Method::HEAD) {
        let refusal = Error::OtherMethod { method: method.to_string(), path: "/".to_owned() };
        let allowed = [(header::ALLOW, "GET, HEAD")];
        return (allowed, refusal).into_response();
    }
    match file(INDEX, headers, "no-cache") {
        Some(page) => page,
        None => answer(INDEX, "no-cache", UNBUILT, None),
    }
}

/// `/assets/NAME`.
pub async fn asset(Path(name): Path<String>, headers: HeaderMap) -> Response {
    let known = ENCODINGS.iter().all(|(_, ending)| !name.ends_with(ending));
    let kept = match &*name {
        LICENCES => "no-cache",
        _ => FOR_GOOD,
    };
    let found = known.then(|| file(&format!("assets/{name}"), &headers, kept));
    found.flatten().unwrap_or_else(|| Error::UnknownPath { path: format!("/assets/{name}") }.into_response())
}

/// Returns a file in the smallest form that the client accepts.
fn file(path: &str, headers: &HeaderMap, kept: &'static str) -> Option<Response> {
    let compressed = |(encoding, ending): (&'static str, &str)| {
        let file = BUILT_PAGE.get_file(format!("{path}{ending}"))?;
        accepts_encoding(headers, encoding).then_some((file, Some(encoding)))
    };
    let found = ENCODINGS.into_iter().find_map(compressed);
    let (file, encoding) = match found {
        Some(found) => found,
        None => (BUILT_PAGE.get_file(path)?, None),
    };
    Some(answer(path, kept, file.contents(), encoding))
}

/// Returns true if the client accepts the encoding, according to `Accept-Encoding`.
fn accepts_encoding(headers: &HeaderMap, encoding: &str) -> bool {
    let said = headers.get_all(header::ACCEPT_ENCODING);
    let words = said.iter().filter_map(|value| value.to_str().ok());
    words.flat_map(|value| value.split(',')).any(|one| {
        let (name, weight) = one.split_once(';').unwrap_or((one, ""));
        let weight = weight.trim().strip_prefix("q=").unwrap_or("1");
        name.trim().eq_ignore_ascii_case(encoding) && weight.parse() != Ok(0.0_f32)
    })
}

fn answer(path: &str, kept: &'static str, data: &'static [u8], encoding: Option<&'static str>) -> Response {
    let headers = [
        (header::CONTENT_TYPE, media_type(path)),
        (header::CACHE_CONTROL, kept),
        (header::VARY, "accept-encoding"),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
    ];
    let mut answer = (headers, data).into_response();
    if let Some(encoding) = encoding {
        let encoding = HeaderValue::from_static(encoding);
        answer.headers_mut().insert(header::CONTENT_ENCODING, encoding);
    }
    answer
}

/// Returns the media type of a file written by Vite.
fn media_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, ending)| ending) {
        "html" => "text/html; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "svg" => "image/svg+xml",
        "txt" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use axum::http::StatusCode;

    use super::*;

    fn headers(accepts: &str) -> HeaderMap {
        let mut headers = HeaderMap::new();
        let value = accepts.parse().expect("a header");
        headers.insert(header::ACCEPT_ENCODING, value);
        headers
    }

    #[test]
    fn a_client_is_given_what_it_takes() {
        for (accepts, encoding, taken) in [
            ("gzip, deflate, br", "br", true),
            ("gzip;q=0.5,BR;q=1.0", "br", true),
            ("br;q=0, gzip", "br", false),
            ("br; q=0.0", "br", false),
            ("browse", "br", false),
            ("", "gzip", false),
        ] {
            assert_eq!(accepts_encoding(&headers(accepts), encoding), taken, "{accepts:?} {encoding}");
        }
        assert!(!accepts_encoding(&HeaderMap::new(), "gzip"));
    }

    #[test]
    fn the_page_is_never_kept_and_there_even_when_it_was_not_built() {
        let page = index(&Method::GET, &headers("br"));
        assert_eq!(page.status(), StatusCode::OK);
        assert_eq!(page.headers()[header::CACHE_CONTROL], "no-cache");
        assert_eq!(page.headers()[header::CONTENT_SECURITY_POLICY], POLICY);
        let posted = index(&Method::POST, &HeaderMap::new());
        assert_eq!(posted.status(), StatusCode::METHOD_NOT_ALLOWED);
    }

    #[tokio::test]
    async fn all_that_was_built_is_answered_as_what_it_is() {
        let assets = BUILT_PAGE.get_dir("assets").into_iter().flat_map(Dir::files);
        for file in assets {
            let name = file.path().file_name().and_then(|name| name.to_str());
            let name = name.expect("a name of ASCII");
            let answer = asset(Path(name.to_owned()), headers("gzip")).await;
            let is_compressed = ENCODINGS.iter().any(|(_, ending)| name.ends_with(ending));
            if is_compressed {
                assert_eq!(answer.status(), StatusCode::NOT_FOUND, "{name}");
                continue;
            }
            assert_eq!(answer.status(), StatusCode::OK, "{name}");
            assert_ne!(media_type(name), "application/octet-stream", "{name}");
            assert_eq!(answer.headers()[header::CONTENT_ENCODING], "gzip", "{name}");
            let is_kept = answer.headers()[header::CACHE_CONTROL] == FOR_GOOD;
            assert_eq!(is_kept, name != LICENCES, "{name}");
        }
        let unknown = asset(Path("../index.html".into()), HeaderMap::new()).await;
        assert_eq!(unknown.status(), StatusCode::NOT_FOUND);
    }
}
