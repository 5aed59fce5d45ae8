//! Who asks, and may they: before any handler.
//!
//! On loopback nobody needs a token, so a web page from elsewhere must not be able to ask through the browser of
//! somebody on this machine: requests that name another host (DNS rebinding) or another origin (cross-site
//! requests and WebSockets) are refused. Beyond loopback a token is needed, which no browser adds by itself.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::App;
use crate::errors::Error;
use crate::tokens::{self, TokenHash, Tokens};

/// The other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// An address.
    Tcp(SocketAddr),
    /// A user of this machine.
    Unix(u32),
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// From where.
    pub peer: Peer,
    /// With which token; on loopback also one that is not configured, which then only owns robots' names.
    pub token: Option<TokenHash>,
    /// May ask. Only WebSockets may come without, to send a rosbridge `auth` message first.
    pub trusted: bool,
}

/// What of the configuration decides.
pub struct Rules<'a> {
    /// The portal is bound to loopback.
    pub loopback: bool,
    /// The configured tokens.
    pub tokens: &'a Tokens,
    /// Origins allowed besides loopback's.
    pub origins: &'a [String],
}

/// Lets a request through with its [`Caller`], or refuses it.
pub async fn guard(State(app): State<Arc<App>>, mut request: Request, next: Next) -> Response {
    let rules = Rules {
        loopback: app.listen.ip().is_loopback(),
        tokens: &app.tokens,
        origins: &app.config.origins,
    };
    let Some(peer) = request.extensions().get::<Peer>().copied() else {
        return Error::Internal("telling who asks").into_response();
    };
    match rules.admit(peer, request.uri(), request.headers()) {
        Ok(caller) => {
            request.extensions_mut().insert(caller);
            next.run(request).await
        }
        Err(error) => error.into_response(),
    }
}

impl Rules<'_> {
    fn admit(&self, peer: Peer, uri: &Uri, headers: &HeaderMap) -> Result<Caller, Error> {
        if let Peer::Unix(uid) = peer {
            return admit_user(peer, uid);
        }
        let given = token_in(uri, headers);
        let known = given
            .as_deref()
            .and_then(|token| self.tokens.recognise(token));
        if given.is_some() && known.is_none() && !self.tokens.is_empty() {
            return Err(Error::Unauthorised("this token is not known"));
        }
        if !self.loopback {
            let trusted = known.is_some();
            if !trusted && !is_open(uri, headers) {
                return Err(Error::Unauthorised("a token is needed"));
            }
            return Ok(Caller {
                peer,
                token: known,
                trusted,
            });
        }
        if known.is_none() {
            self.check_host(headers)?;
            self.check_origin(headers)?;
        }
        Ok(Caller {
            peer,
            token: known.or_else(|| given.as_deref().map(tokens::hash)),
            trusted: true,
        })
    }

    fn check_host(&self, headers: &HeaderMap) -> Result<(), Error> {
        let host = header_text(headers, header::HOST).unwrap_or_default();
        if is_loopback_host(without_port(host)) {
            return Ok(());
        }
        Err(Error::Foreign {
            what: format!(
                "the request is addressed to {host:?}, but this portal serves this machine alone"
            ),
            next:
                "use 127.0.0.1 or localhost, or show a token of the configuration, where a proxy passes requests on"
                    .to_owned(),
        })
    }

    fn check_origin(&self, headers: &HeaderMap) -> Result<(), Error> {
        let Some(origin) = header_text(headers, header::ORIGIN) else {
            return Ok(());
        };
        let of_this_machine = origin.split_once("://").is_some_and(|(scheme, host)| {
            scheme.starts_with("http") && is_loopback_host(without_port(host))
        });
        if of_this_machine
            || self
                .origins
                .iter()
                .any(|allowed| allowed.trim_end_matches('/') == origin)
        {
            return Ok(());
        }
        Err(Error::Foreign {
            what: format!("a page of {origin} may not use this portal"),
            next: format!("if it should, add it to the configuration: origins = [{origin:?}]"),
        })
    }
}

