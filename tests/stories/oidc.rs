//! People whom an identity provider knows: they sign in by it, and what is not as it should be comes to nothing.

use anyhow::ensure;
use serde_json::Value;
use support::provider::{Provider, ROLES, SECRET, finds_no_secret};
use support::world::world;
use support::{Verdict, until};

use crate::browser::Browser;

const LOGIN: &str = "/api/v1/oidc/login";

pub fn a_group_of_the_provider_is_a_role_here() -> Verdict {
    let provider = Provider::start()?;
    let setup = provider.setup("oidc", ROLES)?;
    let daemon = setup.start()?;
    // Who is configured to come is asked for, also on this machine.
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    let open = daemon.get_json("/api/v1/session")?;
    ensure!(
        open["needed"] == true && open["provider"]["name"] == "Lab login",
        "{open}"
    );
    ensure!(open["provider"]["path"] == LOGIN, "{open}");
    let alice = provider.browser("alice");
    let visit = alice.signs_in()?;
    ensure!(
        visit.status == 200 && visit.body.contains("url=/\""),
        "goes on by itself: {visit:?}"
    );
    alice.is("oidc:alice", "admin")?;
    ensure!(alice.goes("/api/v1/tokens")?.status == 200, "an admin");
    // Another who is called so is somebody else.
    provider.knows("another")?;
    let another = provider.browser("another");
    another.signs_in()?;
    another.is("oidc:alice~2", "viewer")?;
    ensure!(another.goes("/api/v1/tokens")?.status == 403);
    ensure!(
        another.goes("/api/v1/services/other")?.status == 403,
        "its scope"
    );
    ensure!(
        another.goes("/api/v1/services/lab_1")?.status == 404,
        "its scope"
    );
    // Of several groups the strongest role counts, with its own services.
    provider.knows("both")?;
    let dora = provider.browser("dora");
    dora.signs_in()?;
    dora.is("oidc:dora", "deployer")?;
    ensure!(dora.goes("/api/v1/services/lab_1")?.status == 403);
    // What the page does by its cookie needs what is asked of accounts, too.
    let listed = daemon.deployer().asks(&["account", "sessions"])?;
    let names: Vec<_> = listed
        .as_array()
        .into_iter()
        .flatten()
        .map(|line| line["name"].clone())
        .collect();
    ensure!(
        names == ["oidc:alice", "oidc:alice~2", "oidc:dora"],
        "{listed}"
    );
    let no_csrf = alice.asks(
        &["-X", "DELETE"],
        &format!("{}/api/v1/services/x", provider.portal()),
    )?;
    no_csrf.refused(403, &["may not use the session"])?;
    ensure!(alice.changes("DELETE", "/api/v1/services/x")?.status == 404);
    // Nobody makes an account or a token of such a name; rules can name it.
    let deployer = daemon.deployer();
    let token = ["token", "create", "oidc:alice", "--role", "admin"];
    deployer.types(&token)?.failed_saying(&["is no name"])?;
    let rule = [
        "policy",
        "allow",
        "oidc:dora",
        "subscribe:/camera/**",
        "--service",
        "build_*",
    ];
    deployer.types(&rule)?.succeeded()?;
    // Sessions stay over a restart, and end one by one.
    daemon.ends()?;
    let daemon = setup.start()?;
    alice.is("oidc:alice", "admin")?;
    daemon
        .deployer()
        .types(&["account", "logout", "oidc:alice~2"])?
        .succeeded()?;
    ensure!(another.is_signed_out()?);
    let mut secrets = alice.secrets()?;
    secrets.extend(dora.secrets()?);
    let out = alice.changes("DELETE", "/api/v1/session")?;
    ensure!(out.status == 204 && alice.is_signed_out()?, "{out:?}");
    dora.is("oidc:dora", "deployer")?;
    // Whoever signs in again ends the session that the browser showed.
    let before = daemon
        .deployer()
        .asks(&["account", "sessions", "oidc:dora"])?;
    provider.knows("both")?;
    dora.signs_in()?;
    let after = daemon
        .deployer()
        .asks(&["account", "sessions", "oidc:dora"])?;
    let count = |all: &Value| all.as_array().map_or(0, Vec::len);
    ensure!(
        (count(&before), count(&after)) == (1, 1),
        "{before} {after}"
    );
    ensure!(before[0]["id"] != after[0]["id"], "{after}");
    let audited = daemon.deployer().types(&["--format", "json", "audit"])?;
    for words in [
        "person oidc:alice",
        "oidc:alice (admin)",
        "GET /api/v1/oidc/callback",
    ] {
        ensure!(
            audited.stdout.contains(words),
            "{words}: {}",
            audited.stdout
        );
    }
    secrets.push(SECRET.to_owned());
    secrets.extend(provider.secrets());
    ensure!(
        secrets.len() > 8,
        "tokens were given out: {}",
        secrets.len()
    );
    finds_no_secret(&daemon, &secrets)
}

