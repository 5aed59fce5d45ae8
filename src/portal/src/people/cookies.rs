//! The cookie by which a browser shows its session (RFC 6265), and the marks by which a request of our own page is told from one
//! of another site's.

use axum::http::{HeaderMap, HeaderValue, Method, header};

use crate::errors::Error;
use crate::guard::{self, Connection};
use crate::tokens;

/// Through TLS. By its prefix browsers take it from this host alone, for all of it, and show it through TLS alone.
const SECURE: &str = "__Host-cloudroid";
/// Without TLS, on this machine: browsers take no `Secure` cookie there. It is never looked at through TLS.
const PLAIN: &str = "cloudroid";
/// While somebody says to an identity provider who it is: by this the browser is known when it comes back. Another site's answer
/// leads it here, and so it is SameSite=Lax: shown to an address that somebody goes to from elsewhere, and to nothing else.
const SECURE_SIGNING_IN: &str = "__Host-cloudroid-oidc";
const PLAIN_SIGNING_IN: &str = "cloudroid-oidc";
/// How long that may take.
const SIGNING_IN: u64 = 600;
/// What browsers say of what they ask for.
const FETCH_DEST: &str = "sec-fetch-dest";
/// What browsers say of where a request comes from (Fetch Metadata, W3C).
const FETCH_SITE: &str = "sec-fetch-site";
/// Longest secret that is looked at.
const LONGEST: usize = 128;

fn name(secure: bool) -> &'static str {
    if secure { SECURE } else { PLAIN }
}

fn signing_in_name(secure: bool) -> &'static str {
    if secure {
        SECURE_SIGNING_IN
    } else {
        PLAIN_SIGNING_IN
    }
}

/// What the browser shows of its session, if anything.
pub fn shown(connection: &Connection, headers: &HeaderMap) -> Result<Option<String>, Error> {
    value(name(connection.secure), headers)
}

/// By what a browser is known in which somebody is signing in.
pub fn signing_in(connection: &Connection, headers: &HeaderMap) -> Result<Option<String>, Error> {
    value(signing_in_name(connection.secure), headers)
}

fn value(name: &str, headers: &HeaderMap) -> Result<Option<String>, Error> {
    let lines = headers.get_all(header::COOKIE).iter();
    let mut values = lines
        .filter_map(|line| line.to_str().ok())
        .flat_map(|line| line.split(';'))
        .filter_map(|pair| pair.trim().split_once('='))
        .filter(|(key, _)| *key == name)
        .map(|(_, value)| value);
    match (values.next(), values.next()) {
        // Another put it there: which one counts must not be its choice.
        (Some(_), Some(_)) => Err(Error::BadRequest(format!(
            "the cookie {name} is there twice; remove this site's cookies from the browser and sign in again"
        ))),
        (Some(value), None) if value.len() <= LONGEST && !value.is_empty() => {
            Ok(Some(value.to_owned()))
        }
        _ => Ok(None),
    }
}

fn cookie(secure: bool, name: &str, value: &str, seconds: u64, same_site: &str) -> HeaderValue {
    let secured = if secure { "; Secure" } else { "" };
    let text = format!(
        "{name}={value}; Path=/; Max-Age={seconds}; HttpOnly; SameSite={same_site}{secured}"
    );
    // Secrets are letters and digits.
    HeaderValue::from_str(&text).unwrap_or_else(|_| HeaderValue::from_static(""))
}

/// Has the browser keep a secret for so many seconds.
pub fn kept(secure: bool, secret: &str, seconds: u64) -> HeaderValue {
    cookie(secure, name(secure), secret, seconds, "Strict")
}

/// Has the browser forget it.
pub fn forgotten(secure: bool) -> HeaderValue {
    cookie(secure, name(secure), "", 0, "Strict")
}

/// Has the browser keep by what it is known while somebody signs in.
pub fn kept_signing_in(secure: bool, secret: &str) -> HeaderValue {
    cookie(secure, signing_in_name(secure), secret, SIGNING_IN, "Lax")
}

/// What requests of a session that change something must show beside the cookie.
pub fn csrf(secret: &str) -> String {
    tokens::hash(&format!("csrf {secret}"))
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name).map(|value| value.to_str().unwrap_or("?"))
}

/// The origin by which a request reached this portal (RFC 6454).
pub fn origin(connection: &Connection, headers: &HeaderMap) -> String {
    let host = text(headers, "host").unwrap_or_default();
    let scheme = if connection.secure { "https" } else { "http" };
    format!("{scheme}://{host}")
}

/// Refuses an address that a browser asks for without showing it to anybody, as for a picture or a frame of another page: that is
/// nobody who comes back from signing in.
pub fn check_visit(headers: &HeaderMap) -> Result<(), Error> {
    match text(headers, FETCH_DEST) {
        None | Some("document") => Ok(()),
        Some(other) => Err(Error::Foreign {
            what: format!(
                "a page has asked for this as a part of itself ({other}), and not a person"
            ),
            next: "sign in from the portal's page".into(),
        }),
    }
}

/// Refuses what another site's page has sent. `said`: the browser must say that it is our own page; else what says nothing is no
/// browser.
pub fn check_origin(connection: &Connection, headers: &HeaderMap, said: bool) -> Result<(), Error> {
    let own = origin(connection, headers);
    let origins = headers.get_all(header::ORIGIN).iter().count();
    let (same, from) = match (text(headers, "origin"), text(headers, FETCH_SITE)) {
        (Some(origin), site) => (
            origins == 1
                && origin.eq_ignore_ascii_case(&own)
                && site.is_none_or(|site| site == "same-origin"),
            origin,
        ),
        (None, Some(site)) => (site == "same-origin", "another site"),
        (None, None) => (!said, "an unknown site"),
    };
    if same {
        return Ok(());
    }
    Err(Error::Foreign {
        what: format!("a page of {from} may not use the session of somebody who is signed in at {own}"),
        next: "use the portal's own page, or a token (Authorization: Bearer TOKEN); a proxy in front must pass Host on and be named in \
               trusted_proxies"
            .to_owned(),
    })
}

