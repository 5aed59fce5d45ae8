use std::net::{IpAddr, Ipv4Addr};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

use super::*;

const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

fn settings(issuer: &str) -> Settings {
    Settings {
        issuer: issuer.into(),
        client_id: "cloudroid".into(),
        client_secret: None,
        redirect: "https://robots.lab.example/api/v1/oidc/callback".into(),
        scopes: vec!["profile".into()],
        groups_claim: "groups".into(),
        name_claim: "preferred_username".into(),
        authorities: None,
    }
}

fn provider(issuer: &str) -> Provider {
    Provider::new(settings(issuer)).expect("good settings")
}

/// Starts a server that answers each connection with the next of `answers` as JSON, replacing `ISSUER` by its URL;
/// returns that URL.
async fn serve_answers(answers: Vec<&'static str>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let issuer = format!("http://{}", listener.local_addr().expect("bound"));
    let mine = issuer.clone();
    tokio::spawn(async move {
        for answer in answers {
            let (mut stream, _) = listener.accept().await.expect("a connection");
            let mut asked = Vec::new();
            while !asked.ends_with(b"\r\n\r\n") {
                assert!(stream.read_buf(&mut asked).await.expect("a request") > 0);
            }
            let body = answer.replace("ISSUER", &mine);
            let answer = format!(
                "HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
                body.len()
            );
            stream.write_all(answer.as_bytes()).await.expect("sent");
        }
    });
    issuer
}

const METADATA: &str = r#"{"issuer": "ISSUER", "authorization_endpoint": "ISSUER/auth", "token_endpoint": "ISSUER/token",
    "jwks_uri": "ISSUER/keys", "response_types_supported": ["code"], "subject_types_supported": ["public"],
    "id_token_signing_alg_values_supported": ["RS256"]}"#;
const KEYS: &str = r#"{"keys": []}"#;

#[test]
fn addresses_that_others_read_are_none() {
    for issuer in [
        "http://id.lab.example",
        "ldap://id.lab.example",
        "id.lab.example",
        "https://id.lab.example/?realm=lab",
        "https://id.lab.example/#lab",
        "",
    ] {
        let refused = Provider::new(settings(issuer)).map(|_| ()).expect_err(issuer);
        assert!(refused.to_string().contains("https://"), "{refused}");
    }
    for issuer in ["https://id.lab.example/realms/lab", "http://localhost:1", "http://[::1]:1/x/"] {
        provider(issuer);
    }
    let elsewhere = Settings {
        redirect: "http://robots.lab.example/api/v1/oidc/callback".into(),
        ..settings("https://id.lab.example")
    };
    Provider::new(elsewhere).map(|_| ()).expect_err("plain text");
}

#[tokio::test]
async fn a_sign_in_has_a_state_a_nonce_and_a_challenge_of_its_own() {
    let issuer = serve_answers(vec![METADATA, KEYS]).await;
    let provider = provider(&issuer);
    let first = provider.begin(None, HERE, None).await.expect("begun");
    let second = provider.begin(Some(&first.browser), HERE, Some("earlier".into())).await;
    let second = second.expect("begun: what the provider says of itself is kept");
    assert_eq!(first.browser, second.browser, "two windows of one browser");
    let asked = |begun: &SignInRedirect, name: &str| {
        let url = Url::parse(&begun.url).expect("an address");
        let mut pairs = url.query_pairs();
        let found = pairs.find(|(key, _)| key == name);
        found.expect(name).1.into_owned()
    };
    assert!(first.url.starts_with(&format!("{issuer}/auth?")), "{}", first.url);
    assert_eq!(asked(&first, "response_type"), "code");
    assert_eq!(asked(&first, "code_challenge_method"), "S256");
    assert_eq!(asked(&first, "scope"), "openid profile");
    assert_eq!(asked(&first, "client_id"), "cloudroid");
    for name in ["state", "nonce", "code_challenge"] {
        let (one, other) = (asked(&first, name), asked(&second, name));
        assert!(one.len() >= 43 && one != other, "{name}: {one} {other}");
    }
    let state = asked(&second, "state");
    let taken = provider.resume(&state, Some(&second.browser)).expect("begun");
    assert_eq!(taken.earlier.as_deref(), Some("earlier"));
}

#[tokio::test]
async fn a_provider_that_says_it_is_another_is_not_asked() {
    let other = r#"{"issuer": "https://another.example", "authorization_endpoint": "ISSUER/auth", "jwks_uri": "ISSUER/keys",
        "response_types_supported": ["code"], "subject_types_supported": ["public"],
        "id_token_signing_alg_values_supported": ["RS256"]}"#;
    let provider = provider(&serve_answers(vec![other]).await);
    let refused = provider.begin(None, HERE, None).await.expect_err("another");
    assert!(refused.to_string().contains("another.example"), "{refused}");
}

#[tokio::test]
async fn a_provider_at_https_names_no_plain_text() {
    let http = Http::new(None, true);
    let request = openidconnect::http::Request::get("http://127.0.0.1:1/keys").body(Vec::new()).expect("a request");
    let refused = openidconnect::AsyncHttpClient::call(&http, request).await;
    let refused = refused.expect_err("plain text").to_string();
    assert!(refused.contains("not https"), "{refused}");
    let url = |text: &str| Url::parse(text).expect("an address");
    assert!(http.is_allowed(&url("https://login.lab.example/auth")));
    assert!(!http.is_allowed(&url("http://127.0.0.1:1/auth")));
    assert!(Http::new(None, false).is_allowed(&url("http://127.0.0.1:1/auth")));
    assert!(!Http::new(None, false).is_allowed(&url("http://lab.example/auth")));
}

#[tokio::test]
async fn concurrent_sign_ins_beyond_the_limit_are_refused() {
    let provider = provider("https://id.lab.example");
    let all = provider.turns.acquire_many(AT_ONCE as u32).await.expect("open");
    let refused = provider.begin(None, HERE, None).await.expect_err("busy");
    assert!(matches!(refused, Error::Busy), "{refused}");
    drop(all);
}

#[tokio::test]
async fn a_code_that_is_none_is_not_sent() {
    let provider = provider("https://id.lab.example");
    for code in [String::new(), "x".repeat(LONGEST_CODE + 1)] {
        let started = ReturnedSignIn {
            nonce: Nonce::new("n".into()),
            verifier: PkceCodeVerifier::new("v".repeat(43)),
            earlier: None,
        };
        let refused = provider.finish(started, code).await.expect_err("none");
        assert!(matches!(refused, Error::Code { .. }), "{refused}");
    }
}

#[test]
fn an_answer_of_another_provider_is_refused() {
    let provider = provider("https://id.lab.example");
    provider.check_issuer(None).expect("older ones do not say");
    provider.check_issuer(Some("https://id.lab.example")).expect("its own");
    provider.check_issuer(Some("https://id.lab.example/")).expect_err("another");
}

#[test]
fn what_others_say_is_cut_to_a_line() {
    let denied = Error::from_denial(&format!("a\nb\u{1b}{}", "x".repeat(1000))).to_string();
    assert!(!denied.contains(char::is_control) && denied.len() < 400, "{denied}");
}
