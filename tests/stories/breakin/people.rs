//! The session of a signed-in user, as used by others: each attempt shows its cookie in a way that the page would not.

use anyhow::ensure;
use support::Verdict;

use super::scene::{BreakinScene, RequestAttempt, server_state};
use crate::people::{PASSWORD, SignedInBrowser, run_account};

const PATH: &str = "/api/v1/servants";

/// A request that would stop all servants.
fn stop_all_attempt<'a>(status: &'a [u16]) -> RequestAttempt<'a> {
    RequestAttempt::new("DELETE", PATH, status)
}

pub fn cannot_be_made_to_ask(scene: &BreakinScene) -> Verdict {
    let daemon = &scene.daemon;
    run_account(daemon, &["create", "dave", "--role", "viewer", "--service", "*"], PASSWORD)?.expect_success()?;
    let carol = SignedInBrowser::sign_in(daemon, "carol", PASSWORD)?;
    let dave = SignedInBrowser::sign_in(daemon, "dave", PASSWORD)?;
    let (name, secret) = carol.cookie.split_once('=').unwrap_or_default();
    let cookie = |attempt: RequestAttempt<'static>| attempt.header("Cookie", carol.cookie.clone());
    let own = |attempt: RequestAttempt<'static>| attempt.header("Origin", carol.origin.clone());
    let csrf = |attempt: RequestAttempt<'static>| attempt.header("X-CSRF-Token", carol.csrf.clone());
    let (_, port) = daemon.address.rsplit_once(':').unwrap_or_default();
    let mut attempts = vec![
        // Without the cookie, or in its place.
        csrf(own(stop_all_attempt(&[401]))),
        csrf(own(RequestAttempt::new("DELETE", format!("{PATH}?{name}={secret}"), &[401]))),
        csrf(own(RequestAttempt::new("DELETE", format!("{PATH}?session={secret}"), &[401]))),
        csrf(own(RequestAttempt::new("DELETE", format!("{PATH}?token={secret}"), &[401, 429]))),
        csrf(own(stop_all_attempt(&[401, 429]))).bearer(secret),
        csrf(own(stop_all_attempt(&[401]))).header("X-Session", secret),
        csrf(own(stop_all_attempt(&[401]))).header("Cookie", format!("__Host-cloudroid={secret}")),
        csrf(own(stop_all_attempt(&[401]))).header("Cookie", format!("CLOUDROID={secret}")),
        csrf(own(stop_all_attempt(&[401]))).header("Cookie", format!("{name}={secret}x")),
        csrf(own(stop_all_attempt(&[401]))).header("Cookie", format!("{name}=\"{secret}\"")),
        csrf(own(stop_all_attempt(&[401]))).header("Cookie", format!("{name}=")),
        // Twice, in one header or two, equal or not.
        csrf(own(stop_all_attempt(&[400]))).header("Cookie", format!("{}; {}", carol.cookie, carol.cookie)),
        csrf(own(stop_all_attempt(&[400]))).header("Cookie", format!("{}; {}", carol.cookie, dave.cookie)),
        csrf(own(cookie(stop_all_attempt(&[400])))).header("Cookie", dave.cookie.clone()),
        // Without the CSRF token, with that of another session, or in another place.
        own(cookie(stop_all_attempt(&[403]))),
        own(cookie(stop_all_attempt(&[403]))).header("X-CSRF-Token", dave.csrf.clone()),
        own(cookie(stop_all_attempt(&[403]))).header("X-CSRF-Token", ""),
        own(cookie(stop_all_attempt(&[403]))).header("X-CSRF-Token", secret),
        own(cookie(stop_all_attempt(&[403]))).header("X-CSRF-Token", carol.csrf.to_uppercase()),
        own(cookie(stop_all_attempt(&[403]))).header("CSRF-Token", carol.csrf.clone()),
        own(cookie(stop_all_attempt(&[403]))).body(format!("csrf={}", carol.csrf)),
        own(cookie(RequestAttempt::new("DELETE", format!("{PATH}?csrf={}", carol.csrf), &[403]))),
        // From another origin than the page's.
        csrf(cookie(stop_all_attempt(&[403]))),
        csrf(own(own(cookie(stop_all_attempt(&[403]))))),
        csrf(own(cookie(stop_all_attempt(&[403])))).header("Sec-Fetch-Site", "cross-site"),
        csrf(own(cookie(stop_all_attempt(&[403])))).header("Sec-Fetch-Site", "same-site"),
        csrf(cookie(stop_all_attempt(&[403]))).header("Sec-Fetch-Site", "none"),
        csrf(cookie(stop_all_attempt(&[403]))).header("Referer", format!("{}/", carol.origin)),
        // A token takes precedence over the session.
        csrf(own(cookie(stop_all_attempt(&[403])))).bearer(&scene.tokens.eve),
        csrf(own(cookie(RequestAttempt::new("DELETE", format!("{PATH}?token={}", scene.tokens.rover), &[403])))),
        // A CORS preflight is not granted.
        cookie(RequestAttempt::new("OPTIONS", PATH, &[403, 405]))
            .header("Origin", "https://evil.example")
            .header("Access-Control-Request-Method", "DELETE"),
        own(cookie(RequestAttempt::new("POST", PATH, &[403, 405]))).header("X-HTTP-Method-Override", "DELETE"),
        own(cookie(RequestAttempt::new("HEAD", PATH, &[200]))).header("X-HTTP-Method-Override", "DELETE"),
        // The session of a viewer has a viewer's rights, even with another session's CSRF token.
        csrf(own(stop_all_attempt(&[403]))).header("Cookie", dave.cookie.clone()),
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
        attempts.push(csrf(cookie(stop_all_attempt(&[403]))).header("Origin", origin));
    }
    // Signing in from elsewhere, or with unusual requests.
    let sign_in =
        |body: String, status: &'static [u16]| RequestAttempt::new("POST", "/api/v1/session", status).body(body);
    let known = format!("{{\"name\": \"carol\", \"password\": \"{PASSWORD}\"}}");
    attempts.extend([
        sign_in(known.clone(), &[403]).header("Origin", "https://evil.example"),
        sign_in(known.clone(), &[403]).header("Origin", "null").header("Content-Type", "text/plain"),
        sign_in(known, &[403]).header("Sec-Fetch-Site", "cross-site"),
        sign_in(format!("name=carol&password={}", PASSWORD.replace(' ', "+")), &[400])
            .header("Content-Type", "application/x-www-form-urlencoded"),
        sign_in("{\"name\": \"Carol\", \"password\": \"wrong but long enough\"}".into(), &[401]),
        sign_in("{\"name\": \"carol\", \"password\": [\"x\"]}".into(), &[400]),
        sign_in("{\"name\": {\"$ne\": \"\"}, \"password\": {\"$ne\": \"\"}}".into(), &[400]),
        sign_in("{\"name\": \"' OR 1=1 --\", \"password\": \"' OR 1=1 --\"}".into(), &[400]),
        sign_in("{\"name\": \"chief\", \"password\": \"\"}".into(), &[401]),
        sign_in("{\"name\": \"carol\", \"password\": \"\", \"role\": \"admin\"}".into(), &[400]),
    ]);
    scene.all_fail("somebody else's browser", None, &[&scene.tokens.admin], attempts)?;
    // None of these attempts has ended her session: requests of her page are still answered.
    let before = server_state(daemon)?;
    ensure!(carol.request("GET", PATH)?.0 == 200);
    ensure!(before == server_state(daemon)?);
    Ok(())
}
