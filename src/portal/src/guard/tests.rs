use access::GuessLimiter;

use super::*;
use crate::principals::{SessionLifetimes, StoredPrincipals};
use crate::tokens::Tokens;

struct TestRequest<'a> {
    rules: AdmissionRules<'a>,
    method: Method,
    headers: HeaderMap,
}

fn request<'a>(rules: &AdmissionRules<'a>) -> TestRequest<'a> {
    TestRequest { rules: AdmissionRules { ..*rules }, method: Method::GET, headers: HeaderMap::new() }
        .with_header("host", "127.0.0.1:9090")
}

impl TestRequest<'_> {
    fn with_header(mut self, name: &'static str, value: &str) -> Self {
        self.headers.insert(name, value.parse().expect("a header value"));
        self
    }

    fn with_method(mut self, method: Method) -> Self {
        self.method = method;
        self
    }

    fn admit_or_status(&self, uri: &str) -> Result<Caller, u16> {
        self.admit(uri).map_err(|error| error.problem().status)
    }

    fn admit(&self, uri: &str) -> Result<Caller, Error> {
        let peer = ConnectionPeer::Tcp("127.0.0.1:5000".parse().expect("an address"));
        let uri = uri.parse().expect("a URI");
        let connection = PortalConnection::without_tls(peer);
        self.rules.admit(&connection, &self.method, &uri, &self.headers)
    }
}

fn tokens() -> Tokens {
    Tokens::new(&["open sesame".to_owned()]).expect("a token")
}

#[test]
fn on_loopback_nobody_needs_a_token() {
    let none = Tokens::default();
    let rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &none,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    assert!(request(&rules).admit_or_status("/api/v1/services").expect("let through").is_known());
    for host in ["localhost", "localhost:9090", "[::1]:9090", "127.0.0.1"] {
        request(&rules).with_header("host", host).admit_or_status("/").expect(host);
    }
    for origin in ["http://localhost:8080", "http://127.0.0.1:9090", "https://[::1]:1"] {
        request(&rules).with_header("origin", origin).admit_or_status("/").expect(origin);
    }
}

#[test]
fn pages_from_elsewhere_cannot_use_a_portal_on_loopback() {
    let none = Tokens::default();
    let origins = ["https://tool.example".to_owned()];
    let rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &none,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &origins,
    };
    assert_eq!(
        request(&rules).with_header("host", "evil.example:9090").admit_or_status("/opencv_apps"),
        Err(403),
        "DNS rebinding"
    );
    for origin in ["https://evil.example", "null", "http://localhost.evil.example"] {
        assert_eq!(request(&rules).with_header("origin", origin).admit_or_status("/opencv_apps"), Err(403), "{origin}");
    }
    request(&rules).with_header("origin", "https://tool.example").admit_or_status("/opencv_apps").expect("configured");
}

