//! The HTTP API beside its description, as a program sees it that nobody here wrote.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::{path_str, run};
use support::patience::patience;
use support::robot::Robot;
use support::world::{ADDER, world};
use support::{Verdict, binaries};

use crate::access::token;

/// What is wrong anywhere: an answer of 500 and above, or a status, type or value that the document does not have.
const CHECKS: &str = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance";
/// Between two requests of a robot at work.
const PAUSE: Duration = Duration::from_secs(1);
/// Of the one who can sign in.
const PASSWORD: &str = "four words of no sense";
const NDJSON: &str = "application/x-ndjson";
/// Two go on for as long as somebody listens, whatever is asked; the third is the document, with which Schemathesis begins.
const APART: &[&str] = &["stream", "followEvents", "openapi"];
/// These do so for a servant or a service that there is, or become a WebSocket.
const ASKED_HERE: &[&str] = &["inside", "shadow", "topics"];
/// What all others need: asked last, in this order.
const LAST: &[&str] = &["stopServants", "removeService"];
/// Operations that do nothing here, and why.
const NOT_DONE: &[(&str, &str)] = &[
    ("beginPairing", "robots are paired through TLS"),
    ("pair", "the same"),
    ("renew", "the same"),
    ("unpair", "no robot is paired"),
    ("cancelPairing", "no code waits"),
    ("oidcLogin", "there is no identity provider"),
    ("oidcCallback", "the same"),
    ("signOut", "a token is no session"),
    ("trial", "the service listens to no topic"),
];

/// What was answered to each operation, and how often.
type Answers = BTreeMap<String, BTreeMap<u16, usize>>;

/// What is asked about.
struct Scene {
    daemon: Daemon,
    admin: String,
    place: PathBuf,
    names: Value,
    spare: Value,
}

impl Scene {
    /// With two robots at work, and all else that has a name.
    fn new(daemon: Daemon, place: &Path) -> anyhow::Result<(Scene, [Robot; 2])> {
        let deployer = daemon.deployer();
        deployer.pushes("adder_py", ADDER.arguments)?.succeeded()?;
        let admin = token(&daemon, &["chief", "--role", "admin"])?;
        let connect = |name: &str| -> anyhow::Result<(Robot, String)> {
            let path = format!("adder_py?robot={name}&token={admin}");
            let mut robot = daemon.robot(&path)?;
            robot.calls("/add_two", json!({"a": 1, "b": 2}))?;
            let servant = daemon.servant_of("adder_py", name)?;
            Ok((robot, servant["id"].as_str().context("an id")?.to_owned()))
        };
        let (rover, servant) = connect("rover")?;
        let (other, spare) = connect("spare")?;
        let take = || -> anyhow::Result<String> {
            let bearer = format!("Bearer {admin}");
            let headers = [("Authorization", bearer.as_str())];
            let path = format!("/api/v1/servants/{servant}/recording");
            support::until("a recording", || {
                let (status, _, body) = daemon.sends("POST", &path, &headers, "")?;
                let taken: Value = serde_json::from_str(&body)?;
                Ok(match status {
                    200 => Ok(taken["number"].to_string()),
                    _ => Err(body),
                })
            })
        };
        let (recording, recording_to_remove) = (take()?, take()?);
        let scene = Scene {
            names: json!({
                "services": ["adder_py"],
                "servants": [servant],
                "robots": ["rover"],
                "recordings": [recording],
            }),
            spare: json!({"servants": [spare], "recordings": [recording_to_remove]}),
            daemon,
            admin,
            place: place.to_owned(),
        };
        scene.makes_person()?;
        Ok((scene, [rover, other]))
    }

    /// Somebody who can sign in.
    fn makes_person(&self) -> Verdict {
        let person = json!({"name": "person", "password": PASSWORD, "role": "operator"});
        let bearer = format!("Bearer {}", self.admin);
        let headers = [("Authorization", bearer.as_str())];
        let (status, _, body) =
            self.daemon
                .sends("POST", "/api/v1/accounts", &headers, &person.to_string())?;
        ensure!(status == 200, "{status} {body}");
        Ok(())
    }

