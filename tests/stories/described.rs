//! The HTTP API compared with its OpenAPI description by an independent program.

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

use crate::access::create_token;

/// Checks for every response: no status of 500 or above, and no status, type or value that the document does not
/// contain.
const CHECKS: &str = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance";
/// Interval between the requests of a working robot.
const PAUSE: Duration = Duration::from_secs(1);
/// Password of the user who can sign in.
const PASSWORD: &str = "four words of no sense";
const NDJSON: &str = "application/x-ndjson";
/// Operations that run separately: two never end, whatever is requested; the third is the document, with which
/// Schemathesis starts; the last has hundreds of megabytes (see `bases`).
const APART: &[&str] = &["stream", "followEvents", "openapi", "exportBase"];
/// Operations that never end for an existing servant or service, or become a WebSocket.
const ASKED_HERE: &[&str] = &["exec", "inside", "shadow", "topics"];
/// Operations that remove what the others need: called last, in this order.
const LAST: &[&str] = &["stopServants", "removeService"];
/// Operations that do nothing here, with the reason.
const NOT_DONE: &[(&str, &str)] = &[
    ("beginPairing", "robots are paired over TLS"),
    ("pair", "the same"),
    ("renew", "the same"),
    ("unpair", "no robot is paired"),
    ("cancelPairing", "no code waits"),
    ("oidcLogin", "there is no identity provider"),
    ("oidcCallback", "the same"),
    ("signOut", "a token is no session"),
    ("trial", "the service listens to no topic"),
    ("cancelPush", "every push has ended"),
    ("importBase", "no base is sent"),
    ("makeBase", "no image is sent"),
    ("removeBase", "no base was imported"),
    ("removeUnderlay", "no underlay was pushed"),
];

/// Number of responses by operation and status.
type AnswerCounts = BTreeMap<String, BTreeMap<u16, usize>>;

/// Objects to which the operations refer.
struct ApiScene {
    daemon: Daemon,
    admin: String,
    place: PathBuf,
    names: Value,
    spare: Value,
}

impl ApiScene {
    /// Creates two working robots, and everything else that operations refer to by name.
    fn new(daemon: Daemon, place: &Path) -> anyhow::Result<(ApiScene, [Robot; 2])> {
        let deployer = daemon.deployer();
        deployer.push("adder_py", ADDER.arguments)?.expect_success()?;
        let admin = create_token(&daemon, &["chief", "--role", "admin"])?;
        let connect = |name: &str| -> anyhow::Result<(Robot, String)> {
            let path = format!("adder_py?robot={name}&token={admin}");
            let mut robot = daemon.robot(&path)?;
            robot.call("/add_two", json!({"a": 1, "b": 2}))?;
            let servant = daemon.servant_of("adder_py", name)?;
            Ok((robot, servant["id"].as_str().context("an id")?.to_owned()))
        };
        let (rover, servant) = connect("rover")?;
        let (other, spare) = connect("spare")?;
        let take = || -> anyhow::Result<String> {
            let bearer = format!("Bearer {admin}");
            let headers = [("Authorization", bearer.as_str())];
            let path = format!("/api/v1/servants/{servant}/recording");
            support::wait_until("a recording", || {
                let (status, _, body) = daemon.request_with_body("POST", &path, &headers, "")?;
                let taken: Value = serde_json::from_str(&body)?;
                Ok(match status {
                    200 => Ok(taken["number"].to_string()),
                    _ => Err(body),
                })
            })
        };
        let (recording, recording_to_remove) = (take()?, take()?);
        let scene = ApiScene {
            names: json!({
                "services": ["adder_py"],
                "bases": ["bookworm-ros1"],
                "pushes": ["1"],
                "servants": [servant],
                "robots": ["rover"],
                "recordings": [recording],
            }),
            spare: json!({"servants": [spare], "recordings": [recording_to_remove]}),
            daemon,
            admin,
            place: place.to_owned(),
        };
        scene.create_person()?;
        Ok((scene, [rover, other]))
    }

    /// Creates a user who can sign in.
    fn create_person(&self) -> Verdict {
        let person = json!({"name": "person", "password": PASSWORD, "role": "operator"});
        let bearer = format!("Bearer {}", self.admin);
        let headers = [("Authorization", bearer.as_str())];
        let (status, _, body) =
            self.daemon.request_with_body("POST", "/api/v1/accounts", &headers, &person.to_string())?;
        ensure!(status == 200, "{status} {body}");
        Ok(())
    }

    /// Returns the file of the responses, one per line.
    fn answers_path(&self) -> PathBuf {
        self.place.join("answers")
    }

    /// Runs Schemathesis with this token; returns the number of operations that it called.
    fn run_schemathesis(&self, bearer: &str, last: bool, arguments: &[&str]) -> anyhow::Result<usize> {
        let given = json!({
            "names": self.names, "spare": self.spare, "person": "person", "password": PASSWORD, "last": last,
            "answers": path_str(&self.answers_path()),
        });
        let mut schemathesis = Command::new(binaries::readers().join("schemathesis"));
        schemathesis
            .current_dir(&self.place)
            .env("PYTHONPATH", binaries::checkout().join("tests/readers"))
            .env("SCHEMATHESIS_HOOKS", "hooks")
            .env("DESCRIBED", given.to_string())
            .args(["--no-color", "run"])
            .arg(format!("http://{}/api/v1/openapi.json", self.daemon.address))
            .args(["--header", &format!("Authorization: Bearer {bearer}")])
            .args(["--checks", CHECKS, "--phases", "examples,coverage,fuzzing"])
            .args(["--seed", "1", "--continue-on-failure"])
            .args(["--request-timeout", &patience().as_secs().to_string()])
            .args(["--generation-database", "none", "--warnings", "off"])
            .args(arguments);
        let said = run(&mut schemathesis)?.expect_success()?.stdout;
        let tested = said.lines().find_map(|line| line.trim().strip_prefix("Tested: "));
        Ok(tested.context("a count")?.trim().parse()?)
    }