pub fn who_has_no_role_is_told_why() -> Verdict {
    let provider = Provider::with_claims_in_the_token()?;
    let daemon = provider.setup("oidc-none", ROLES)?.start()?;
    provider.knows("visitor")?;
    let visit = provider.browser("vic").signs_in()?;
    let bold = "visitors, &lt;b&gt;bold&lt;/b&gt;";
    visit.refused(403, &["oidc:vic has signed in", bold, "[oidc]"])?;
    provider.knows("nobody")?;
    let visit = provider.browser("nell").signs_in()?;
    visit.refused(
        403,
        &["oidc:nell has signed in", "names none in the claim groups"],
    )?;
    provider.does_wrong("denied")?;
    let visit = provider.browser("denied").signs_in()?;
    visit.refused(403, &["access_denied", "not &lt;today&gt;"])?;
    let none = daemon.deployer().asks(&["account", "sessions"])?;
    ensure!(none.as_array().is_some_and(Vec::is_empty), "{none}");
    // With the claims in the token nobody needs to ask for more.
    provider.knows("student")?;
    let sam = provider.browser("sam");
    sam.signs_in()?;
    sam.is("oidc:sam", "viewer")?;
    let audited = daemon.deployer().types(&["--format", "json", "audit"])?;
    ensure!(
        audited.stdout.contains("person oidc:vic"),
        "{}",
        audited.stdout
    );
    Ok(())
}

pub fn a_token_that_is_not_good_signs_nobody_in() -> Verdict {
    let provider = Provider::start()?;
    let daemon = provider.setup("oidc-wrong", ROLES)?.start()?;
    let mut taken = Vec::new();
    for (wrong, words) in [
        ("nonce", "nonce mismatch"),
        ("no-nonce", "missing nonce"),
        ("audience", "audience"),
        ("no-azp", "no azp"),
        ("azp", "made for the client another"),
        ("issuer", "issuer"),
        ("expired", "expired"),
        ("future", "yet to come"),
        ("no-expiry", "has iss, sub, aud, exp"),
        ("garbage", "has iss, sub, aud, exp"),
        ("none", "No signature"),
        ("hs256-public", "Disallowed signature algorithm"),
        ("hs256-secret", "Disallowed signature algorithm"),
        ("forged", "Crypto error"),
        ("cut", "Crypto error"),
        ("access-token", "at_hash"),
        ("unknown-key", "No matching key"),
        ("no-token", "there is none"),
        ("userinfo", "another person"),
    ] {
        provider.knows("alice")?;
        provider.does_wrong(wrong)?;
        let browser = provider.browser(wrong);
        let visit = browser.signs_in()?;
        let tells = provider
            .secrets()
            .iter()
            .any(|secret| visit.body.contains(secret));
        if tells
            || visit.status != 401
            || !visit.body.contains(words)
            || !browser.is_signed_out()?
        {
            taken.push(format!("{wrong}: {visit:?}"));
        }
    }
    ensure!(taken.is_empty(), "{}", taken.join("\n"));
    provider.does_wrong("huge-token")?;
    let visit = provider.browser("huge").signs_in()?;
    visit.refused(502, &["cannot be asked", "cannot be read"])?;
    let none = daemon.deployer().asks(&["account", "sessions"])?;
    ensure!(none.as_array().is_some_and(Vec::is_empty), "{none}");
    // Clocks are never quite the same, and a token may be for several.
    for right in ["skewed", "several", "list"] {
        provider.knows("alice")?;
        provider.does_wrong(right)?;
        let browser = provider.browser(right);
        browser.signs_in()?;
        browser.is("oidc:alice", "admin")?;
    }
    finds_no_secret(&daemon, &provider.secrets())
}

