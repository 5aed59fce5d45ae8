//! Users of an identity provider: they sign in through it, and irregular sign-ins fail.

use anyhow::ensure;
use serde_json::Value;
use support::provider::{ROLES, SECRET, StoryIdentityProvider, expect_no_secret};
use support::world::world;
use support::{Verdict, wait_until};

use crate::browser::ChromiumBrowser;

const LOGIN: &str = "/api/v1/oidc/login";

pub fn a_group_of_the_provider_is_a_role_here() -> Verdict {
    let provider = StoryIdentityProvider::start()?;
    let setup = provider.setup("oidc", ROLES)?;
    let daemon = setup.start()?;
    // With a provider configured a session is required, also on this machine.
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    let open = daemon.get_json("/api/v1/session")?;
    ensure!(open["needed"] == true && open["provider"]["name"] == "Lab login", "{open}");
    ensure!(open["provider"]["path"] == LOGIN, "{open}");
    let alice = provider.browser("alice");
    let visit = alice.sign_in()?;
    ensure!(visit.status == 200 && visit.body.contains("url=/\""), "goes on by itself: {visit:?}");
    alice.expect_user("oidc:alice", "admin")?;
    ensure!(alice.visit("/api/v1/tokens")?.status == 200, "an admin");
    // Another user with the same name has another identity.
    provider.set_user("another")?;
    let another = provider.browser("another");
    another.sign_in()?;
    another.expect_user("oidc:alice~2", "viewer")?;
    ensure!(another.visit("/api/v1/tokens")?.status == 403);
    ensure!(another.visit("/api/v1/services/other")?.status == 403, "its scope");
    ensure!(another.visit("/api/v1/services/lab_1")?.status == 404, "its scope");
    // With several groups the most powerful role counts, with its own services.
    provider.set_user("both")?;
    let dora = provider.browser("dora");
    dora.sign_in()?;
    dora.expect_user("oidc:dora", "deployer")?;
    ensure!(dora.visit("/api/v1/services/lab_1")?.status == 403);
    // Requests by cookie need the same CSRF token as those of accounts.
    let listed = daemon.deployer().run_json(&["account", "sessions"])?;
    let names: Vec<_> = listed.as_array().into_iter().flatten().map(|line| line["name"].clone()).collect();
    ensure!(names == ["oidc:alice", "oidc:alice~2", "oidc:dora"], "{listed}");
    let no_csrf = alice.request(&["-X", "DELETE"], &format!("{}/api/v1/services/x", provider.portal()))?;
    no_csrf.expect_refusal(403, &["may not use a session"])?;
    ensure!(alice.send_change("DELETE", "/api/v1/services/x")?.status == 404);
    // Accounts and tokens cannot have such a name; rules can use it.
    let deployer = daemon.deployer();
    let token = ["token", "create", "oidc:alice", "--role", "admin"];
    deployer.run(&token)?.expect_failure(&["is not a valid name"])?;
    let rule = ["policy", "allow", "oidc:dora", "subscribe:/camera/**", "--service", "build_*"];
    deployer.run(&rule)?.expect_success()?;
    // Sessions survive a restart, and can be ended one by one.
    daemon.stop()?;
    let daemon = setup.start()?;
    alice.expect_user("oidc:alice", "admin")?;
    daemon.deployer().run(&["account", "logout", "oidc:alice~2"])?.expect_success()?;
    ensure!(another.is_signed_out()?);
    let mut secrets = alice.secrets()?;
    secrets.extend(dora.secrets()?);
    let out = alice.send_change("DELETE", "/api/v1/session")?;
    ensure!(out.status == 204 && alice.is_signed_out()?, "{out:?}");
    dora.expect_user("oidc:dora", "deployer")?;
    // Signing in again ends the browser's previous session.
    let before = daemon.deployer().run_json(&["account", "sessions", "oidc:dora"])?;
    provider.set_user("both")?;
    dora.sign_in()?;
    let after = daemon.deployer().run_json(&["account", "sessions", "oidc:dora"])?;
    let count = |all: &Value| all.as_array().map_or(0, Vec::len);
    ensure!((count(&before), count(&after)) == (1, 1), "{before} {after}");
    ensure!(before[0]["id"] != after[0]["id"], "{after}");
    let audited = daemon.deployer().run(&["--format", "json", "audit"])?;
    for words in ["person oidc:alice", "oidc:alice (admin)", "sign in by the identity provider"] {
        ensure!(audited.stdout.contains(words), "{words}: {}", audited.stdout);
    }
    secrets.push(SECRET.to_owned());
    secrets.extend(provider.secrets());
    ensure!(secrets.len() > 8, "tokens were given out: {}", secrets.len());
    expect_no_secret(&daemon, &secrets)
}