    /// Returns all responses so far.
    fn read_answers(&self) -> anyhow::Result<AnswerCounts> {
        let mut answers = AnswerCounts::new();
        for line in fs::read_to_string(self.answers_path())?.lines() {
            let line: Value = serde_json::from_str(line)?;
            let operation = line["operation"].as_str().context("an operation")?;
            let status = u16::try_from(line["status"].as_u64().context("a status")?)?;
            let counted = answers.entry(operation.to_owned()).or_default();
            *counted.entry(status).or_default() += 1;
        }
        Ok(answers)
    }

    /// Checks that a streaming response starts as described.
    fn expect_stream_starts(&self, path: &str, media: &str, more: &[&str]) -> Verdict {
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
        // The empty line ends the head; the rest is not read.
        while out.read_line(&mut head)? > 2 {}
        curl.kill()?;
        curl.wait()?;
        let head = head.to_lowercase();
        let is_begun = head.starts_with("http/1.1 200") && head.contains(media);
        ensure!(is_begun, "{path}: {head}");
        Ok(())
    }

    /// Checks operations for which Schemathesis would wait, or whose protocol it lacks.
    fn check_streams(&self) -> Verdict {
        let servant = self.names["servants"][0].as_str().context("an id")?;
        let topics = format!("/api/v1/servants/{servant}/topics");
        self.expect_stream_starts("/api/v1/stream", "text/event-stream", &[])?;
        self.expect_stream_starts("/api/v1/events/follow", NDJSON, &[])?;
        self.expect_stream_starts(&topics, NDJSON, &[])?;
        let options = json!({"revision": 1, "robot": "nobody"}).to_string();
        let shadow = "/api/v1/services/adder_py/shadow";
        self.expect_stream_starts(shadow, NDJSON, &["--data", &options])?;
        self.daemon.deployer().run(&["exec", servant, "--", "true"])?.expect_success()?;
        let inside = format!("api/v1/servants/{servant}/inside?token={}", self.admin);
        self.daemon.robot(&inside)?.leave()
    }

    /// Calls all operations as a viewer and as an admin, and last those that remove what the others need.
    fn check_everything(&self) -> Verdict {
        let looks = ["looks", "--role", "viewer", "--service", "*"];
        let viewer = create_token(&self.daemon, &looks)?;
        let mut later: Vec<&str> = Vec::new();
        for id in APART.iter().chain(LAST) {
            later.extend(["--exclude-operation-id", id]);
        }
        for (who, bearer, most) in [("viewer", &viewer, "1"), ("admin", &self.admin, "5")] {
            let arguments = [&["--max-examples", most], &*later].concat();
            let tested = self.run_schemathesis(bearer, false, &arguments);
            let tested = tested.with_context(|| who.to_owned())?;
            ensure!(tested > 50, "{who}: {tested} operations");
        }
        self.check_streams()?;
        for id in LAST {
            let arguments = ["--max-examples", "4", "--include-operation-id", id];
            self.run_schemathesis(&self.admin, true, &arguments).context(*id)?;
        }
        Ok(())
    }

    /// Compares the responses with the statuses in the document.
    fn compare_with_document(&self) -> Verdict {
        let (described, answers) = (documented_statuses(&self.daemon)?, self.read_answers()?);
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

/// Returns the documented statuses of each operation.
fn documented_statuses(daemon: &Daemon) -> anyhow::Result<BTreeMap<String, BTreeSet<u16>>> {
    let document = daemon.api("/api/v1/openapi.json")?;
    let mut described = BTreeMap::new();
    let paths = document["paths"].as_object().context("paths")?;
    for operation in
        paths.values().flat_map(|item| item.as_object().into_iter().flatten()).map(|(_, operation)| operation)
    {
        let id = operation["operationId"].as_str().context("an id")?;
        let statuses = operation["responses"].as_object().context("responses")?;
        let statuses = statuses.keys().map(|status| Ok(status.parse()?));
        described.insert(id.to_owned(), statuses.collect::<anyhow::Result<_>>()?);
    }
    Ok(described)
}

/// Keeps a robot working until the end, because a daemon disconnects silent robots.
fn keep_working(mut robot: Robot, over: &AtomicBool) {
    // Ends when its servant is stopped.
    while !over.load(Ordering::Relaxed) && robot.call("/add_two", json!({"a": 1, "b": 2})).is_ok() {
        thread::sleep(PAUSE);
    }
}

pub fn every_answer_is_as_the_document_says() -> Verdict {
    let black_box = "[black_box]\nseconds = \"5s\"\n";
    let daemon = world().setup("described").config(black_box).start()?;
    let place = world().directory("described")?;
    let (scene, robots) = ApiScene::new(daemon, place.path())?;
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        for robot in robots {
            scope.spawn(|| keep_working(robot, &over));
        }
        let asked = scene.check_everything();
        over.store(true, Ordering::Relaxed);
        asked
    })?;
    scene.compare_with_document()?;
    // The token still works, so the requests were not refused halfway through.
    let bearer = format!("Bearer {}", scene.admin);
    let showing = [("Authorization", bearer.as_str())];
    let (status, _) = scene.daemon.request("GET", "/api/v1/status", &showing)?;
    ensure!(status == 200, "{status}");
    Ok(())
}