pub fn a_sign_in_is_good_once_and_in_its_browser() -> Verdict {
    let provider = Provider::start()?;
    let daemon = provider.setup("oidc-once", ROLES)?.start()?;
    let callback = "/api/v1/oidc/callback";
    let path = |url: &str| url.replace(&provider.portal(), "");
    let [alice, eve] = ["alice", "eve"].map(|name| provider.browser(name));
    // Eve's browser is led to an answer that is for Alice's, and has begun a sign-in of its own.
    let answer = path(&alice.signs_in_half()?);
    eve.signs_in_half()?;
    eve.goes(&answer)?
        .refused(400, &["begun in another browser"])?;
    ensure!(eve.is_signed_out()?);
    // Whoever came with it has used it up.
    alice.goes(&answer)?.refused(400, &["not begun here"])?;
    let answer = path(&alice.signs_in_half()?);
    let sent =
        |header: &str| alice.asks(&["-H", header], &format!("{}{answer}", provider.portal()));
    for part in ["image", "iframe"] {
        let visit = sent(&format!("Sec-Fetch-Dest: {part}"))?;
        visit.refused(403, &["and not a person"])?;
    }
    // A part of another page has not used it up.
    ensure!(alice.goes(&answer)?.status == 200);
    alice.is("oidc:alice", "admin")?;
    alice.goes(&answer)?.refused(400, &["not begun here"])?;
    let other = provider.browser("other-issuer");
    let answer = path(&other.signs_in_half()?).replace("iss=http", "iss=https");
    other
        .goes(&answer)?
        .refused(401, &["the answer is one of"])?;
    let made_up = provider.browser("made-up");
    let answer = path(&made_up.signs_in_half()?);
    let (before, _) = answer.split_once("code=").unwrap_or_default();
    let (_, state) = answer.split_once("&state=").unwrap_or_default();
    let answer = format!("{before}code=invented&state={state}");
    made_up
        .goes(&answer)?
        .refused(401, &["does not take its code back"])?;
    // A portal is asked where its cookies are.
    let named = alice.asks(
        &["-H", "Host: localhost:1"],
        &format!("{}{LOGIN}", provider.portal()),
    )?;
    ensure!(
        named.status == 303 && named.onward.ends_with(&format!("{LOGIN}?again=true")),
        "{named:?}"
    );
    let wrong = format!("{}{LOGIN}?again=true", provider.portal());
    let refused = alice.asks(&["-H", "Host: localhost:1"], &wrong)?;
    refused.refused(403, &["redirect", "Host"])?;
    // Guesses are slowed.
    until("who guesses to be slowed", || {
        let visit = eve.goes(&format!("{callback}?state=invented&code=x"))?;
        ensure!(visit.status == 400 || visit.status == 429, "{visit:?}");
        Ok(match visit.status {
            429 => Ok(()),
            _ => Err(visit.body),
        })
    })?;
    alice.is("oidc:alice", "admin")?;
    drop(daemon);
    Ok(())
}

pub fn a_provider_that_is_down_keeps_nobody_else_out() -> Verdict {
    let mut provider = Provider::that_is_down()?;
    let setup = provider.setup("oidc-down", ROLES)?;
    let daemon = setup.start()?;
    let alice = provider.browser("alice");
    let down = |visit: support::provider::Visit| {
        visit.refused(
            502,
            &[
                "cannot be asked",
                &provider.issuer(),
                "accounts and tokens work on",
            ],
        )
    };
    down(alice.signs_in()?)?;
    let secret = daemon
        .deployer()
        .asks(&["token", "create", "tool", "--role", "operator"])?;
    let bearer = format!("Bearer {}", secret["secret"].as_str().unwrap_or_default());
    let asked = daemon.request("GET", "/api/v1/status", &[("Authorization", &bearer)])?;
    ensure!(asked.0 == 200, "{asked:?}");
    provider.comes_up()?;
    for (wrong, words) in [
        ("huge", "cannot be read"),
        ("other-issuer", "issuer"),
        ("no-json", "Content-Type"),
        ("silent", "did not answer within 10 s"),
    ] {
        provider.does_wrong(wrong)?;
        until("the provider to be asked anew", || {
            let visit = alice.signs_in()?;
            ensure!(visit.status == 502, "{wrong}: {visit:?}");
            Ok(match visit.body.contains(words) {
                true => Ok(()),
                false => Err(visit.body),
            })
        })?;
    }
    provider.knows("alice")?;
    until("the provider to be asked anew", || {
        let visit = alice.signs_in()?;
        Ok(match visit.status {
            200 => Ok(()),
            _ => Err(visit.body),
        })
    })?;
    alice.is("oidc:alice", "admin")?;
    // It signs by another key, and what it was asked for is kept.
    provider.signs_by_another_key()?;
    let again = provider.browser("again");
    again.signs_in()?;
    again.is("oidc:alice", "admin")?;
    // Who was signed in stays so while it is down.
    provider.goes_down();
    alice.is("oidc:alice", "admin")?;
    Ok(())
}

