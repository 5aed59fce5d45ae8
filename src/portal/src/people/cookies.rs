//! Session cookie of a browser (RFC 6265), and the checks that tell requests of our own page from those of other
//! sites.

use axum::http::{HeaderMap, HeaderValue, Method, header};

use crate::caller::PortalConnection;
use crate::errors::Error;
use crate::guard::elsewhere;
use crate::headers;
use crate::tokens;

/// Cookie name with TLS. Because of the prefix, browsers accept it only from this host, for all paths, and send it
/// only through TLS.
const SECURE: &str = "__Host-cloudroid";
/// Cookie name without TLS, on this machine, where browsers accept no `Secure` cookie. It is ignored through TLS.
const PLAIN: &str = "cloudroid";
/// Cookie names while a person signs in at an identity provider; they identify the browser when it returns. Another
/// site redirects it here, so the cookie is SameSite=Lax: it is sent with top-level navigation from elsewhere, and
/// with nothing else.
const SECURE_SIGNING_IN: &str = "__Host-cloudroid-oidc";
const PLAIN_SIGNING_IN: &str = "cloudroid-oidc";
/// Time in seconds that this may take.
const SIGN_IN_SECONDS: u64 = 600;
/// Header in which browsers tell how a response will be used (Fetch Metadata, W3C).
const FETCH_DEST: &str = "sec-fetch-dest";
/// Header in which browsers tell where a request comes from (Fetch Metadata, W3C).
const FETCH_SITE: &str = "sec-fetch-site";
/// Maximum length of a secret in bytes.
const LONGEST: usize = 128;

fn session_cookie_name(secure: bool) -> &'static str {
    if secure { SECURE } else { PLAIN }
}

fn signing_in_cookie_name(secure: bool) -> &'static str {
    if secure { SECURE_SIGNING_IN } else { PLAIN_SIGNING_IN }
}

/// Returns the session secret sent by the browser, if any.
pub fn session_cookie(connection: &PortalConnection, headers: &HeaderMap) -> Result<Option<String>, Error> {
    find_cookie(session_cookie_name(connection.secure), headers)
}

/// Returns the value that identifies a browser during a sign-in, if any.
pub fn signing_in_cookie(connection: &PortalConnection, headers: &HeaderMap) -> Result<Option<String>, Error> {
    find_cookie(signing_in_cookie_name(connection.secure), headers)
}

fn find_cookie(name: &str, headers: &HeaderMap) -> Result<Option<String>, Error> {
    let lines = headers.get_all(header::COOKIE).iter();
    let mut values = lines
        .filter_map(|line| line.to_str().ok())
        .flat_map(|line| line.split(';'))
        .filter_map(|pair| pair.trim().split_once('='))
        .filter(|(key, _)| *key == name)
        .map(|(_, value)| value);
    match (values.next(), values.next()) {
        // Somebody else may have set one of them, and must not be able to choose which counts.
        (Some(_), Some(_)) => Err(Error::BadRequest(format!(
            "the cookie {name} was sent twice; remove this site's cookies from the browser and sign in again"
        ))),
        (Some(value), None) if value.len() <= LONGEST && !value.is_empty() => Ok(Some(value.to_owned())),
        _ => Ok(None),
    }
}

fn build_cookie(secure: bool, name: &str, value: &str, seconds: u64, same_site: &str) -> HeaderValue {
    let secured = if secure { "; Secure" } else { "" };
    let text = format!("{name}={value}; Path=/; Max-Age={seconds}; HttpOnly; SameSite={same_site}{secured}");
    // Secrets consist of letters and digits.
    HeaderValue::from_str(&text).unwrap_or_else(|_| HeaderValue::from_static(""))
}

/// Sets the session cookie for a number of seconds.
pub fn set_session(secure: bool, secret: &str, seconds: u64) -> HeaderValue {
    build_cookie(secure, session_cookie_name(secure), secret, seconds, "Strict")
}

/// Deletes the session cookie.
pub fn clear_session(secure: bool) -> HeaderValue {
    build_cookie(secure, session_cookie_name(secure), "", 0, "Strict")
}

/// Sets the cookie that identifies the browser during a sign-in.
pub fn set_signing_in(secure: bool, secret: &str) -> HeaderValue {
    build_cookie(secure, signing_in_cookie_name(secure), secret, SIGN_IN_SECONDS, "Lax")
}