pub fn who_has_no_role_is_told_why() -> Verdict {
    let provider = StoryIdentityProvider::with_token_claims()?;
    let daemon = provider.setup("oidc-none", ROLES)?.start()?;
    provider.set_user("visitor")?;
    let visit = provider.browser("vic").sign_in()?;
    let bold = "visitors, &lt;b&gt;bold&lt;/b&gt;";
    visit.expect_refusal(403, &["oidc:vic signed in", bold, "[oidc]"])?;
    provider.set_user("nobody")?;
    let visit = provider.browser("nell").sign_in()?;
    visit.expect_refusal(403, &["oidc:nell signed in", "gives none in the claim groups"])?;
    provider.set_fault("denied")?;
    let visit = provider.browser("denied").sign_in()?;
    visit.expect_refusal(403, &["access_denied", "not &lt;today&gt;"])?;
    let none = daemon.deployer().run_json(&["account", "sessions"])?;
    ensure!(none.as_array().is_some_and(Vec::is_empty), "{none}");
    // With claims in the ID token no further request is needed.
    provider.set_user("student")?;
    let sam = provider.browser("sam");
    sam.sign_in()?;
    sam.expect_user("oidc:sam", "viewer")?;
    let audited = daemon.deployer().run(&["--format", "json", "audit"])?;
    ensure!(audited.stdout.contains("person oidc:vic"), "{}", audited.stdout);
    Ok(())
}

pub fn a_token_that_is_not_good_signs_nobody_in() -> Verdict {
    let provider = StoryIdentityProvider::start()?;
    let daemon = provider.setup("oidc-wrong", ROLES)?.start()?;
    let mut taken = Vec::new();
    for (wrong, words) in [
        ("nonce", "nonce mismatch"),
        ("no-nonce", "missing nonce"),
        ("audience", "audience"),
        ("no-azp", "no azp"),
        ("azp", "issued for the client another"),
        ("issuer", "issuer"),
        ("expired", "expired"),
        ("future", "in the future"),
        ("no-expiry", "with iss, sub, aud, exp"),
        ("garbage", "with iss, sub, aud, exp"),
        ("none", "No signature"),
        ("hs256-public", "Disallowed signature algorithm"),
        ("hs256-secret", "Disallowed signature algorithm"),
        ("forged", "Crypto error"),
        ("cut", "Crypto error"),
        ("access-token", "at_hash"),
        ("unknown-key", "No matching key"),
        ("no-token", "it is missing"),
        ("userinfo", "another person"),
    ] {
        provider.set_user("alice")?;
        provider.set_fault(wrong)?;
        let browser = provider.browser(wrong);
        let visit = browser.sign_in()?;
        let tells = provider.secrets().iter().any(|secret| visit.body.contains(secret));
        if tells || visit.status != 401 || !visit.body.contains(words) || !browser.is_signed_out()? {
            taken.push(format!("{wrong}: {visit:?}"));
        }
    }
    ensure!(taken.is_empty(), "{}", taken.join("\n"));
    provider.set_fault("huge-token")?;
    let visit = provider.browser("huge").sign_in()?;
    visit.expect_refusal(502, &["cannot reach the identity provider", "cannot be read"])?;
    let none = daemon.deployer().run_json(&["account", "sessions"])?;
    ensure!(none.as_array().is_some_and(Vec::is_empty), "{none}");
    // Clock skew is tolerated, and a token may have several audiences.
    for right in ["skewed", "several", "list"] {
        provider.set_user("alice")?;
        provider.set_fault(right)?;
        let browser = provider.browser(right);
        browser.sign_in()?;
        browser.expect_user("oidc:alice", "admin")?;
    }
    expect_no_secret(&daemon, &provider.secrets())
}