    /// Where answers stand, a line each.
    fn told(&self) -> PathBuf {
        self.place.join("answers")
    }

    /// Has Schemathesis ask, with this token; gives how many operations it asked.
    fn asked(&self, bearer: &str, last: bool, arguments: &[&str]) -> anyhow::Result<usize> {
        let given = json!({
            "names": self.names, "spare": self.spare, "person": "person", "password": PASSWORD, "last": last,
            "answers": path_str(&self.told()),
        });
        let mut schemathesis = Command::new(binaries::readers().join("schemathesis"));
        schemathesis
            .current_dir(&self.place)
            .env("PYTHONPATH", binaries::checkout().join("tests/readers"))
            .env("SCHEMATHESIS_HOOKS", "hooks")
            .env("DESCRIBED", given.to_string())
            .args(["--no-color", "run"])
            .arg(format!(
                "http://{}/api/v1/openapi.json",
                self.daemon.address
            ))
            .args(["--header", &format!("Authorization: Bearer {bearer}")])
            .args(["--checks", CHECKS, "--phases", "examples,coverage,fuzzing"])
            .args(["--seed", "1", "--continue-on-failure"])
            .args(["--request-timeout", &patience().as_secs().to_string()])
            .args(["--generation-database", "none", "--warnings", "off"])
            .args(arguments);
        let said = run(&mut schemathesis)?.succeeded()?.stdout;
        let tested = said
            .lines()
            .find_map(|line| line.trim().strip_prefix("Tested: "));
        Ok(tested.context("a count")?.trim().parse()?)
    }

    /// All that was answered until now.
    fn answers(&self) -> anyhow::Result<Answers> {
        let mut answers = Answers::new();
        for line in fs::read_to_string(self.told())?.lines() {
            let line: Value = serde_json::from_str(line)?;
            let operation = line["operation"].as_str().context("an operation")?;
            let status = u16::try_from(line["status"].as_u64().context("a status")?)?;
            let counted = answers.entry(operation.to_owned()).or_default();
            *counted.entry(status).or_default() += 1;
        }
        Ok(answers)
    }

    /// What goes on without an end begins as the document says.
    fn begins(&self, path: &str, media: &str, more: &[&str]) -> Verdict {
        let mut curl = Command::new("curl")
            .args(["--silent", "--show-error", "--no-buffer", "--include"])
            .args(["--max-time", &patience().as_secs().to_string()])
            .args(["--header", &format!("Authorization: Bearer {}", self.admin)])
            .args(more)
            .arg(format!("http://{}{path}", self.daemon.address))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()?;
        let mut out = BufReader::new(curl.stdout.take().context("piped")?);
        let mut head = String::new();
        // An empty line ends it; nobody waits for what follows.
        while out.read_line(&mut head)? > 2 {}
        curl.kill()?;
        curl.wait()?;
        let head = head.to_lowercase();
        let is_begun = head.starts_with("http/1.1 200") && head.contains(media);
        ensure!(is_begun, "{path}: {head}");
        Ok(())
    }

    /// Asks what Schemathesis would wait for, or has no protocol for.
    fn begins_what_goes_on(&self) -> Verdict {
        let servant = self.names["servants"][0].as_str().context("an id")?;
        let topics = format!("/api/v1/servants/{servant}/topics");
        self.begins("/api/v1/stream", "text/event-stream", &[])?;
        self.begins("/api/v1/events/follow", NDJSON, &[])?;
        self.begins(&topics, NDJSON, &[])?;
        let options = json!({"revision": 1, "robot": "nobody"}).to_string();
        let shadow = "/api/v1/services/adder_py/shadow";
        self.begins(shadow, NDJSON, &["--data", &options])?;
        let inside = format!("api/v1/servants/{servant}/inside?token={}", self.admin);
        self.daemon.robot(&inside)?.leaves()
    }

