//! The session of somebody who is signed in, as others would use it: each attempt shows its cookie in a way that the page would
//! not.

use anyhow::ensure;
use support::Verdict;

use super::scene::{Attempt, Scene, state};
use crate::people::{Browser, PASSWORD, account};

const PATH: &str = "/api/v1/servants";

/// Would end all servants if it were answered.
fn ends<'a>(status: &'a [u16]) -> Attempt<'a> {
    Attempt::new("DELETE", PATH, status)
}

pub fn cannot_be_made_to_ask(scene: &Scene) -> Verdict {
    let daemon = &scene.daemon;
    account(
        daemon,
        &["create", "dave", "--role", "viewer", "--service", "*"],
        PASSWORD,
    )?
    .succeeded()?;
    let carol = Browser::signs_in(daemon, "carol", PASSWORD)?;
    let dave = Browser::signs_in(daemon, "dave", PASSWORD)?;
    let (name, secret) = carol.cookie.split_once('=').unwrap_or_default();
    let cookie = |attempt: Attempt<'static>| attempt.header("Cookie", carol.cookie.clone());
    let own = |attempt: Attempt<'static>| attempt.header("Origin", carol.origin.clone());
    let csrf = |attempt: Attempt<'static>| attempt.header("X-CSRF-Token", carol.csrf.clone());
    let (_, port) = daemon.address.rsplit_once(':').unwrap_or_default();
    let mut attempts = vec![
        // Without the cookie, or in its place.
        csrf(own(ends(&[401]))),
        csrf(own(Attempt::new(
            "DELETE",
            format!("{PATH}?{name}={secret}"),
            &[401],
        ))),
        csrf(own(Attempt::new(
            "DELETE",
            format!("{PATH}?session={secret}"),
            &[401],
        ))),
        csrf(own(Attempt::new(
            "DELETE",
            format!("{PATH}?token={secret}"),
            &[401, 429],
        ))),
        csrf(own(ends(&[401, 429]))).bearer(secret),
        csrf(own(ends(&[401]))).header("X-Session", secret),
        csrf(own(ends(&[401]))).header("Cookie", format!("__Host-cloudroid={secret}")),
        csrf(own(ends(&[401]))).header("Cookie", format!("CLOUDROID={secret}")),
        csrf(own(ends(&[401]))).header("Cookie", format!("{name}={secret}x")),
        csrf(own(ends(&[401]))).header("Cookie", format!("{name}=\"{secret}\"")),
        csrf(own(ends(&[401]))).header("Cookie", format!("{name}=")),
        // Twice, in one line or two, alike or not.
        csrf(own(ends(&[400]))).header("Cookie", format!("{}; {}", carol.cookie, carol.cookie)),
        csrf(own(ends(&[400]))).header("Cookie", format!("{}; {}", carol.cookie, dave.cookie)),
        csrf(own(cookie(ends(&[400])))).header("Cookie", dave.cookie.clone()),
        // Without the page's mark, or with another's, or elsewhere.
        own(cookie(ends(&[403]))),
        own(cookie(ends(&[403]))).header("X-CSRF-Token", dave.csrf.clone()),
        own(cookie(ends(&[403]))).header("X-CSRF-Token", ""),
        own(cookie(ends(&[403]))).header("X-CSRF-Token", secret),
        own(cookie(ends(&[403]))).header("X-CSRF-Token", carol.csrf.to_uppercase()),
        own(cookie(ends(&[403]))).header("CSRF-Token", carol.csrf.clone()),
        own(cookie(ends(&[403]))).body(format!("csrf={}", carol.csrf)),
        own(cookie(Attempt::new(
            "DELETE",
            format!("{PATH}?csrf={}", carol.csrf),
            &[403],
        ))),
        // From another place than the page.
        csrf(cookie(ends(&[403]))),
        csrf(own(own(cookie(ends(&[403]))))),
        csrf(own(cookie(ends(&[403])))).header("Sec-Fetch-Site", "cross-site"),
        csrf(own(cookie(ends(&[403])))).header("Sec-Fetch-Site", "same-site"),
        csrf(cookie(ends(&[403]))).header("Sec-Fetch-Site", "none"),
        csrf(cookie(ends(&[403]))).header("Referer", format!("{}/", carol.origin)),
        // Who is shown by a token is not who is signed in beside it.
        csrf(own(cookie(ends(&[403])))).bearer(&scene.tokens.eve),
        csrf(own(cookie(Attempt::new(
            "DELETE",
            format!("{PATH}?token={}", scene.tokens.rover),
            &[403],
        )))),
        // Asking for leave ahead of a request gets none.
        cookie(Attempt::new("OPTIONS", PATH, &[403, 405]))
            .header("Origin", "https://evil.example")
            .header("Access-Control-Request-Method", "DELETE"),
        own(cookie(Attempt::new("POST", PATH, &[403, 405])))
            .header("X-HTTP-Method-Override", "DELETE"),
        own(cookie(Attempt::new("HEAD", PATH, &[200]))).header("X-HTTP-Method-Override", "DELETE"),
        // A session of a viewer is a viewer's, whoever's mark is beside it.
        csrf(own(ends(&[403]))).header("Cookie", dave.cookie.clone()),
    ];
    for origin in [
        "null",
        "https://evil.example",
        &format!("http://localhost:{port}"),
        &format!("https://127.0.0.1:{port}"),
        "http://127.0.0.1",
        &format!("http://127.0.0.1:{port}.evil.example"),
        &format!("http://127.0.0.1:{port}@evil.example"),
        &format!("http://evil.example#http://127.0.0.1:{port}"),
        "",
    ] {
        attempts.push(csrf(cookie(ends(&[403]))).header("Origin", origin));
    }
    // Signing in elsewhere, or as nobody else would.
    let sign_in = |body: String, status: &'static [u16]| {
        Attempt::new("POST", "/api/v1/session", status).body(body)
    };
    let known = format!("{{\"name\": \"carol\", \"password\": \"{PASSWORD}\"}}");
    attempts.extend([
        sign_in(known.clone(), &[403]).header("Origin", "https://evil.example"),
        sign_in(known.clone(), &[403])
            .header("Origin", "null")
            .header("Content-Type", "text/plain"),
        sign_in(known, &[403]).header("Sec-Fetch-Site", "cross-site"),
        sign_in(
            format!("name=carol&password={}", PASSWORD.replace(' ', "+")),
            &[400],
        )
        .header("Content-Type", "application/x-www-form-urlencoded"),
        sign_in(
            "{\"name\": \"Carol\", \"password\": \"wrong but long enough\"}".into(),
            &[401],
        ),
        sign_in(
            "{\"name\": \"carol\", \"password\": [\"x\"]}".into(),
            &[400],
        ),
        sign_in(
            "{\"name\": {\"$ne\": \"\"}, \"password\": {\"$ne\": \"\"}}".into(),
            &[400],
        ),
        sign_in(
            "{\"name\": \"' OR 1=1 --\", \"password\": \"' OR 1=1 --\"}".into(),
            &[400],
        ),
        sign_in("{\"name\": \"chief\", \"password\": \"\"}".into(), &[401]),
        sign_in(
            "{\"name\": \"carol\", \"password\": \"\", \"role\": \"admin\"}".into(),
            &[400],
        ),
    ]);
    scene.all_fail(
        "somebody else's browser",
        None,
        &[&scene.tokens.admin],
        attempts,
    )?;
    // None of it took what was begun: her page asks, and is answered.
    let before = state(daemon)?;
    ensure!(carol.asks("GET", PATH)?.0 == 200);
    ensure!(before == state(daemon)?);
    Ok(())
}
