//! A server at work, what it holds, and attempts that must leave it as it was.

use std::cell::Cell;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::{TELLER, world};

use crate::access::{pushes_adder, token};
use crate::people;

/// What an attempt must not be told, whoever makes it.
const SECRETS: [&str; 3] = ["SQLite format", "PRIVATE KEY", "root:"];

/// Attempts after which it is looked whether something has changed.
const TOGETHER: usize = 25;

/// Who has a token.
pub struct Tokens {
    pub admin: String,
    pub operator: String,
    /// `adder_py` is hers.
    pub alice: String,
    /// A deployer of what is nobody's yet.
    pub bob: String,
    /// Robot r1 at `adder_py`.
    pub rover: String,
    /// Robot r2 at `adder_py`.
    pub other: String,
    /// Robot r3 at `adder_py`, which may only listen to `/rosout`.
    pub narrow: String,
    /// A viewer of `adder*`.
    pub eve: String,
    /// A viewer of everything.
    pub oscar: String,
    /// Revoked.
    pub over: String,
}

/// The server: `adder_py` with the robots r1 and r2 at work, and `vault`, which concerns none of those who try, with r9.
pub struct Scene {
    pub daemon: Daemon,
    pub tokens: Tokens,
    /// Servants of r1 and r2 at `adder_py`, and of r9 at `vault`.
    pub servants: [String; 3],
    /// The image of `vault`, by its digest.
    pub image: String,
    at_work: Vec<Robot>,
    tried: Cell<usize>,
}

/// One request: what it is, and with which statuses it may be answered.
pub struct Attempt<'a> {
    pub method: &'a str,
    pub path: String,
    pub headers: Vec<(&'a str, String)>,
    pub body: String,
    pub status: &'a [u16],
}