/// Returns the token that requests changing something must send along with the session cookie.
pub fn csrf_token(secret: &str) -> String {
    tokens::hash(&format!("csrf {secret}"))
}

fn header_text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name).map(|value| value.to_str().unwrap_or("?"))
}

/// Returns the origin under which the request reached this portal (RFC 6454).
pub fn origin(connection: &PortalConnection, headers: &HeaderMap) -> String {
    let host = header_text(headers, "host").unwrap_or_default();
    let scheme = if connection.secure { "https" } else { "http" };
    format!("{scheme}://{host}")
}

/// Refuses requests that are not top-level navigation, such as for an image or a frame of another page: they do not
/// come from a person returning from a sign-in.
pub fn check_visit(headers: &HeaderMap) -> Result<(), Error> {
    match header_text(headers, FETCH_DEST) {
        None | Some("document") => Ok(()),
        Some(other) => Err(Error::Foreign {
            what: format!("this was requested by a page as part of itself ({other}), not by a person"),
            next: "sign in from the portal's page".into(),
        }),
    }
}

/// Refuses requests sent by another site's page. With `said`, the browser must state that the page is ours; without,
/// a request that states nothing is not from a browser and passes.
pub fn check_origin(connection: &PortalConnection, headers: &HeaderMap, said: bool) -> Result<(), Error> {
    let own = origin(connection, headers);
    let origins = headers.get_all(header::ORIGIN).iter().count();
    let (same, from) = match (header_text(headers, "origin"), header_text(headers, FETCH_SITE)) {
        (Some(origin), site) => {
            (origins == 1 && origin.eq_ignore_ascii_case(&own) && site.is_none_or(|site| site == "same-origin"), origin)
        }
        (None, Some(site)) => (site == "same-origin", "another site"),
        (None, None) => (!said, "an unknown site"),
    };
    if same {
        return Ok(());
    }
    Err(Error::Foreign {
        what: format!("a page of {from} may not use a session of {own}"),
        next: "use the portal's own page, or a token (Authorization: Bearer TOKEN); a proxy in front must pass Host \
               on and be named in trusted_proxies"
            .to_owned(),
    })
}

