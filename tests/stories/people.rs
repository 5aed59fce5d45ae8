//! People with accounts: they sign in to the page, and attempts of other pages in their browsers fail.

use std::io::Write;
use std::process::{Command, Stdio};

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, path_str, run};
use support::patience::patience;
use support::robot::Robot;
use support::world::world;
use support::{Verdict, binaries, wait_until};

pub const PASSWORD: &str = "four quiet purple engines";
const OTHER_PASSWORD: &str = "nine loud yellow kettles";
const PATH: &str = "/api/v1/session";

/// Runs a command for accounts, with a password on standard input.
pub fn run_account(daemon: &Daemon, arguments: &[&str], password: &str) -> anyhow::Result<CommandOutcome> {
    let mut child = Command::new(binaries::path("cloudroidctl"))
        .arg("account")
        .args(arguments)
        .arg("--password-stdin")
        .env("CLOUDROID_HOME", &daemon.home)
        .env_remove("CLOUDROID_SERVER")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let mut input = child.stdin.take().context("its standard input")?;
    input.write_all(format!("{password}\n").as_bytes())?;
    drop(input);
    let output = child.wait_with_output()?;
    Ok(CommandOutcome {
        command: format!("account {arguments:?}"),
        status: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

/// A browser with a signed-in user.
pub struct SignedInBrowser<'a> {
    daemon: &'a Daemon,
    pub origin: String,
    pub cookie: String,
    pub csrf: String,
}

fn request_sign_in(
    daemon: &Daemon,
    name: &str,
    password: &str,
    headers: &[(&str, &str)],
) -> anyhow::Result<(u16, String, String)> {
    let body = json!({"name": name, "password": password}).to_string();
    daemon.request_with_body("POST", PATH, headers, &body)
}

/// Returns `NAME=VALUE` of the cookie that a response sets, and its attributes.
fn set_cookie(head: &str) -> anyhow::Result<(String, String)> {
    let lines = head.lines();
    let mut set = lines.filter_map(|line| {
        let (name, value) = line.split_once(": ")?;
        name.eq_ignore_ascii_case("set-cookie").then_some(value)
    });
    let line = set.next().with_context(|| format!("a cookie in {head}"))?;
    let (cookie, rest) = line.split_once(';').context("its attributes")?;
    Ok((cookie.to_owned(), rest.to_owned()))
}

impl<'a> SignedInBrowser<'a> {
    pub fn sign_in(daemon: &'a Daemon, name: &str, password: &str) -> anyhow::Result<SignedInBrowser<'a>> {
        SignedInBrowser::sign_in_with_headers(daemon, name, password, &[])
    }

    fn sign_in_with_headers(
        daemon: &'a Daemon,
        name: &str,
        password: &str,
        headers: &[(&str, &str)],
    ) -> anyhow::Result<SignedInBrowser<'a>> {
        let origin = format!("http://{}", daemon.address);
        let headers = [headers, &[("Origin", &*origin)]].concat();
        let (status, head, body) = request_sign_in(daemon, name, password, &headers)?;
        ensure!(status == 200, "{status} {body}");
        let (cookie, rest) = set_cookie(&head)?;
        for attribute in ["HttpOnly", "SameSite=Strict", "Path=/"] {
            ensure!(rest.contains(attribute), "{attribute}: {rest}");
        }
        ensure!(!rest.contains("Domain"), "{rest}");
        let told: Value = serde_json::from_str(&body)?;
        ensure!(told["name"] == name, "{told}");
        Ok(SignedInBrowser { daemon, origin, cookie, csrf: told["csrf"].as_str().context("a csrf")?.to_owned() })
    }

    fn session_secret(&self) -> &str {
        self.cookie.split_once('=').map_or("", |(_, secret)| secret)
    }

    /// Sends a request as the page does.
    pub fn request(&self, method: &str, path: &str) -> anyhow::Result<(u16, String)> {
        self.request_with_headers(method, path, &[("Origin", &self.origin), ("X-CSRF-Token", &self.csrf)])
    }

    /// Sends a request with the cookie and only these headers.
    pub fn request_with_headers(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
    ) -> anyhow::Result<(u16, String)> {
        let headers = [headers, &[("Cookie", &*self.cookie)]].concat();
        let (status, _, body) = self.daemon.request_with_body(method, path, &headers, "")?;
        Ok((status, body))
    }

    fn is_signed_in(&self) -> anyhow::Result<bool> {
        let (status, body) = self.request("GET", "/api/v1/whoami")?;
        ensure!(status == 200 || status == 401, "{status} {body}");
        Ok(status == 200)
    }
}

pub fn people_sign_in_and_out() -> Verdict {
    let setup = world().setup("people");
    let daemon = setup.start()?;
    run_account(&daemon, &["create", "alice", "--role", "operator"], PASSWORD)?.expect_success()?;
    run_account(&daemon, &["create", "eve", "--role", "viewer", "--service", "adder*"], OTHER_PASSWORD)?
        .expect_success()?;
    // From the first account on unauthenticated requests are refused.
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    let open = daemon.get_json(PATH)?;
    ensure!(open["needed"] == true && open["accounts"] == true && open["name"].is_null(), "{open}");
    // A cookie that came from elsewhere is not adopted as the session.
    let invented = "cloudroid=abcdefghijklmnopqrstuvwxyz";
    let alice = SignedInBrowser::sign_in_with_headers(&daemon, "alice", PASSWORD, &[("Cookie", invented)])?;
    ensure!(alice.cookie != invented && alice.cookie.starts_with("cloudroid="));
    ensure!(alice.is_signed_in()? && alice.request("GET", "/api/v1/services")?.0 == 200);
    ensure!(alice.request("GET", "/api/v1/tokens")?.0 == 403, "an operator");
    let eve = SignedInBrowser::sign_in(&daemon, "eve", OTHER_PASSWORD)?;
    ensure!(eve.request("GET", "/api/v1/status")?.0 == 403, "a viewer of some");
    // Signing in again creates a new session and ends the previous one.
    let again = SignedInBrowser::sign_in_with_headers(&daemon, "alice", PASSWORD, &[("Cookie", &alice.cookie)])?;
    ensure!(again.cookie != alice.cookie && again.is_signed_in()?);
    ensure!(!alice.is_signed_in()?, "the one before");
    // Sessions survive a restart.
    let (cookie, csrf) = (again.cookie.clone(), again.csrf.clone());
    let address = daemon.address.clone();
    daemon.stop()?;
    let daemon = setup.listen(&address).start()?;
    let alice = SignedInBrowser { daemon: &daemon, origin: format!("http://{address}"), cookie, csrf };
    ensure!(alice.is_signed_in()?, "after the restart");
    let listed = daemon.deployer().run_json(&["account", "sessions"])?;
    ensure!(listed.as_array().is_some_and(|all| all.len() == 2), "{listed}");
    let (status, body) = alice.request("DELETE", PATH)?;
    ensure!(status == 204, "{status} {body}");
    ensure!(!alice.is_signed_in()?, "signed out");
    // No secret is written anywhere.
    let audited = daemon.deployer().run(&["--format", "json", "audit"])?.expect_success()?.stdout;
    for words in ["account alice", r#""did":"sign in""#, r#""did":"sign out""#] {
        ensure!(audited.contains(words), "{words}: {audited}");
    }
    let log = std::fs::read_to_string(daemon.home.join("daemon.log"))?;
    let state = String::from_utf8_lossy(&std::fs::read(daemon.home.join("cloudroid.db"))?).into_owned();
    for secret in [PASSWORD, OTHER_PASSWORD, alice.session_secret(), &alice.csrf] {
        for (name, text) in [("audit log", &audited), ("log", &log), ("database", &state)] {
            ensure!(!text.contains(secret), "the {name} has a secret");
        }
    }
    Ok(())
}

pub fn whoever_cannot_sign_in_is_told_no_more_than_that() -> Verdict {
    let daemon = world().setup("people-refused").start()?;
    let creates =
        |name: &str, role: &[&str], password: &str| run_account(&daemon, &[&["create", name], role].concat(), password);
    creates("alice", &["--role", "operator"], PASSWORD)?.expect_success()?;
    for (name, role, password, words) in [
        ("bob", &["--role", "operator"][..], "short", "at least 12"),
        ("bob", &["--role", "operator"], "passwordpassword", "too easy to guess"),
        ("bob", &["--role", "robot"], PASSWORD, "cannot have the role robot"),
        ("bob", &["--role", "viewer"], PASSWORD, "--service"),
        ("b b", &["--role", "admin"], PASSWORD, "is not a valid name"),
        ("local", &["--role", "admin"], PASSWORD, "is a reserved name"),
        ("alice", &["--role", "admin"], PASSWORD, "already"),
    ] {
        creates(name, role, password)?.expect_failure(&[words])?;
    }
    let token = ["token", "create", "alice", "--role", "admin"];
    daemon.deployer().run(&token)?.expect_failure(&["already"])?;
    // The response for an unknown name is the same.
    let wrong = request_sign_in(&daemon, "alice", OTHER_PASSWORD, &[])?;
    let unknown = request_sign_in(&daemon, "nobody", OTHER_PASSWORD, &[])?;
    ensure!(wrong.0 == 401 && wrong.2 == unknown.2, "{wrong:?} {unknown:?}");
    let long = "x".repeat(1025);
    for (body, status) in [
        (json!({"name": "x".repeat(65), "password": PASSWORD}).to_string(), 400),
        (json!({"name": "alice", "password": long}).to_string(), 400),
        (json!({"name": "alice"}).to_string(), 400),
        (json!({"name": "alice", "password": PASSWORD, "role": "admin"}).to_string(), 400),
        ("{\"name\": \"alice\"".to_owned(), 400),
        (String::new(), 400),
        ("x".repeat(17 << 10), 413),
    ] {
        let (found, _, said) = daemon.request_with_body("POST", PATH, &[], &body)?;
        ensure!(found == status && !said.contains(PASSWORD), "{found} {said}");
    }
    // Another site cannot sign a user in.
    let evil = [("Origin", "https://evil.example")];
    let (status, _, body) = request_sign_in(&daemon, "alice", PASSWORD, &evil)?;
    ensure!(status == 403, "{status} {body}");
    // Users without access cannot sign in.
    daemon.deployer().run(&["account", "disable", "alice"])?.expect_success()?;
    let disabled = request_sign_in(&daemon, "alice", PASSWORD, &[])?;
    ensure!(disabled.0 == 401 && disabled.2 == wrong.2, "{disabled:?}");
    daemon.deployer().run(&["account", "enable", "alice"])?.expect_success()?;
    SignedInBrowser::sign_in(&daemon, "alice", PASSWORD)?;
    run_account(&daemon, &["passwd", "alice"], OTHER_PASSWORD)?.expect_success()?;
    ensure!(request_sign_in(&daemon, "alice", PASSWORD, &[])?.0 == 401);
    SignedInBrowser::sign_in(&daemon, "alice", OTHER_PASSWORD)?;
    daemon.deployer().run(&["account", "remove", "alice"])?.expect_success()?;
    ensure!(request_sign_in(&daemon, "alice", OTHER_PASSWORD, &[])?.0 == 401);
    ensure!(daemon.get("/api/v1/services")?.0 == 401, "the door does not open again");
    for verb in ["remove", "disable", "enable"] {
        let typed = daemon.deployer().run(&["account", verb, "alice"])?;
        typed.expect_failure(&["there is no account", "account list"])?;
    }
    Ok(())
}

pub fn who_guesses_passwords_is_slowed() -> Verdict {
    let daemon = world().setup("people-guessed").start()?;
    run_account(&daemon, &["create", "alice", "--role", "operator"], PASSWORD)?.expect_success()?;
    let alice = SignedInBrowser::sign_in(&daemon, "alice", PASSWORD)?;
    // Each wrong attempt doubles the waiting time: however slow this machine is, one comes too early.
    wait_until("who guesses to be slowed", || {
        let (status, head, body) = request_sign_in(&daemon, "alice", OTHER_PASSWORD, &[])?;
        ensure!(status == 401 || status == 429, "{status} {body}");
        Ok(match status {
            429 if head.to_ascii_lowercase().contains("retry-after") => Ok(()),
            _ => Err(body),
        })
    })?;
    let metrics = alice.request("GET", "/metrics")?;
    ensure!(
        metrics.0 == 200 && metrics.1.contains("cloudroid_refused_passwords_total{why=\"wrong\"}"),
        "who is signed in stays so: {metrics:?}"
    );
    Ok(())
}

pub fn other_sites_pages_do_nothing_in_a_persons_browser() -> Verdict {
    let daemon = world().setup("people-sites").start()?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    run_account(&daemon, &["create", "alice", "--role", "operator"], PASSWORD)?.expect_success()?;
    run_account(&daemon, &["create", "bob", "--role", "operator"], PASSWORD)?.expect_success()?;
    let alice = SignedInBrowser::sign_in(&daemon, "alice", PASSWORD)?;
    let bob = SignedInBrowser::sign_in(&daemon, "bob", PASSWORD)?;
    let (own, token) = (("Origin", &*alice.origin), ("X-CSRF-Token", &*alice.csrf));
    let stop = "/api/v1/services/none";
    for headers in [
        &[][..],
        &[own],
        &[token],
        &[("Origin", "https://evil.example"), token],
        &[("Origin", "null"), token],
        &[own, ("X-CSRF-Token", &bob.csrf)],
        &[own, ("X-CSRF-Token", "")],
        &[("Sec-Fetch-Site", "same-site"), token],
        &[own, ("Sec-Fetch-Site", "cross-site"), token],
    ] {
        let (status, body) = alice.request_with_headers("DELETE", stop, headers)?;
        ensure!(status == 403, "{headers:?}: {status} {body}");
    }
    let (status, body) = alice.request("DELETE", stop)?;
    ensure!(status == 404, "{status} {body}");
    // Two cookies are not accepted.
    let both = format!("{}; {}", alice.cookie, bob.cookie);
    let (status, body) = daemon.request("GET", "/api/v1/services", &[("Cookie", &both)])?;
    ensure!(status == 400 && body.contains("twice"), "{status} {body}");
    // A token is sufficient by itself, whatever the browser adds.
    let secret = deployer.run_json(&["token", "create", "tool", "--role", "operator"])?;
    let bearer = format!("Bearer {}", secret["secret"].as_str().context("a secret")?);
    let (status, body) = alice.request_with_headers("DELETE", stop, &[("Authorization", &bearer)])?;
    ensure!(status == 404, "{status} {body}");
    // The WebSocket of another page is refused in the handshake.
    let url = daemon.url("adder_py?robot=r1");
    let shown = ("Cookie", &*alice.cookie);
    for headers in [&[shown][..], &[shown, ("Origin", "https://evil.example")], &[shown, ("Origin", "null")]] {
        let Err(refusal) = Robot::try_connect_with_headers(&url, headers) else {
            bail!("a page of another site was let in: {headers:?}");
        };
        ensure!(refusal.status == 403, "{headers:?}: {refusal}");
    }
    let connects = |browser: &SignedInBrowser<'_>, robot: &str| {
        let headers = [("Cookie", &*browser.cookie), ("Origin", &*browser.origin)];
        let url = daemon.url(&format!("adder_py?robot={robot}"));
        Robot::try_connect_with_headers(&url, &headers).map_err(|refusal| anyhow::anyhow!("{refusal}"))
    };
    let mut page = connects(&alice, "r1")?;
    let mut beside = connects(&bob, "r2")?;
    for robot in [&mut page, &mut beside] {
        ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    }
    // When the role changes, connections opened with the old one end at once.
    deployer.run(&["account", "role", "alice", "viewer", "--service", "*"])?.expect_success()?;
    let close = page.wait_for_close()?;
    ensure!(u16::from(close.code) == 1008 && close.reason.contains("session"), "{close:?}");
    ensure!(!alice.is_signed_in()?, "in another role");
    ensure!(beside.call("/add_two", json!({"a": 2, "b": 2}))?["values"]["sum"] == 4);
    deployer.run(&["account", "logout", "bob"])?.expect_success()?;
    ensure!(u16::from(beside.wait_for_close()?.code) == 1008 && !bob.is_signed_in()?);
    Ok(())
}

pub fn through_tls_the_cookie_is_shown_through_tls_alone() -> Verdict {
    let daemon = world().setup("people-tls").config("[tls]\nserve = \"tls\"\n").start()?;
    run_account(&daemon, &["create", "alice", "--role", "operator"], PASSWORD)?.expect_success()?;
    let port = daemon.address.rsplit(':').next().context("a port")?;
    let site = format!("https://localhost:{port}");
    let own = daemon.home.join("tls/own.pem");
    let asks = |more: &[&str], path: &str| {
        run(Command::new("curl")
            .args(["--silent", "--show-error", "--include", "--max-time"])
            .arg(patience().as_secs().to_string())
            .args(["--cacert", path_str(&own)])
            .args(more)
            .arg(format!("{site}{path}")))?
        .expect_success()
    };
    let body = json!({"name": "alice", "password": PASSWORD}).to_string();
    let origin = format!("Origin: {site}");
    let said = asks(&["-H", &origin, "--data", &body], PATH)?.stdout;
    let (cookie, rest) = set_cookie(&said.replace('\r', ""))?;
    ensure!(cookie.starts_with("__Host-cloudroid=") && rest.contains("Secure"), "{cookie} {rest}");
    let known = asks(&["--cookie", &cookie], "/api/v1/whoami")?.stdout;
    ensure!(known.contains("alice"), "{known}");
    // Without the `__Host-` prefix anyone in the network could have set it.
    let plain = cookie.replace("__Host-", "");
    let refused = asks(&["--cookie", &plain], "/api/v1/whoami")?.stdout;
    ensure!(refused.contains(" 401 "), "{refused}");
    // The plain-text site is another origin.
    let origin = format!("Origin: http://localhost:{port}");
    let refused = asks(&["-H", &origin, "--data", &body], PATH)?.stdout;
    ensure!(refused.contains(" 403 "), "{refused}");
    Ok(())
}
