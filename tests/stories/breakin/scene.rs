//! A working server, its state, and attempts that must not change the state.

use std::cell::Cell;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::{TELLER, world};

use crate::access::{create_token, push_adder};
use crate::people;

/// Texts that must not occur in the response to any attempt.
const SECRETS: [&str; 3] = ["SQLite format", "PRIVATE KEY", "root:"];

/// Number of attempts after which the state is compared.
const TOGETHER: usize = 25;

/// Tokens of the principals.
pub struct SceneTokens {
    pub admin: String,
    pub operator: String,
    /// The deployer who owns `adder_py`.
    pub alice: String,
    /// A deployer without services.
    pub bob: String,
    /// Robot r1 at `adder_py`.
    pub rover: String,
    /// Robot r2 at `adder_py`.
    pub other: String,
    /// Robot r3 at `adder_py`, which may only subscribe to `/rosout`.
    pub narrow: String,
    /// A viewer of `adder*`.
    pub eve: String,
    /// A viewer of everything.
    pub oscar: String,
    /// A revoked token.
    pub over: String,
}

/// The server: `adder_py` with the working robots r1 and r2, and `vault` with r9, to which none of the attacking
/// principals has access.
pub struct BreakinScene {
    pub daemon: Daemon,
    pub tokens: SceneTokens,
    /// Servants of r1 and r2 at `adder_py`, and of r9 at `vault`.
    pub servants: [String; 3],
    /// Digest of the image of `vault`.
    pub image: String,
    at_work: Vec<Robot>,
    tried: Cell<usize>,
}

/// A request, with the acceptable statuses of its response.
pub struct RequestAttempt<'a> {
    pub method: &'a str,
    pub path: String,
    pub headers: Vec<(&'a str, String)>,
    pub body: String,
    pub status: &'a [u16],
}

impl<'a> RequestAttempt<'a> {
    pub fn new(method: &'a str, path: impl Into<String>, status: &'a [u16]) -> Self {
        RequestAttempt { method, path: path.into(), headers: Vec::new(), body: String::new(), status }
    }

    pub fn body(mut self, body: impl ToString) -> Self {
        self.body = body.to_string();
        self
    }

    pub fn header(mut self, name: &'a str, value: impl Into<String>) -> Self {
        self.headers.push((name, value.into()));
        self
    }

    pub fn bearer(self, token: &str) -> Self {
        self.header("Authorization", format!("Bearer {token}"))
    }
}

/// Keeps those fields of a list's entries that reading requests do not change.
fn without_volatile(list: &Value, keys: &[&str]) -> Value {
    let entries = list.as_array().cloned().unwrap_or_default();
    let kept = entries.into_iter().map(|mut entry| {
        if let Some(entry) = entry.as_object_mut() {
            entry.retain(|key, _| keys.contains(&key.as_str()));
        }
        entry
    });
    Value::Array(kept.collect())
}

/// Returns the state of the server: services with their revisions and dictionaries, servants with their limits, and
/// access control.
pub fn server_state(daemon: &Daemon) -> anyhow::Result<Value> {
    let mut services = Vec::new();
    for service in daemon.api("/api/v1/services")?.as_array().context("a list")? {
        let name = service["name"].as_str().context("a name")?;
        let detail = daemon.api(&format!("/api/v1/services/{name}"))?;
        let rows = daemon.api(&format!("/api/v1/services/{name}/sla"))?;
        services.push(json!([name, detail["revisions"], rows]));
    }
    let all = |path: &str, keys: &[&str]| Ok::<_, anyhow::Error>(without_volatile(&daemon.api(path)?, keys));
    Ok(json!({
        "services": services,
        "servants": all("/api/v1/servants", &["id", "service", "robot", "limits"])?,
        "tokens": all("/api/v1/tokens", &["name", "role", "services", "robot", "classes", "expires", "revoked"])?,
        "accounts": all("/api/v1/accounts", &["name", "role", "services", "disabled", "sessions"])?,
        "pairings": all("/api/v1/pairings", &["robot", "services", "state"])?,
        "policy": daemon.api("/api/v1/policy")?,
    }))
}