pub fn sessions_end_when_the_configuration_gives_other_rights() -> Verdict {
    let provider = Provider::start()?;
    let setup = provider.setup("oidc-changed", ROLES)?;
    let daemon = setup.start()?;
    let alice = provider.browser("alice");
    alice.signs_in()?;
    provider.knows("student")?;
    let sam = provider.browser("sam");
    sam.signs_in()?;
    daemon.ends()?;
    // Students see more, and nothing changes for admins.
    let home = support::daemon::Setup::new(setup.home());
    let roles = ROLES.replace("lab_*", "*");
    let daemon = provider.setup_with(home.clone(), &roles)?.start()?;
    alice.is("oidc:alice", "admin")?;
    ensure!(sam.is_signed_out()?, "its rights are others");
    sam.signs_in()?;
    ensure!(sam.goes("/api/v1/status")?.status == 200, "all services");
    daemon.ends()?;
    let roles = "students = { role = \"viewer\", services = [\"*\"] }";
    let daemon = provider.setup_with(home.clone(), roles)?.start()?;
    ensure!(alice.is_signed_out()?, "its group is not named any more");
    sam.is("oidc:sam", "viewer")?;
    daemon.ends()?;
    // Without a provider nobody of it is known, and the portal is not open either.
    let address = provider.portal().replace("http://", "");
    let daemon = home.listen(&address).start()?;
    ensure!(sam.is_signed_out()?);
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    let (status, body) = daemon.get(LOGIN)?;
    ensure!(
        status == 404 && body.contains("docs/access.md"),
        "{status} {body}"
    );
    Ok(())
}

pub fn a_real_browser_comes_back_signed_in() -> Verdict {
    let provider = Provider::start()?;
    let daemon = provider.setup("oidc-browser", ROLES)?.start()?;
    let profile = world().directory("oidc-profile")?;
    let login = format!("{}{LOGIN}", provider.portal());
    let browser = Browser::opens(&login, profile.path(), &[])?;
    // The page that it goes on to asks by the session: what the provider has sent it to alone would not.
    let session = until("the page to ask by the session", || {
        let all = daemon.deployer().asks(&["account", "sessions"])?;
        let line = all[0].clone();
        let used = line["last_used"].as_u64() > line["created"].as_u64();
        Ok(if used { Ok(line) } else { Err(all.to_string()) })
    })?;
    drop(browser);
    ensure!(session["name"] == "oidc:alice", "{session}");
    Ok(())
}

pub fn through_tls_both_cookies_are_this_hosts_alone() -> Verdict {
    let provider = Provider::of_a_portal_with_tls()?;
    let setup = provider.setup("oidc-tls", ROLES)?;
    let daemon = setup.config("[tls]\nserve = \"tls\"\n").start()?;
    let own = daemon.home.join("tls/own.pem");
    let alice = provider.browser("alice").trusting(&own);
    ensure!(alice.signs_in()?.status == 200);
    alice.is("oidc:alice", "admin")?;
    let kept = alice.cookies()?;
    for name in ["__Host-cloudroid\t", "__Host-cloudroid-oidc\t"] {
        let line = kept.lines().find(|line| line.contains(name));
        // Host alone, whole path, secure.
        ensure!(
            line.is_some_and(|line| line.contains("localhost\tFALSE\t/\tTRUE\t")),
            "{name}: {kept}"
        );
    }
    ensure!(alice.changes("DELETE", "/api/v1/session")?.status == 204);
    ensure!(alice.is_signed_out()?);
    Ok(())
}