#[test]
fn pages_from_elsewhere_have_no_answers_as_parts_of_themselves() {
    let none = Tokens::default();
    let rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &none,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    let loads = |site: &str, mode: &str, dest: &str| {
        let ask = request(&rules).with_header("sec-fetch-site", site);
        let ask = ask.with_header("sec-fetch-mode", mode).with_header("sec-fetch-dest", dest);
        ask.admit_or_status("/api/v1/services").map(|_| ())
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
    // The origin decides whether a page of this machine may use the portal.
    let page =
        request(&rules).with_header("sec-fetch-site", "same-site").with_header("origin", "http://localhost:8080");
    page.admit_or_status("/opencv_apps").expect("a page of this machine");
}

#[test]
fn an_origin_that_a_sandboxed_page_has_is_named_with_what_to_write() {
    let none = Tokens::default();
    let closed = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &none,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    let refused = request(&closed).with_header("origin", "null").admit("/opencv_apps").expect_err("nobody's page");
    let next = refused.problem().next.unwrap_or_default();
    assert!(next.contains(r#"origins = ["null"]"#), "{next}");
    let origins = ["null".to_owned()];
    let opened = AdmissionRules { origins: &origins, ..closed };
    request(&opened).with_header("origin", "null").admit_or_status("/opencv_apps").expect("configured");
}

#[test]
fn what_a_proxy_passes_on_needs_tokens() {
    let (none, some) = (Tokens::default(), tokens());
    let mut rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &none,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    for (name, value) in [
        ("x-forwarded-proto", "https"),
        ("x-forwarded-for", "203.0.113.7"),
        ("forwarded", "for=203.0.113.7"),
        ("via", "1.1 proxy"),
    ] {
        // Its client may send any Host.
        let refused = request(&rules).with_header("host", "localhost").with_header(name, value);
        assert_eq!(refused.admit_or_status("/api/v1/services"), Err(403), "{name}");
    }
    rules.known.tokens = &some;
    request(&rules)
        .with_header("x-forwarded-proto", "https")
        .admit_or_status("/api/v1/services?token=open+sesame")
        .expect("a token says who asks");
}

#[test]
fn without_configured_tokens_any_token_owns_robots_names() {
    let none = Tokens::default();
    let open = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &none,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    let caller = request(&open).admit_or_status("/x?robot=r&token=mine").expect("let through");
    assert_eq!(caller.who.token, Some(tokens::hash("mine")));
}

#[test]
fn configured_tokens_are_needed_on_loopback_as_beyond() {
    let some = tokens();
    for loopback in [true, false] {
        let rules = AdmissionRules {
            find_access: crate::routes::find_access,
            loopback,
            loopback_robots: false,
            known: Recogniser {
                tokens: &some,
                stored: &StoredPrincipals::default(),
                guesses: &Mutex::new(GuessLimiter::default()),
                lasting: SessionLifetimes::default(),
            },
            origins: &[],
        };
        let far = || request(&rules).with_header("host", "localhost");
        for path in ["/api/v1/services", "/metrics", "/opencv_apps", "/stubs", "/v2/"] {
            assert_eq!(far().admit_or_status(path), Err(401), "{path}");
        }
        assert_eq!(far().admit_or_status("/x?token=wrong"), Err(401));
        let bearer = |word: &str| far().with_header("authorization", &format!("Bearer {word}"));
        assert_eq!(bearer("wrong").admit_or_status("/api/v1/services"), Err(401));
        for known in [
            bearer("open sesame").admit_or_status("/api/v1/services"),
            far().with_header("origin", "https://far.example").admit_or_status("/api/v1/services?token=open+sesame"),
            far()
                .with_header("sec-websocket-protocol", "rosbridge, bearer.open sesame")
                .admit_or_status("/opencv_apps?token=wrong"),
        ] {
            let known = known.expect("a known token");
            assert_eq!(known.who.token, Some(tokens::hash("open sesame")));
            assert!(known.who.principal.has_role(access::Role::Admin));
        }
    }
}

#[test]
fn robots_of_this_machine_need_no_token_where_they_are_allowed() {
    let some = tokens();
    let rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: true,
        known: Recogniser {
            tokens: &some,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    let handshake = || request(&rules).with_header("upgrade", "websocket");
    for path in ["/", "/opencv_apps", "/opencv_apps/?robot=r1"] {
        let robot = handshake().admit_or_status(path).expect(path);
        assert_eq!(robot.who.shown, Credential::Loopback, "{path}");
        assert_eq!(robot.who.principal.roles, [access::Role::Robot], "{path}");
    }
    // Nothing else is open, and a token that is sent must be right.
    for path in ["/api/v1/services", "/metrics", "/opencv_apps", "/stubs"] {
        assert_eq!(request(&rules).admit_or_status(path), Err(401), "{path}");
    }
    assert_eq!(handshake().admit_or_status("/foxglove/s1"), Err(401));
    assert_eq!(handshake().admit_or_status("/opencv_apps?token=wrong"), Err(401));
    // What may come from elsewhere can only send auth.
    for (name, value) in [
        ("host", "robots.lab.example:9090"),
        ("origin", "https://evil.example"),
        ("x-forwarded-for", "203.0.113.7"),
        ("sec-fetch-site", "cross-site"),
    ] {
        let caller = handshake().with_header(name, value).admit_or_status("/opencv_apps").expect(name);
        assert!(!caller.is_known(), "{name}");
    }
    for (peer, forwarded) in [("203.0.113.7:5000", false), ("127.0.0.1:5000", true)] {
        let peer = ConnectionPeer::Tcp(peer.parse().expect("an address"));
        let connection = PortalConnection { forwarded, ..PortalConnection::without_tls(peer) };
        let asked = handshake();
        let uri = "/opencv_apps".parse().expect("a URI");
        let caller = rules.admit(&connection, &asked.method, &uri, &asked.headers).expect("may send auth");
        assert!(!caller.is_known(), "{peer} {forwarded}");
    }
}

#[test]
fn at_the_registry_a_token_is_the_password_of_any_name() {
    let some = tokens();
    let rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: false,
        loopback_robots: false,
        known: Recogniser {
            tokens: &some,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    let basic = |pair: &str| {
        let sent = base64_simd::STANDARD.encode_to_string(pair);
        request(&rules).with_header("authorization", &format!("Basic {sent}"))
    };
    for path in ["/v2", "/v2/", "/v2/_catalog", "/v2/x/manifests/latest"] {
        for name in ["", "cluster", "token"] {
            let known = basic(&format!("{name}:open sesame")).admit_or_status(path);
            let known = known.expect(path);
            assert_eq!(known.who.token, Some(tokens::hash("open sesame")));
        }
    }
    for wrong in ["open sesame:", "x:open", "open sesame", "x:open sesame ", "\u{ff}"] {
        assert_eq!(basic(wrong).admit_or_status("/v2/"), Err(401), "{wrong}");
    }
    let unreadable = request(&rules).with_header("authorization", "Basic *");
    assert_eq!(unreadable.admit_or_status("/v2/"), Err(401));
    // Browsers keep a password and resend it by themselves: elsewhere it is ignored.
    for path in ["/api/v1/services", "/metrics", "/v2x", "/v1/v2/"] {
        assert_eq!(basic("x:open sesame").admit_or_status(path), Err(401), "{path}");
    }
}

#[test]
fn without_a_token_only_the_page_health_and_handshakes_are_open() {
    let some = tokens();
    let rules = AdmissionRules {
        find_access: crate::routes::find_access,
        loopback: true,
        loopback_robots: false,
        known: Recogniser {
            tokens: &some,
            stored: &StoredPrincipals::default(),
            guesses: &Mutex::new(GuessLimiter::default()),
            lasting: SessionLifetimes::default(),
        },
        origins: &[],
    };
    let handshake = |method: Method| request(&rules).with_method(method).with_header("upgrade", "WebSocket");
    for path in ["/", "/healthz", "/assets/portal.js"] {
        let caller = request(&rules).admit_or_status(path).expect(path);
        assert!(!caller.is_known(), "{path}");
        request(&rules).with_method(Method::HEAD).admit_or_status(path).expect(path);
        assert_eq!(request(&rules).with_method(Method::POST).admit_or_status(path), Err(401), "{path}");
    }
    // The sender of a pairing code is unauthenticated until the code is checked.
    let caller = request(&rules).with_method(Method::POST).admit_or_status("/api/v1/pair");
    assert!(!caller.expect("may show a code").is_known());
    for method in [Method::GET, Method::HEAD, Method::PUT, Method::DELETE] {
        let refused = request(&rules).with_method(method.clone()).admit_or_status("/api/v1/pair");
        assert_eq!(refused, Err(401), "{method}");
    }
    assert_eq!(handshake(Method::POST).admit_or_status("/api/v1/pair"), Err(401));
    assert_eq!(
        request(&rules).with_method(Method::POST).admit_or_status("/api/v1/renew"),
        Err(401),
        "needs its certificate"
    );
    for path in ["/", "/opencv_apps", "/opencv_apps/?robot=r1"] {
        let caller = handshake(Method::GET).admit_or_status(path).expect("may send auth");
        assert!(!caller.is_known(), "{path}");
        for method in [Method::HEAD, Method::POST, Method::DELETE, Method::PATCH] {
            let refused = handshake(method.clone()).admit_or_status(path);
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
        assert_eq!(handshake(Method::GET).admit_or_status(path), Err(401), "{path}");
    }
}

#[test]
fn only_root_and_members_use_the_socket() {
    for (uid, is_member, admitted) in
        [(0, false, true), (1, false, false), (1, true, true), (privilege::DEFAULT_USER, false, false)]
    {
        let user = User { uid, is_member };
        match admit_user(&PortalConnection::without_tls(ConnectionPeer::Unix(user)), user) {
            Ok(caller) => assert!(admitted && caller.who.principal.has_role(access::Role::Admin), "{uid}"),
            Err(error) => assert!(!admitted && error.problem().status == 403, "{uid}: {error}"),
        }
    }
}

#[test]
fn queries_are_decoded() {
    let uri: Uri = "/x?a=1&robot=r%2F1+b&bad=%zz".parse().expect("a URI");
    assert_eq!(query_value(uri.query(), "robot").as_deref(), Some("r/1 b"));
    assert_eq!(query_value(uri.query(), "bad").as_deref(), Some("%zz"));
    assert_eq!(query_value(uri.query(), "none"), None);
}