/// Refuses a request by cookie that our own page would not have sent so.
pub fn check(
    connection: &Connection,
    method: &Method,
    headers: &HeaderMap,
    secret: &str,
) -> Result<(), Error> {
    let reads = matches!(*method, Method::GET | Method::HEAD);
    let upgrades = guard::is_upgrade(headers);
    if reads && !upgrades {
        return guard::check_part(headers);
    }
    check_origin(connection, headers, true)?;
    // A page cannot set a header of a WebSocket; browsers always say its origin.
    if upgrades {
        return match headers.contains_key(header::ORIGIN) {
            true => Ok(()),
            false => check_origin(connection, &HeaderMap::new(), true),
        };
    }
    let given = text(headers, api::people::CSRF_HEADER).unwrap_or_default();
    // Of hashes: how long the comparison takes says nothing of what was expected.
    if tokens::hash(given) == tokens::hash(&csrf(secret)) {
        return Ok(());
    }
    Err(Error::Foreign {
        what: "the request shows a session, and not the X-CSRF-Token that belongs to it".into(),
        next: "send the csrf that GET /api/v1/session tells".into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::guard::Peer;

    fn connection(secure: bool) -> Connection {
        let peer = Peer::Tcp("127.0.0.1:5000".parse().expect("an address"));
        Connection {
            secure,
            ..Connection::plain(peer)
        }
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
            shown(&connection(secure), &headers(&lines)).map_err(|error| error.problem().status)
        };
        assert_eq!(shown(false, &["a=b; cloudroid=x"]), Ok(Some("x".into())));
        assert_eq!(shown(true, &["__Host-cloudroid=x"]), Ok(Some("x".into())));
        // What came without TLS, another may have set.
        assert_eq!(shown(true, &["cloudroid=x"]), Ok(None));
        assert_eq!(shown(false, &["__Host-cloudroid=x"]), Ok(None));
        assert_eq!(shown(false, &["cloudroid="]), Ok(None));
        assert_eq!(
            shown(false, &[&format!("cloudroid={}", "x".repeat(1000))]),
            Ok(None)
        );
        assert_eq!(shown(false, &["cloudroid=x; cloudroid=y"]), Err(400));
        assert_eq!(shown(false, &["cloudroid=x", "cloudroid=x"]), Err(400));
    }

    #[test]
    fn cookies_are_closed_to_scripts_and_other_sites() {
        let set = kept(true, "x", 60);
        assert_eq!(
            set.to_str().expect("text"),
            "__Host-cloudroid=x; Path=/; Max-Age=60; HttpOnly; SameSite=Strict; Secure"
        );
        let forgotten = forgotten(false);
        let text = forgotten.to_str().expect("text");
        assert!(
            text.starts_with("cloudroid=; ") && text.contains("Max-Age=0"),
            "{text}"
        );
    }

    #[test]
    fn whoever_signs_in_elsewhere_is_known_when_it_comes_back() {
        let set = kept_signing_in(true, "x");
        assert_eq!(
            set.to_str().expect("text"),
            "__Host-cloudroid-oidc=x; Path=/; Max-Age=600; HttpOnly; SameSite=Lax; Secure"
        );
        let lines = headers(&[(
            "cookie",
            "cloudroid=a; cloudroid-oidc=b; __Host-cloudroid-oidc=c",
        )]);
        let known = |secure| signing_in(&connection(secure), &lines).expect("once");
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
        let token = csrf("secret");
        let own = ("origin", "https://robots.lab:9090");
        let host = ("host", "robots.lab:9090");
        let with = (api::people::CSRF_HEADER, &*token);
        let upgrade = ("upgrade", "websocket");
        let asks = |method: Method, given: &[(&'static str, &str)]| {
            check(&connection(true), &method, &headers(given), "secret").is_ok()
        };
        assert!(asks(Method::GET, &[host]));
        // As a part of another site's page.
        assert!(!asks(Method::GET, &[host, ("sec-fetch-site", "same-site")]));
        assert!(asks(Method::DELETE, &[host, own, with]));
        assert!(asks(
            Method::POST,
            &[host, ("sec-fetch-site", "same-origin"), with]
        ));
        assert!(asks(Method::GET, &[host, own, upgrade]));
        let other = csrf("another");
        for (method, given) in [
            (Method::DELETE, &[host, own][..]),
            (Method::DELETE, &[host, with]),
            (
                Method::DELETE,
                &[host, own, (api::people::CSRF_HEADER, &other)],
            ),
            (
                Method::DELETE,
                &[host, ("origin", "https://evil.example"), with],
            ),
            (
                Method::DELETE,
                &[host, ("origin", "http://robots.lab:9090"), with],
            ),
            (
                Method::DELETE,
                &[host, ("origin", "https://robots.lab"), with],
            ),
            (Method::DELETE, &[host, ("origin", "null"), with]),
            (Method::DELETE, &[host, own, own, with]),
            (
                Method::POST,
                &[host, own, ("sec-fetch-site", "same-site"), with],
            ),
            (Method::POST, &[host, ("sec-fetch-site", "none"), with]),
            (Method::GET, &[host, upgrade]),
            (
                Method::GET,
                &[host, ("origin", "https://evil.example"), upgrade],
            ),
            (
                Method::GET,
                &[host, ("sec-fetch-site", "same-origin"), upgrade],
            ),
        ] {
            assert!(!asks(method.clone(), given), "{method} {given:?}");
        }
    }
}