impl BreakinScene {
    pub fn new(name: &str) -> anyhow::Result<BreakinScene> {
        let daemon = world().setup(name).start()?;
        let made = |words: &[&str]| create_token(&daemon, words);
        let robot = |name: &str, robot: &str, services: &str| {
            made(&[name, "--role", "robot", "--robot", robot, "--service", services])
        };
        let scoped = |name: &str, role: &str, services: &str| made(&[name, "--role", role, "--service", services]);
        let tokens = SceneTokens {
            admin: made(&["chief", "--role", "admin"])?,
            operator: made(&["olga", "--role", "operator"])?,
            alice: scoped("alice", "deployer", "adder*")?,
            bob: scoped("bob", "deployer", "*")?,
            rover: robot("rover", "r1", "adder_py")?,
            other: robot("other", "r2", "adder_py")?,
            narrow: robot("narrow", "r3", "adder_py")?,
            eve: scoped("eve", "viewer", "adder*")?,
            oscar: scoped("oscar", "viewer", "*")?,
            over: made(&["over", "--role", "admin"])?,
        };
        let keeper = robot("keeper", "r9", "vault")?;
        let deployer = daemon.deployer();
        for typed in [&["token", "revoke", "over"][..], &["policy", "allow", "narrow", "subscribe:/rosout"]] {
            deployer.run(typed)?.expect_success()?;
        }
        push_adder(&daemon, &tokens.alice, &[])?.expect_success()?;
        let vault = [&["--name", "vault"], TELLER.arguments].concat();
        deployer.push(TELLER.name, &vault)?.expect_success()?;
        people::run_account(&daemon, &["create", "carol", "--role", "operator"], people::PASSWORD)?.expect_success()?;
        let mut at_work = Vec::new();
        for (service, token) in [("adder_py", &tokens.rover), ("adder_py", &tokens.other), ("vault", &keeper)] {
            let mut robot = daemon.robot(&format!("{service}?token={token}"))?;
            robot.call("/rosapi/get_time", json!({}))?;
            at_work.push(robot);
        }
        let servant = |service: &str, robot: &str| {
            let servant = daemon.servant_of(service, robot)?;
            Ok::<_, anyhow::Error>(servant["id"].as_str().context("an id")?.to_owned())
        };
        let servants = [servant("adder_py", "r1")?, servant("adder_py", "r2")?, servant("vault", "r9")?];
        let vault = daemon.api("/api/v1/services/vault")?;
        let image = vault["revisions"][0]["image"].as_str().context("an image")?;
        Ok(BreakinScene { image: image.to_owned(), daemon, tokens, servants, at_work, tried: Cell::new(0) })
    }

    /// Returns the number of attempts so far.
    pub fn attempt_count(&self) -> usize {
        self.tried.get()
    }

    pub fn count_attempt(&self) {
        self.tried.set(self.tried.get() + 1);
    }

    /// Makes attempts as a principal; checks the status of each response, and that it contains no information that is
    /// kept from the principal.
    pub fn all_fail(
        &self,
        who: &str,
        token: Option<&str>,
        kept: &[&str],
        attempts: Vec<RequestAttempt<'_>>,
    ) -> anyhow::Result<()> {
        let before = server_state(&self.daemon)?;
        let mut since = Vec::new();
        for attempt in attempts {
            let mut headers: Vec<(&str, &str)> =
                attempt.headers.iter().map(|(name, value)| (*name, value.as_str())).collect();
            let bearer = token.map(|token| format!("Bearer {token}"));
            if let Some(bearer) = &bearer {
                headers.insert(0, ("Authorization", bearer));
            }
            let what = format!("{who}: {} {} {:?}", attempt.method, attempt.path, attempt.headers);
            let (status, head, body) = self
                .daemon
                .request_with_body(attempt.method, &attempt.path, &headers, &attempt.body)
                .with_context(|| what.clone())?;
            ensure!(attempt.status.contains(&status), "{what} was answered with {status}: {body}");
            for secret in SECRETS.iter().chain(kept) {
                // The refusal may repeat the request.
                let told = (head.clone() + &body).replace(&attempt.path, "");
                ensure!(attempt.path.contains(secret) || !told.contains(secret), "{what} was told {secret}: {body}");
            }
            since.push(what);
            // Reading the state takes longer than an attempt.
            if since.len() == TOGETHER {
                self.expect_unchanged(&before, &mut since)?;
            }
            self.count_attempt();
        }
        self.expect_unchanged(&before, &mut since)
    }

    /// Fails if the state differs from that before these attempts.
    fn expect_unchanged(&self, before: &Value, since: &mut Vec<String>) -> anyhow::Result<()> {
        let after = server_state(&self.daemon)?;
        ensure!(after == *before, "one of {since:#?} changed {before:#} into {after:#}");
        since.clear();
        Ok(())
    }

    /// Checks that the robots are still working.
    pub fn expect_robots_working(&mut self) -> anyhow::Result<()> {
        for robot in &mut self.at_work {
            let answer = robot.call("/rosapi/get_time", json!({}))?;
            ensure!(answer["result"] == true, "{answer}");
        }
        Ok(())
    }
}