impl<'a> Attempt<'a> {
    pub fn new(method: &'a str, path: impl Into<String>, status: &'a [u16]) -> Self {
        Attempt {
            method,
            path: path.into(),
            headers: Vec::new(),
            body: String::new(),
            status,
        }
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

/// Keeps of each entry of a list what no request that only reads changes.
fn lasting(list: &Value, keys: &[&str]) -> Value {
    let entries = list.as_array().cloned().unwrap_or_default();
    let kept = entries.into_iter().map(|mut entry| {
        if let Some(entry) = entry.as_object_mut() {
            entry.retain(|key, _| keys.contains(&key.as_str()));
        }
        entry
    });
    Value::Array(kept.collect())
}

/// What the server holds: services with their revisions and dictionaries, servants with their limits, and who may do what.
pub fn state(daemon: &Daemon) -> anyhow::Result<Value> {
    let mut services = Vec::new();
    for service in daemon
        .api("/api/v1/services")?
        .as_array()
        .context("a list")?
    {
        let name = service["name"].as_str().context("a name")?;
        let detail = daemon.api(&format!("/api/v1/services/{name}"))?;
        let rows = daemon.api(&format!("/api/v1/services/{name}/sla"))?;
        services.push(json!([name, detail["revisions"], rows]));
    }
    let all = |path: &str, keys: &[&str]| Ok::<_, anyhow::Error>(lasting(&daemon.api(path)?, keys));
    Ok(json!({
        "services": services,
        "servants": all("/api/v1/servants", &["id", "service", "robot", "limits"])?,
        "tokens": all("/api/v1/tokens", &["name", "role", "services", "robot", "classes", "expires", "revoked"])?,
        "accounts": all("/api/v1/accounts", &["name", "role", "services", "disabled", "sessions"])?,
        "pairings": all("/api/v1/pairings", &["robot", "services", "state"])?,
        "policy": daemon.api("/api/v1/policy")?,
    }))
}

impl Scene {
    pub fn new(name: &str) -> anyhow::Result<Scene> {
        let daemon = world().own(name).start()?;
        let made = |words: &[&str]| token(&daemon, words);
        let robot = |name: &str, robot: &str, services: &str| {
            made(&[
                name,
                "--role",
                "robot",
                "--robot",
                robot,
                "--service",
                services,
            ])
        };
        let scoped = |name: &str, role: &str, services: &str| {
            made(&[name, "--role", role, "--service", services])
        };
        let tokens = Tokens {
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
        for typed in [
            &["token", "revoke", "over"][..],
            &["policy", "allow", "narrow", "subscribe:/rosout"],
        ] {
            deployer.types(typed)?.succeeded()?;
        }
        pushes_adder(&daemon, &tokens.alice, &[])?.succeeded()?;
        let vault = [&["--name", "vault"], TELLER.arguments].concat();
        deployer.pushes(TELLER.name, &vault)?.succeeded()?;
        people::account(
            &daemon,
            &["create", "carol", "--role", "operator"],
            people::PASSWORD,
        )?
        .succeeded()?;
        let mut at_work = Vec::new();
        for (service, token) in [
            ("adder_py", &tokens.rover),
            ("adder_py", &tokens.other),
            ("vault", &keeper),
        ] {
            let mut robot = daemon.robot(&format!("{service}?token={token}"))?;
            robot.calls("/rosapi/get_time", json!({}))?;
            at_work.push(robot);
        }
        let servant = |service: &str, robot: &str| {
            let servant = daemon.servant_of(service, robot)?;
            Ok::<_, anyhow::Error>(servant["id"].as_str().context("an id")?.to_owned())
        };
        let servants = [
            servant("adder_py", "r1")?,
            servant("adder_py", "r2")?,
            servant("vault", "r9")?,
        ];
        let vault = daemon.api("/api/v1/services/vault")?;
        let image = vault["revisions"][0]["image"]
            .as_str()
            .context("an image")?;
        Ok(Scene {
            image: image.to_owned(),
            daemon,
            tokens,
            servants,
            at_work,
            tried: Cell::new(0),
        })
    }

    /// How many attempts were made.
    pub fn tried(&self) -> usize {
        self.tried.get()
    }

    pub fn counts(&self) {
        self.tried.set(self.tried.get() + 1);
    }

    /// Makes attempts as somebody; each is answered as it says, and tells nothing of what is kept from them.
    pub fn all_fail(
        &self,
        who: &str,
        token: Option<&str>,
        kept: &[&str],
        attempts: Vec<Attempt<'_>>,
    ) -> anyhow::Result<()> {
        let before = state(&self.daemon)?;
        let mut since = Vec::new();
        for attempt in attempts {
            let mut headers: Vec<(&str, &str)> = attempt
                .headers
                .iter()
                .map(|(name, value)| (*name, value.as_str()))
                .collect();
            let bearer = token.map(|token| format!("Bearer {token}"));
            if let Some(bearer) = &bearer {
                headers.insert(0, ("Authorization", bearer));
            }
            let what = format!(
                "{who}: {} {} {:?}",
                attempt.method, attempt.path, attempt.headers
            );
            let (status, head, body) = self
                .daemon
                .sends(attempt.method, &attempt.path, &headers, &attempt.body)
                .with_context(|| what.clone())?;
            ensure!(
                attempt.status.contains(&status),
                "{what} was answered with {status}: {body}"
            );
            for secret in SECRETS.iter().chain(kept) {
                // What was asked for stands in the refusal.
                let told = (head.clone() + &body).replace(&attempt.path, "");
                ensure!(
                    attempt.path.contains(secret) || !told.contains(secret),
                    "{what} was told {secret}: {body}"
                );
            }
            since.push(what);
            // What is held takes longer to tell than what is tried.
            if since.len() == TOGETHER {
                self.is_as(&before, &mut since)?;
            }
            self.counts();
        }
        self.is_as(&before, &mut since)
    }

    /// Refuses a state other than that before these attempts.
    fn is_as(&self, before: &Value, since: &mut Vec<String>) -> anyhow::Result<()> {
        let after = state(&self.daemon)?;
        ensure!(
            after == *before,
            "one of {since:#?} changed {before:#} into {after:#}"
        );
        since.clear();
        Ok(())
    }

    /// The robots that were at work still are.
    pub fn goes_on(&mut self) -> anyhow::Result<()> {
        for robot in &mut self.at_work {
            let answer = robot.calls("/rosapi/get_time", json!({}))?;
            ensure!(answer["result"] == true, "{answer}");
        }
        Ok(())
    }
}