pub fn a_sign_in_is_good_once_and_in_its_browser() -> Verdict {
    let provider = StoryIdentityProvider::start()?;
    let daemon = provider.setup("oidc-once", ROLES)?.start()?;
    let callback = "/api/v1/oidc/callback";
    let path = |url: &str| url.replace(&provider.portal(), "");
    let [alice, eve] = ["alice", "eve"].map(|name| provider.browser(name));
    // Eve's browser, with a sign-in of its own in progress, is led to the response for Alice's.
    let answer = path(&alice.sign_in_until_callback()?);
    eve.sign_in_until_callback()?;
    eve.visit(&answer)?.expect_refusal(400, &["started in another browser"])?;
    ensure!(eve.is_signed_out()?);
    // The response was for Alice's browser and has been used.
    alice.visit(&answer)?.expect_refusal(400, &["not started here"])?;
    let answer = path(&alice.sign_in_until_callback()?);
    let sent = |header: &str| alice.request(&["-H", header], &format!("{}{answer}", provider.portal()));
    for part in ["image", "iframe"] {
        let visit = sent(&format!("Sec-Fetch-Dest: {part}"))?;
        visit.expect_refusal(403, &["not by a person"])?;
    }
    // A request from within another page has not used it up.
    ensure!(alice.visit(&answer)?.status == 200);
    alice.expect_user("oidc:alice", "admin")?;
    alice.visit(&answer)?.expect_refusal(400, &["not started here"])?;
    let other = provider.browser("other-issuer");
    let answer = path(&other.sign_in_until_callback()?).replace("iss=http", "iss=https");
    other.visit(&answer)?.expect_refusal(401, &["the answer comes from another issuer"])?;
    let made_up = provider.browser("made-up");
    let answer = path(&made_up.sign_in_until_callback()?);
    let (before, _) = answer.split_once("code=").unwrap_or_default();
    let (_, state) = answer.split_once("&state=").unwrap_or_default();
    let answer = format!("{before}code=invented&state={state}");
    made_up.visit(&answer)?.expect_refusal(401, &["rejected its own code"])?;
    // A sign-in starts at the host name of the portal's cookies.
    let named = alice.request(&["-H", "Host: localhost:1"], &format!("{}{LOGIN}", provider.portal()))?;
    ensure!(named.status == 303 && named.onward.ends_with(&format!("{LOGIN}?again=true")), "{named:?}");
    let wrong = format!("{}{LOGIN}?again=true", provider.portal());
    let refused = alice.request(&["-H", "Host: localhost:1"], &wrong)?;
    refused.expect_refusal(403, &["redirect", "Host"])?;
    // Repeated guesses are slowed down.
    wait_until("who guesses to be slowed", || {
        let visit = eve.visit(&format!("{callback}?state=invented&code=x"))?;
        ensure!(visit.status == 400 || visit.status == 429, "{visit:?}");
        Ok(match visit.status {
            429 => Ok(()),
            _ => Err(visit.body),
        })
    })?;
    alice.expect_user("oidc:alice", "admin")?;
    drop(daemon);
    Ok(())
}

pub fn a_provider_that_is_down_keeps_nobody_else_out() -> Verdict {
    let mut provider = StoryIdentityProvider::new_stopped()?;
    let setup = provider.setup("oidc-down", ROLES)?;
    let daemon = setup.start()?;
    let alice = provider.browser("alice");
    let down = |visit: support::provider::PageVisit| {
        visit.expect_refusal(
            502,
            &["cannot reach the identity provider", &provider.issuer(), "accounts and tokens still work"],
        )
    };
    down(alice.sign_in()?)?;
    let secret = daemon.deployer().run_json(&["token", "create", "tool", "--role", "operator"])?;
    let bearer = format!("Bearer {}", secret["secret"].as_str().unwrap_or_default());
    let asked = daemon.request("GET", "/api/v1/status", &[("Authorization", &bearer)])?;
    ensure!(asked.0 == 200, "{asked:?}");
    provider.bring_up()?;
    for (wrong, words) in [
        ("huge", "cannot be read"),
        ("other-issuer", "issuer"),
        ("no-json", "Content-Type"),
        ("silent", "did not answer within 10 s"),
    ] {
        provider.set_fault(wrong)?;
        wait_until("the provider to be asked anew", || {
            let visit = alice.sign_in()?;
            ensure!(visit.status == 502, "{wrong}: {visit:?}");
            Ok(if visit.body.contains(words) { Ok(()) } else { Err(visit.body) })
        })?;
    }
    provider.set_user("alice")?;
    wait_until("the provider to be asked anew", || {
        let visit = alice.sign_in()?;
        Ok(match visit.status {
            200 => Ok(()),
            _ => Err(visit.body),
        })
    })?;
    alice.expect_user("oidc:alice", "admin")?;
    // The provider changes its signing key, and the previous one was cached.
    provider.restart_with_new_key()?;
    let again = provider.browser("again");
    again.sign_in()?;
    again.expect_user("oidc:alice", "admin")?;
    // Signed-in users stay signed in while it is down.
    provider.shut_down();
    alice.expect_user("oidc:alice", "admin")?;
    Ok(())
}