fn admit_user(peer: Peer, uid: u32) -> Result<Caller, Error> {
    if uid == 0 || uid == nix::unistd::geteuid().as_raw() {
        return Ok(Caller {
            peer,
            token: None,
            trusted: true,
        });
    }
    Err(Error::Foreign {
        what: format!("user {uid} may not use the daemon's socket"),
        next: "ask as root (sudo), or over TCP with --server".to_owned(),
    })
}

/// Asked for without a token: the page (which asks for one), and WebSockets (which may send one).
fn is_open(uri: &Uri, headers: &HeaderMap) -> bool {
    let path = uri.path();
    path == "/" || path == "/healthz" || path.starts_with("/assets/") || is_upgrade(headers)
}

/// Whether a WebSocket is asked for.
pub fn is_upgrade(headers: &HeaderMap) -> bool {
    header_text(headers, header::UPGRADE)
        .is_some_and(|upgrade| upgrade.eq_ignore_ascii_case("websocket"))
}

fn token_in(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let bearer = header_text(headers, header::AUTHORIZATION).and_then(|value| {
        let (scheme, token) = value.split_once(' ')?;
        scheme
            .eq_ignore_ascii_case("bearer")
            .then(|| token.trim().to_owned())
    });
    bearer.or_else(|| query(uri, "token"))
}

/// One value of the query, decoded.
pub fn query(uri: &Uri, name: &str) -> Option<String> {
    let pairs = uri.query()?.split('&');
    let value = pairs
        .filter_map(|pair| pair.split_once('='))
        .find(|(key, _)| *key == name)?
        .1;
    Some(decode(value))
}

fn decode(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut decoded = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while at < bytes.len() {
        let escaped = (bytes[at] == b'%')
            .then(|| {
                text.get(at + 1..at + 3)
                    .and_then(|digits| u8::from_str_radix(digits, 16).ok())
            })
            .flatten();
        match (bytes[at], escaped) {
            (_, Some(byte)) => {
                decoded.push(byte);
                at += 2;
            }
            (b'+', None) => decoded.push(b' '),
            (byte, None) => decoded.push(byte),
        }
        at += 1;
    }
    String::from_utf8_lossy(&decoded).into_owned()
}

fn header_text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port))
            if port.bytes().all(|byte| byte.is_ascii_digit()) && !name.ends_with(':') =>
        {
            name
        }
        _ => host,
    }
}