/// Refuses a request with a session cookie that our own page would not have sent.
pub fn check(connection: &PortalConnection, method: &Method, headers: &HeaderMap, secret: &str) -> Result<(), Error> {
    let reads = matches!(*method, Method::GET | Method::HEAD);
    let upgrades = headers::is_upgrade(headers);
    if reads && !upgrades {
        return elsewhere::check_not_embedded(headers);
    }
    check_origin(connection, headers, true)?;
    // A page cannot set headers of a WebSocket handshake; browsers always send its origin.
    if upgrades {
        return if headers.contains_key(header::ORIGIN) {
            Ok(())
        } else {
            check_origin(connection, &HeaderMap::new(), true)
        };
    }
    let given = header_text(headers, api::people::CSRF_HEADER).unwrap_or_default();
    // Compares hashes, so that the timing reveals nothing about the expected value.
    if tokens::hash(given) == tokens::hash(&csrf_token(secret)) {
        return Ok(());
    }
    Err(Error::Foreign {
        what: "the request has a session but not its X-CSRF-Token".into(),
        next: "send the csrf value of GET /api/v1/session".into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::caller::ConnectionPeer;

    fn connection(secure: bool) -> PortalConnection {
        let peer = ConnectionPeer::Tcp("127.0.0.1:5000".parse().expect("an address"));
        PortalConnection { secure, ..PortalConnection::without_tls(peer) }
    }

    fn headers(given: &[(&'static str, &str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in given {
            headers.append(*name, value.parse().expect("a value"));
        }
        headers
    }

    #[test]
    fn a_cookie_is_read_where_it_is_one() {
        let shown = |secure, lines: &[&str]| {
            let lines: Vec<_> = lines.iter().map(|line| ("cookie", *line)).collect();
            session_cookie(&connection(secure), &headers(&lines)).map_err(|error| error.problem().status)
        };
        assert_eq!(shown(false, &["a=b; cloudroid=x"]), Ok(Some("x".into())));
        assert_eq!(shown(true, &["__Host-cloudroid=x"]), Ok(Some("x".into())));
        // A cookie set without TLS may come from somebody else.
        assert_eq!(shown(true, &["cloudroid=x"]), Ok(None));
        assert_eq!(shown(false, &["__Host-cloudroid=x"]), Ok(None));
        assert_eq!(shown(false, &["cloudroid="]), Ok(None));
        assert_eq!(shown(false, &[&format!("cloudroid={}", "x".repeat(1000))]), Ok(None));
        assert_eq!(shown(false, &["cloudroid=x; cloudroid=y"]), Err(400));
        assert_eq!(shown(false, &["cloudroid=x", "cloudroid=x"]), Err(400));
    }

    #[test]
    fn cookies_are_closed_to_scripts_and_other_sites() {
        let set = set_session(true, "x", 60);
        assert_eq!(
            set.to_str().expect("text"),
            "__Host-cloudroid=x; Path=/; Max-Age=60; HttpOnly; SameSite=Strict; Secure"
        );
        let forgotten = clear_session(false);
        let text = forgotten.to_str().expect("text");
        assert!(text.starts_with("cloudroid=; ") && text.contains("Max-Age=0"), "{text}");
    }

    #[test]
    fn whoever_signs_in_elsewhere_is_known_when_it_comes_back() {
        let set = set_signing_in(true, "x");
        assert_eq!(
            set.to_str().expect("text"),
            "__Host-cloudroid-oidc=x; Path=/; Max-Age=600; HttpOnly; SameSite=Lax; Secure"
        );
        let lines = headers(&[("cookie", "cloudroid=a; cloudroid-oidc=b; __Host-cloudroid-oidc=c")]);
        let known = |secure| signing_in_cookie(&connection(secure), &lines).expect("once");
        assert_eq!(known(false).as_deref(), Some("b"));
        assert_eq!(known(true).as_deref(), Some("c"));
        check_visit(&headers(&[])).expect("no browser");
        check_visit(&headers(&[("sec-fetch-dest", "document")])).expect("a person");
        for part in ["image", "iframe", "empty"] {
            check_visit(&headers(&[("sec-fetch-dest", part)])).expect_err(part);
        }
    }

    #[test]
    fn what_changes_something_comes_from_our_page_with_its_token() {
        let token = csrf_token("secret");
        let own = ("origin", "https://robots.lab:9090");
        let host = ("host", "robots.lab:9090");
        let with = (api::people::CSRF_HEADER, &*token);
        let upgrade = ("upgrade", "websocket");
        let asks = |method: Method, given: &[(&'static str, &str)]| {
            check(&connection(true), &method, &headers(given), "secret").is_ok()
        };
        assert!(asks(Method::GET, &[host]));
        // Embedded in another site's page.
        assert!(!asks(Method::GET, &[host, ("sec-fetch-site", "same-site")]));
        assert!(asks(Method::DELETE, &[host, own, with]));
        assert!(asks(Method::POST, &[host, ("sec-fetch-site", "same-origin"), with]));
        assert!(asks(Method::GET, &[host, own, upgrade]));
        let other = csrf_token("another");
        for (method, given) in [
            (Method::DELETE, &[host, own][..]),
            (Method::DELETE, &[host, with]),
            (Method::DELETE, &[host, own, (api::people::CSRF_HEADER, &other)]),
            (Method::DELETE, &[host, ("origin", "https://evil.example"), with]),
            (Method::DELETE, &[host, ("origin", "http://robots.lab:9090"), with]),
            (Method::DELETE, &[host, ("origin", "https://robots.lab"), with]),
            (Method::DELETE, &[host, ("origin", "null"), with]),
            (Method::DELETE, &[host, own, own, with]),
            (Method::POST, &[host, own, ("sec-fetch-site", "same-site"), with]),
            (Method::POST, &[host, ("sec-fetch-site", "none"), with]),
            (Method::GET, &[host, upgrade]),
            (Method::GET, &[host, ("origin", "https://evil.example"), upgrade]),
            (Method::GET, &[host, ("sec-fetch-site", "same-origin"), upgrade]),
        ] {
            assert!(!asks(method.clone(), given), "{method} {given:?}");
        }
    }
}