pub fn sessions_end_when_the_configuration_gives_other_rights() -> Verdict {
    let provider = StoryIdentityProvider::start()?;
    let setup = provider.setup("oidc-changed", ROLES)?;
    let daemon = setup.start()?;
    let alice = provider.browser("alice");
    alice.sign_in()?;
    provider.set_user("student")?;
    let sam = provider.browser("sam");
    sam.sign_in()?;
    daemon.stop()?;
    // Students may see more, and nothing changes for admins.
    let home = support::daemon::DaemonSetup::new(setup.home());
    let roles = ROLES.replace("lab_*", "*");
    let daemon = provider.setup_with(home.clone(), &roles)?.start()?;
    alice.expect_user("oidc:alice", "admin")?;
    ensure!(sam.is_signed_out()?, "its rights are others");
    sam.sign_in()?;
    ensure!(sam.visit("/api/v1/status")?.status == 200, "all services");
    daemon.stop()?;
    let roles = "students = { role = \"viewer\", services = [\"*\"] }";
    let daemon = provider.setup_with(home.clone(), roles)?.start()?;
    ensure!(alice.is_signed_out()?, "its group is not named any more");
    sam.expect_user("oidc:sam", "viewer")?;
    daemon.stop()?;
    // Without the provider its users are unknown, but the portal is not open either.
    let address = provider.portal().replace("http://", "");
    let daemon = home.listen(&address).start()?;
    ensure!(sam.is_signed_out()?);
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    let (status, body) = daemon.get(LOGIN)?;
    ensure!(status == 404 && body.contains("docs/access.md"), "{status} {body}");
    Ok(())
}

pub fn a_real_browser_comes_back_signed_in() -> Verdict {
    let provider = StoryIdentityProvider::start()?;
    let daemon = provider.setup("oidc-browser", ROLES)?.start()?;
    let profile = world().directory("oidc-profile")?;
    let login = format!("{}{LOGIN}", provider.portal());
    let browser = ChromiumBrowser::open(&login, profile.path(), &[])?;
    // The page to which it is redirected uses the session; the redirect from the provider alone would not include the
    // cookie.
    let session = wait_until("the page to ask by the session", || {
        let all = daemon.deployer().run_json(&["account", "sessions"])?;
        let line = all[0].clone();
        let used = line["last_used"].as_u64() > line["created"].as_u64();
        Ok(if used { Ok(line) } else { Err(all.to_string()) })
    })?;
    drop(browser);
    ensure!(session["name"] == "oidc:alice", "{session}");
    Ok(())
}

pub fn through_tls_both_cookies_are_this_hosts_alone() -> Verdict {
    let provider = StoryIdentityProvider::for_tls_portal()?;
    let setup = provider.setup("oidc-tls", ROLES)?;
    let daemon = setup.config("[tls]\nserve = \"tls\"\n").start()?;
    let own = daemon.home.join("tls/own.pem");
    let alice = provider.browser("alice").with_authority(&own);
    ensure!(alice.sign_in()?.status == 200);
    alice.expect_user("oidc:alice", "admin")?;
    let kept = alice.cookies()?;
    for name in ["__Host-cloudroid\t", "__Host-cloudroid-oidc\t"] {
        let line = kept.lines().find(|line| line.contains(name));
        // Host prefix, whole path, secure.
        ensure!(line.is_some_and(|line| line.contains("localhost\tFALSE\t/\tTRUE\t")), "{name}: {kept}");
    }
    ensure!(alice.send_change("DELETE", "/api/v1/session")?.status == 204);
    ensure!(alice.is_signed_out()?);
    Ok(())
}
