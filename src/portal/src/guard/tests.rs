use access::Guesses;

use super::*;
use crate::principals::{Lasting, Stored};
use crate::tokens::Tokens;

struct Ask<'a> {
    rules: Rules<'a>,
    method: Method,
    headers: HeaderMap,
}

fn ask<'a>(rules: &Rules<'a>) -> Ask<'a> {
    Ask {
        rules: Rules { ..*rules },
        method: Method::GET,
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

    fn by(mut self, method: Method) -> Self {
        self.method = method;
        self
    }

    fn at(&self, uri: &str) -> Result<Caller, u16> {
        self.told(uri).map_err(|error| error.problem().status)
    }

    fn told(&self, uri: &str) -> Result<Caller, Error> {
        let peer = Peer::Tcp("127.0.0.1:5000".parse().expect("an address"));
        let uri = uri.parse().expect("a URI");
        let connection = Connection::plain(peer);
        self.rules
            .admit(&connection, &self.method, &uri, &self.headers)
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
        known: Recognising {
            tokens: &none,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    assert!(
        ask(&rules)
            .at("/api/v1/services")
            .expect("let through")
            .is_known()
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
        known: Recognising {
            tokens: &none,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
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
fn pages_from_elsewhere_have_no_answers_as_parts_of_themselves() {
    let none = Tokens::default();
    let rules = Rules {
        loopback: true,
        known: Recognising {
            tokens: &none,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    let loads = |site: &str, mode: &str, dest: &str| {
        let ask = ask(&rules).with("sec-fetch-site", site);
        let ask = ask
            .with("sec-fetch-mode", mode)
            .with("sec-fetch-dest", dest);
        ask.at("/api/v1/services").map(|_| ())
    };
    for (site, mode, dest) in [
        ("cross-site", "no-cors", "image"),
        ("cross-site", "no-cors", "script"),
        ("cross-site", "no-cors", "empty"),
        ("cross-site", "navigate", "iframe"),
        ("cross-site", "navigate", "object"),
        ("same-site", "no-cors", "style"),
        ("same-site", "navigate", "frame"),
    ] {
        assert_eq!(loads(site, mode, dest), Err(403), "{site} {mode} {dest}");
    }
    for (site, mode, dest) in [
        ("same-origin", "cors", "empty"),
        ("same-origin", "no-cors", "image"),
        ("none", "navigate", "document"),
        ("cross-site", "navigate", "document"),
    ] {
        assert_eq!(loads(site, mode, dest), Ok(()), "{site} {mode} {dest}");
    }
    // By its origin it is decided whether a page of this machine may.
    let page = ask(&rules)
        .with("sec-fetch-site", "same-site")
        .with("origin", "http://localhost:8080");
    page.at("/opencv_apps").expect("a page of this machine");
}

#[test]
fn an_origin_that_a_sandboxed_page_has_is_named_with_what_to_write() {
    let none = Tokens::default();
    let closed = Rules {
        loopback: true,
        known: Recognising {
            tokens: &none,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    let refused = ask(&closed)
        .with("origin", "null")
        .told("/opencv_apps")
        .expect_err("nobody's page");
    let next = refused.problem().next.unwrap_or_default();
    assert!(next.contains(r#"origins = ["null"]"#), "{next}");
    let origins = ["null".to_owned()];
    let opened = Rules {
        origins: &origins,
        ..closed
    };
    ask(&opened)
        .with("origin", "null")
        .at("/opencv_apps")
        .expect("configured");
}

#[test]
fn what_a_proxy_passes_on_needs_tokens() {
    let (none, some) = (Tokens::default(), tokens());
    let mut rules = Rules {
        loopback: true,
        known: Recognising {
            tokens: &none,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    for (name, value) in [
        ("x-forwarded-proto", "https"),
        ("x-forwarded-for", "203.0.113.7"),
        ("forwarded", "for=203.0.113.7"),
        ("via", "1.1 proxy"),
    ] {
        // Its client may name whatever host it likes.
        let refused = ask(&rules).with("host", "localhost").with(name, value);
        assert_eq!(refused.at("/api/v1/services"), Err(403), "{name}");
    }
    rules.known.tokens = &some;
    ask(&rules)
        .with("x-forwarded-proto", "https")
        .at("/api/v1/services?token=open+sesame")
        .expect("a token says who asks");
}

#[test]
fn without_configured_tokens_any_token_owns_robots_names() {
    let none = Tokens::default();
    let open = Rules {
        loopback: true,
        known: Recognising {
            tokens: &none,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    let caller = ask(&open).at("/x?robot=r&token=mine").expect("let through");
    assert_eq!(caller.who.token, Some(tokens::hash("mine")));
}

#[test]
fn configured_tokens_are_needed_on_loopback_as_beyond() {
    let some = tokens();
    for loopback in [true, false] {
        let rules = Rules {
            loopback,
            known: Recognising {
                tokens: &some,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        let far = || ask(&rules).with("host", "localhost");
        for path in [
            "/api/v1/services",
            "/metrics",
            "/opencv_apps",
            "/stubs",
            "/v2/",
        ] {
            assert_eq!(far().at(path), Err(401), "{path}");
        }
        assert_eq!(far().at("/x?token=wrong"), Err(401));
        let bearer = |word: &str| far().with("authorization", &format!("Bearer {word}"));
        assert_eq!(bearer("wrong").at("/api/v1/services"), Err(401));
        for known in [
            bearer("open sesame").at("/api/v1/services"),
            far()
                .with("origin", "https://far.example")
                .at("/api/v1/services?token=open+sesame"),
            far()
                .with("sec-websocket-protocol", "rosbridge, bearer.open sesame")
                .at("/opencv_apps?token=wrong"),
        ] {
            let known = known.expect("a known token");
            assert_eq!(known.who.token, Some(tokens::hash("open sesame")));
            assert!(known.who.principal.is(access::Role::Admin));
        }
    }
}

#[test]
fn at_the_registry_a_token_is_the_password_of_any_name() {
    let some = tokens();
    let rules = Rules {
        loopback: false,
        known: Recognising {
            tokens: &some,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    let basic = |pair: &str| {
        let sent = base64_simd::STANDARD.encode_to_string(pair);
        ask(&rules).with("authorization", &format!("Basic {sent}"))
    };
    for path in ["/v2", "/v2/", "/v2/_catalog", "/v2/x/manifests/latest"] {
        for name in ["", "cluster", "token"] {
            let known = basic(&format!("{name}:open sesame")).at(path);
            let known = known.expect(path);
            assert_eq!(known.who.token, Some(tokens::hash("open sesame")));
        }
    }
    for wrong in [
        "open sesame:",
        "x:open",
        "open sesame",
        "x:open sesame ",
        "\u{ff}",
    ] {
        assert_eq!(basic(wrong).at("/v2/"), Err(401), "{wrong}");
    }
    let unreadable = ask(&rules).with("authorization", "Basic *");
    assert_eq!(unreadable.at("/v2/"), Err(401));
    // Browsers keep a password and send it by themselves: elsewhere it counts for nothing.
    for path in ["/api/v1/services", "/metrics", "/v2x", "/v1/v2/"] {
        assert_eq!(basic("x:open sesame").at(path), Err(401), "{path}");
    }
}

#[test]
fn without_a_token_only_the_page_health_and_handshakes_are_open() {
    let some = tokens();
    let rules = Rules {
        loopback: true,
        known: Recognising {
            tokens: &some,
            stored: &Stored::default(),
            guesses: &Mutex::new(Guesses::default()),
            lasting: Lasting::default(),
        },
        origins: &[],
    };
    let handshake = |method: Method| ask(&rules).by(method).with("upgrade", "WebSocket");
    for path in ["/", "/healthz", "/assets/portal.js"] {
        let caller = ask(&rules).at(path).expect(path);
        assert!(!caller.is_known(), "{path}");
        ask(&rules).by(Method::HEAD).at(path).expect(path);
        assert_eq!(ask(&rules).by(Method::POST).at(path), Err(401), "{path}");
    }
    // Who shows a pairing code is nobody until then.
    let caller = ask(&rules).by(Method::POST).at("/api/v1/pair");
    assert!(!caller.expect("may show a code").is_known());
    for method in [Method::GET, Method::HEAD, Method::PUT, Method::DELETE] {
        let refused = ask(&rules).by(method.clone()).at("/api/v1/pair");
        assert_eq!(refused, Err(401), "{method}");
    }
    assert_eq!(handshake(Method::POST).at("/api/v1/pair"), Err(401));
    assert_eq!(
        ask(&rules).by(Method::POST).at("/api/v1/renew"),
        Err(401),
        "needs its certificate"
    );
    for path in ["/", "/opencv_apps", "/opencv_apps/?robot=r1"] {
        let caller = handshake(Method::GET).at(path).expect("may send auth");
        assert!(!caller.is_known(), "{path}");
        for method in [Method::HEAD, Method::POST, Method::DELETE, Method::PATCH] {
            let refused = handshake(method.clone()).at(path);
            assert_eq!(refused, Err(401), "{method} {path}");
        }
    }
    for path in [
        "/api",
        "/api/",
        "/api/v1/services",
        "/metrics",
        "/metrics/",
        "/stubs",
        "/stubs/opencv_apps.tar.gz",
        "/v2",
        "/v2/",
        "/assets",
        "/assets/deep/er",
        "//opencv_apps",
        "/opencv_apps/more",
        "/opencv_apps//",
        "/%61pi",
    ] {
        assert_eq!(handshake(Method::GET).at(path), Err(401), "{path}");
    }
}

#[test]
fn only_root_and_members_use_the_socket() {
    for (uid, is_member, admitted) in [
        (0, false, true),
        (1, false, false),
        (1, true, true),
        (privilege::DEFAULT_USER, false, false),
    ] {
        let user = User { uid, is_member };
        match admit_user(&Connection::plain(Peer::Unix(user)), user) {
            Ok(caller) => assert!(
                admitted && caller.who.principal.is(access::Role::Admin),
                "{uid}"
            ),
            Err(error) => assert!(!admitted && error.problem().status == 403, "{uid}: {error}"),
        }
    }
}

#[test]
fn queries_are_decoded() {
    let uri: Uri = "/x?a=1&robot=r%2F1+b&bad=%zz".parse().expect("a URI");
    assert_eq!(query(uri.query(), "robot").as_deref(), Some("r/1 b"));
    assert_eq!(query(uri.query(), "bad").as_deref(), Some("%zz"));
    assert_eq!(query(uri.query(), "none"), None);
}