fn is_loopback_host(host: &str) -> bool {
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    host.eq_ignore_ascii_case("localhost")
        || bare
            .parse::<IpAddr>()
            .is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Ask<'a> {
        rules: Rules<'a>,
        headers: HeaderMap,
    }

    fn ask<'a>(rules: &Rules<'a>) -> Ask<'a> {
        Ask {
            rules: Rules { ..*rules },
            headers: HeaderMap::new(),
        }
        .with("host", "127.0.0.1:9090")
    }

    impl Ask<'_> {
        fn with(mut self, name: &'static str, value: &str) -> Self {
            self.headers
                .insert(name, value.parse().expect("a header value"));
            self
        }

        fn at(&self, uri: &str) -> Result<Caller, u16> {
            let peer = Peer::Tcp("127.0.0.1:5000".parse().expect("an address"));
            self.rules
                .admit(peer, &uri.parse().expect("a URI"), &self.headers)
                .map_err(|error| error.problem().status)
        }
    }

    fn tokens() -> Tokens {
        Tokens::new(&["open sesame".to_owned()]).expect("a token")
    }

    #[test]
    fn on_loopback_nobody_needs_a_token() {
        let none = Tokens::default();
        let rules = Rules {
            loopback: true,
            tokens: &none,
            origins: &[],
        };
        assert!(
            ask(&rules)
                .at("/api/v1/services")
                .expect("let through")
                .trusted
        );
        for host in ["localhost", "localhost:9090", "[::1]:9090", "127.0.0.1"] {
            ask(&rules).with("host", host).at("/").expect(host);
        }
        for origin in [
            "http://localhost:8080",
            "http://127.0.0.1:9090",
            "https://[::1]:1",
        ] {
            ask(&rules).with("origin", origin).at("/").expect(origin);
        }
    }

    #[test]
    fn pages_from_elsewhere_cannot_use_a_portal_on_loopback() {
        let none = Tokens::default();
        let origins = ["https://tool.example".to_owned()];
        let rules = Rules {
            loopback: true,
            tokens: &none,
            origins: &origins,
        };
        assert_eq!(
            ask(&rules)
                .with("host", "evil.example:9090")
                .at("/opencv_apps"),
            Err(403),
            "DNS rebinding"
        );
        for origin in [
            "https://evil.example",
            "null",
            "http://localhost.evil.example",
        ] {
            assert_eq!(
                ask(&rules).with("origin", origin).at("/opencv_apps"),
                Err(403),
                "{origin}"
            );
        }
        ask(&rules)
            .with("origin", "https://tool.example")
            .at("/opencv_apps")
            .expect("configured");
    }

    #[test]
    fn on_loopback_a_token_given_is_checked_where_some_are_configured() {
        let (none, some) = (Tokens::default(), tokens());
        let open = Rules {
            loopback: true,
            tokens: &none,
            origins: &[],
        };
        let caller = ask(&open).at("/x?robot=r&token=mine").expect("let through");
        assert_eq!(
            caller.token,
            Some(tokens::hash("mine")),
            "it owns robots' names"
        );
        let guarded = Rules {
            loopback: true,
            tokens: &some,
            origins: &[],
        };
        assert_eq!(ask(&guarded).at("/x?token=wrong"), Err(401));
        let caller = ask(&guarded)
            .with("origin", "https://far.example")
            .at("/x?token=open%20sesame");
        assert_eq!(
            caller.expect("a known token").token,
            Some(tokens::hash("open sesame"))
        );
    }

    #[test]
    fn beyond_loopback_a_token_is_needed() {
        let some = tokens();
        let rules = Rules {
            loopback: false,
            tokens: &some,
            origins: &[],
        };
        let far = || ask(&rules).with("host", "robots.example");
        assert_eq!(far().at("/api/v1/services"), Err(401));
        assert_eq!(far().at("/metrics"), Err(401));
        assert_eq!(
            far()
                .with("authorization", "Bearer wrong")
                .at("/api/v1/services"),
            Err(401)
        );
        assert!(
            far()
                .with("authorization", "bearer open sesame")
                .at("/api/v1/services")
                .expect("known")
                .trusted
        );
        assert!(
            far()
                .at("/api/v1/services?token=open+sesame")
                .expect("known")
                .trusted
        );
        assert!(!far().at("/").expect("the page asks for a token").trusted);
        assert!(
            !far()
                .with("upgrade", "WebSocket")
                .at("/opencv_apps")
                .expect("may send auth")
                .trusted
        );
    }

    #[test]
    fn only_root_and_the_daemons_user_use_the_socket() {
        assert!(admit_user(Peer::Unix(0), 0).expect("root").trusted);
        let other = nix::unistd::geteuid().as_raw().wrapping_add(1);
        assert_eq!(
            admit_user(Peer::Unix(other), other)
                .expect_err("a stranger")
                .problem()
                .status,
            403
        );
    }

    #[test]
    fn queries_are_decoded() {
        let uri: Uri = "/x?a=1&robot=r%2F1+b&bad=%zz".parse().expect("a URI");
        assert_eq!(query(&uri, "robot").as_deref(), Some("r/1 b"));
        assert_eq!(query(&uri, "bad").as_deref(), Some("%zz"));
        assert_eq!(query(&uri, "none"), None);
    }
}