    /// All of them, by a viewer and by an admin, and last what ends what the others are about.
    fn asks_everything(&self) -> Verdict {
        let looks = ["looks", "--role", "viewer", "--service", "*"];
        let viewer = token(&self.daemon, &looks)?;
        let mut later: Vec<&str> = Vec::new();
        for id in APART.iter().chain(LAST) {
            later.extend(["--exclude-operation-id", id]);
        }
        for (who, bearer, most) in [("viewer", &viewer, "1"), ("admin", &self.admin, "5")] {
            let arguments = [&["--max-examples", most], &*later].concat();
            let tested = self.asked(bearer, false, &arguments);
            let tested = tested.with_context(|| who.to_owned())?;
            ensure!(tested > 50, "{who}: {tested} operations");
        }
        self.begins_what_goes_on()?;
        for id in LAST {
            let arguments = ["--max-examples", "4", "--include-operation-id", id];
            self.asked(&self.admin, true, &arguments).context(*id)?;
        }
        Ok(())
    }

    /// Compares what was answered with what the document says of each operation.
    fn judged(&self) -> Verdict {
        let (described, answers) = (described(&self.daemon)?, self.answers()?);
        let not_done: Vec<&str> = NOT_DONE.iter().map(|(id, _)| *id).collect();
        for id in not_done.iter().chain(ASKED_HERE).chain(APART) {
            ensure!(described.contains_key(*id), "there is no operation {id}");
        }
        let (mut nothing, mut refused) = (Vec::new(), Vec::new());
        for (id, statuses) in &described {
            let of = answers.get(id);
            let all = || of.into_iter().flat_map(BTreeMap::keys);
            if !APART.contains(&id.as_str()) && !all().any(|status| statuses.contains(status)) {
                nothing.push(id);
            }
            let is_done = all().any(|status| (200..300).contains(status));
            let elsewhere = [APART, ASKED_HERE, &not_done].concat();
            if !is_done && !elsewhere.contains(&id.as_str()) {
                refused.push((id, of));
            }
        }
        ensure!(nothing.is_empty(), "nothing was answered to {nothing:?}");
        ensure!(refused.is_empty(), "only refused: {refused:?}");
        Ok(())
    }
}

/// Statuses that the document has of each operation.
fn described(daemon: &Daemon) -> anyhow::Result<BTreeMap<String, BTreeSet<u16>>> {
    let document = daemon.api("/api/v1/openapi.json")?;
    let mut described = BTreeMap::new();
    let paths = document["paths"].as_object().context("paths")?;
    for operation in paths
        .values()
        .flat_map(|item| item.as_object().into_iter().flatten())
        .map(|(_, operation)| operation)
    {
        let id = operation["operationId"].as_str().context("an id")?;
        let statuses = operation["responses"].as_object().context("responses")?;
        let statuses = statuses.keys().map(|status| Ok(status.parse()?));
        described.insert(id.to_owned(), statuses.collect::<anyhow::Result<_>>()?);
    }
    Ok(described)
}

/// Keeps a robot at work until all is over: a daemon lets those go that are silent.
fn works(mut robot: Robot, over: &AtomicBool) {
    // It ends when its servant does.
    while !over.load(Ordering::Relaxed) && robot.calls("/add_two", json!({"a": 1, "b": 2})).is_ok()
    {
        thread::sleep(PAUSE);
    }
}

pub fn every_answer_is_as_the_document_says() -> Verdict {
    let black_box = "[black_box]\nseconds = \"5s\"\n";
    let daemon = world().own("described").config(black_box).start()?;
    let place = world().directory("described")?;
    let (scene, robots) = Scene::new(daemon, place.path())?;
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        for robot in robots {
            scope.spawn(|| works(robot, &over));
        }
        let asked = scene.asks_everything();
        over.store(true, Ordering::Relaxed);
        asked
    })?;
    scene.judged()?;
    // It was not turned away half-way.
    let bearer = format!("Bearer {}", scene.admin);
    let showing = [("Authorization", bearer.as_str())];
    let (status, _) = scene.daemon.request("GET", "/api/v1/status", &showing)?;
    ensure!(status == 200, "{status}");
    Ok(())
}
