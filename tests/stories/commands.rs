//! The command line as used by scripts and shells.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};

use anyhow::{Context, ensure};
use serde_json::Value;
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, Deployer, run};
use support::patience;
use support::world::{LOCALISER, world};
use support::{Verdict, binaries};

use crate::access::{create_token, run_with_token};

pub fn a_script_can_tell_by_the_exit_status_what_to_do() -> Verdict {
    let setup = world().setup("exits");
    let daemon = setup.start()?;
    let deployer = daemon.deployer();
    let types = |arguments: &[&str]| deployer.run(arguments);
    let viewer = create_token(&daemon, &["looks", "--role", "viewer", "--service", "*"])?;
    for revision in [&["--param", "offset=1"][..], &["--canary", "1"]] {
        let push = [&["--node", "adder.py"], revision].concat();
        deployer.push("adder_py", &push)?.expect_success()?;
    }
    let ends = |outcome: CommandOutcome, status: i32, words: &str| -> Verdict {
        ensure!(outcome.status == status && outcome.output().contains(words), "{status} was to be: {outcome:#?}");
        Ok(())
    };
    ends(types(&["services"])?, 0, "adder_py")?;
    for listed in [&["services", "-q"][..], &["ls", "-o", "name"], &["get", "services", "-q"], &["-q", "list"]] {
        let names = types(listed)?.expect_success()?.stdout;
        ensure!(names == "adder_py\n", "{listed:?}: {names}");
    }
    let yaml = types(&["services", "-o", "yaml"])?.expect_success()?.stdout;
    ensure!(yaml.starts_with("- ") && yaml.contains("name: adder_py\n"), "{yaml}");
    ends(types(&["status", "-q"])?, 2, "verbs that list")?;
    ends(types(&["version"])?, 0, "cloudroidd ")?;
    ends(types(&["push"])?, 2, "Usage")?;
    ends(types(&["events", "--kind", "bogus"])?, 5, "servant-ready")?;
    ends(types(&["events", "--follow", "--kind", "bogus"])?, 5, "node-hung")?;
    let off = types(&["recordings", "list"])?.expect_success()?.stderr;
    ensure!(off.contains("black boxes are off") && !off.contains("recordings take"), "{off}");
    ends(types(&["rollback", "nothing"])?, 5, "available: adder_py")?;
    ends(types(&["explain", "nobody"])?, 5, "nobody")?;
    ends(run_with_token(&daemon, &viewer, &["rm", "adder_py"])?, 4, "error")?;
    ends(run_with_token(&daemon, "wrong", &["status"])?, 4, "token")?;
    let changed = deployer.run_json(&["diff", "adder_py", "1", "2"])?;
    let differences = changed["differences"].as_array().context("differences")?;
    let offset = serde_json::json!({"part": "parameter", "name": "/adder/offset", "before": "1"});
    ensure!(differences.contains(&offset), "{changed:#}");
    let back = types(&["diff", "adder_py", "2", "1"])?.expect_success()?;
    ensure!(back.stdout.contains("REVISION 2"), "{back:#?}");
    ends(types(&["diff", "adder_py", "1", "7"])?, 5, "available: 2, 1")?;
    ends(types(&["diff", "adder_py"])?, 5, "no revision before 1")?;
    // The canary has no robots yet, so no decision is made.
    let wait = ["rollout", "adder_py", "--wait=1s"];
    ends(types(&wait)?, 8, "adder_py is at canary")?;
    let abort = ["rollout", "adder_py", "--wait=30s", "abort"];
    ends(types(&abort)?, 1, "was not promoted: aborted")?;
    ends(types(&["rollout", "adder_py", "promote"])?, 6, "not a canary")?;
    let start = ["rollout", "adder_py", "--wait", "start", "2"];
    ends(types(&start)?, 0, "promoted")?;
    // A reader that closes the pipe early is not an error.
    let closed = "set -o pipefail; \"$0\" services | true";
    let shell = Command::new("bash")
        .args(["-c", closed])
        .arg(binaries::path("cloudroidctl"))
        .env("CLOUDROID_HOME", setup.home())
        .status()?;
    ensure!(shell.success(), "{shell}");
    daemon.kill()?;
    ends(types(&["services"])?, 3, "no daemon answers")?;
    ends(types(&["status", "--wait=1s"])?, 8, "no daemon answers")?;
    let waiting = Command::new(binaries::path("cloudroidctl"))
        .args(["--format", "json", "status", "--wait"])
        .env("CLOUDROID_HOME", setup.home())
        .env_remove("CLOUDROID_SERVER")
        .stdout(Stdio::piped())
        .spawn()?;
    let daemon = setup.start()?;
    let found = waiting.wait_with_output()?;
    let status: Value = serde_json::from_slice(&found.stdout)?;
    ensure!(found.status.success() && status["pid"] == daemon.pid());
    Ok(())
}

/// A running `cloudroidctl events --follow`.
struct EventFollower {
    child: Child,
    lines: Receiver<String>,
}

impl EventFollower {
    fn begin(daemon: &Daemon, arguments: &[&str]) -> anyhow::Result<EventFollower> {
        let mut child = Command::new(binaries::path("cloudroidctl"))
            .args(["--format", "json", "events", "--follow"])
            .args(arguments)
            .env("CLOUDROID_HOME", daemon.deployer().home)
            .env_remove("CLOUDROID_SERVER")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let out = child.stdout.take().context("its words")?;
        let (told, lines) = channel();
        std::thread::spawn(move || {
            let lines = BufReader::new(out).lines();
            lines.map_while(Result::ok).all(|line| told.send(line).is_ok())
        });
        Ok(EventFollower { child, lines })
    }

    /// Returns the numbers of the events up to and including one of this kind.
    fn wait_for_event(&mut self, kind: &str) -> anyhow::Result<Vec<i64>> {
        let mut numbers = Vec::new();
        loop {
            let line = patience::receive(&self.lines);
            let line = line.with_context(|| format!("no event {kind:?} after {numbers:?}"))?;
            let event: Value = serde_json::from_str(&line)?;
            numbers.push(event["id"].as_i64().context("a number")?);
            if event["kind"] == kind {
                return Ok(numbers);
            }
        }
    }
}

impl Drop for EventFollower {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub fn a_servant_is_named_by_its_service_where_that_has_no_other() -> Verdict {
    let daemon = world().setup("by-name").start()?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let types = |words: &[&str]| deployer.run(words);
    let never = types(&["fit", "adder_py", "--cpus", "4000"])?.expect_success()?;
    ensure!(never.stdout.contains("it would always be refused: a servant of 4000 cores"), "{}", never.output());
    let unpromised = types(&["fit", "adder_py"])?.expect_success()?.stdout;
    ensure!(unpromised.contains("no cores are requested"), "{unpromised}");
    types(&["stop", "adder_py"])?.expect_failure(&["adder_py"])?;
    let one = daemon.robot("adder_py?robot=one")?;
    daemon.wait_for_event("a ready servant", |event| event["kind"] == "servant-ready" && event["robot"] == "one")?;
    types(&["set", "adder_py", "--cpus", "0.5"])?.expect_success()?;
    let servant = daemon.servant_of("adder_py", "one")?;
    ensure!(servant["limits"]["cpus"] == 0.5, "{servant:#}");
    let beyond = types(&["set", "adder_py", "--cpus", "4000"])?.expect_failure(&["does not fit on this machine"])?;
    ensure!(beyond.status == 6, "{beyond:#?}");
    let table = types(&["ps"])?.expect_success()?.stdout;
    ensure!(table.lines().all(|line| line.chars().count() <= 100), "{table}");
    let coloured = type_in_terminal(&deployer, "servants", "", &[])?.expect_success()?.stdout;
    ensure!(coloured.contains("\u{1b}[32mready"), "{coloured:?}");
    let plain = type_in_terminal(&deployer, "servants", "", &[("NO_COLOR", "1")])?.expect_success()?.stdout;
    ensure!(plain.contains("ready") && !plain.contains('\u{1b}'), "{plain:?}");
    let two = daemon.robot("adder_py?robot=two")?;
    let saying = ["adder_py has 2 servants; name one: "];
    types(&["set", "adder_py", "--cpus", "1"])?.expect_failure(&saying)?;
    types(&["stop", "adder_py"])?.expect_failure(&saying)?;
    drop(two);
    let id = daemon.servant_of("adder_py", "two")?["id"].clone();
    // A servant that is named twice is stopped once.
    let id = id.as_str().context("an id")?;
    let stopped = types(&["stop", id, id])?.expect_success()?;
    ensure!(stopped.stdout.matches(id).count() == 1, "{}", stopped.output());
    let stopped = types(&["stop", "adder_py"])?.expect_success()?;
    let id = servant["id"].as_str().context("an id")?;
    ensure!(stopped.stdout.contains(id), "{}", stopped.output());
    drop(one);
    // A person at a terminal is asked, a script is not.
    let kept = type_in_terminal(&deployer, "rm adder_py", "n\n", &[])?;
    let kept = kept.expect_failure(&["remove adder_py with 1 revision? [y/N]", "was not removed"])?;
    ensure!(types(&["services", "-q"])?.stdout == "adder_py\n", "{kept:?}");
    let removed = type_in_terminal(&deployer, "rm adder_py", "y\n", &[])?.expect_success()?;
    ensure!(removed.stdout.contains("removed adder_py"), "{removed:?}");
    Ok(())
}

/// Runs `cloudroidctl WORDS` in a terminal, where these keys are typed.
fn type_in_terminal(
    deployer: &Deployer,
    words: &str,
    keys: &str,
    environment: &[(&str, &str)],
) -> anyhow::Result<CommandOutcome> {
    let command = format!("{} {words}", binaries::path("cloudroidctl").display());
    let mut terminal = Command::new("script")
        .args(["--quiet", "--flush", "--return", "--command", &command])
        .arg("/dev/null")
        .env("CLOUDROID_HOME", &deployer.home)
        .env_remove("CLOUDROID_SERVER")
        .env_remove("NO_COLOR")
        .env("TERM", "xterm")
        .envs(environment.iter().copied())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    // The terminal stays open until the command has ended.
    let mut keyboard = terminal.stdin.take().context("its keys")?;
    keyboard.write_all(keys.as_bytes())?;
    let output = terminal.wait_with_output()?;
    Ok(CommandOutcome {
        command,
        status: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

pub fn who_follows_events_misses_none_when_the_daemon_is_started_again() -> Verdict {
    let setup = world().setup("followed");
    let daemon = setup.start()?;
    let mut all = EventFollower::begin(&daemon, &["-n", "1000"])?;
    let mut some = EventFollower::begin(&daemon, &["--kind", "removed"])?;
    let push = ["--node", "adder.py"];
    daemon.deployer().push("adder_py", &push)?.expect_success()?;
    let mut numbers = all.wait_for_event("published")?;
    daemon.kill()?;
    let daemon = setup.start()?;
    daemon.deployer().run(&["rm", "adder_py"])?.expect_success()?;
    numbers.extend(all.wait_for_event("removed")?);
    let kept = daemon.deployer().run_json(&["events", "-n", "1000"])?;
    let kept = kept.as_array().context("events")?;
    let removed = kept.iter().position(|event| event["kind"] == "removed");
    let expected: Vec<i64> =
        kept[..=removed.context("it is removed")?].iter().filter_map(|event| event["id"].as_i64()).collect();
    ensure!(numbers == expected, "{numbers:?}, kept are {expected:?}");
    // A filter by kind applies to followed events as well.
    let last = expected.last().copied().context("one")?;
    ensure!(some.wait_for_event("removed")? == [last]);
    // A follower ends when its token is revoked.
    let viewer = create_token(&daemon, &["looks", "--role", "viewer", "--service", "*"])?;
    let server = format!("http://{}", daemon.address);
    let follow = ["--server", &server, "--token", &viewer];
    let mut shown = EventFollower::begin(&daemon, &follow)?;
    shown.wait_for_event("removed")?;
    let revoke = ["token", "revoke", "looks"];
    daemon.deployer().run(&revoke)?.expect_success()?;
    let ended = shown.child.wait()?;
    ensure!(ended.code() == Some(4), "{ended}");
    Ok(())
}

pub fn shells_complete_it_and_every_verb_has_a_page() -> Verdict {
    let daemon = world().daemon_with(LOCALISER)?;
    let deployer = daemon.deployer();
    let script = deployer.run(&["completions", "bash"])?.expect_success()?;
    let completes = "source \"$0\"; COMP_WORDS=(cloudroidctl \"$@\"); COMP_CWORD=$#; _cloudroidctl_names \
        cloudroidctl \"${@: -1}\" x; echo \"${COMPREPLY[@]}\"";
    let pages = world().directory("pages")?;
    let file = pages.path().join("completions");
    std::fs::write(&file, script.stdout)?;
    let program = binaries::path("cloudroidctl");
    let places = [program.parent().context("its directory")?.display().to_string(), std::env::var("PATH")?].join(":");
    let completed_at = |home: &Path, words: &[&str]| -> anyhow::Result<String> {
        let mut bash = Command::new("bash");
        bash.args(["-c", completes]).arg(&file).args(words).env("PATH", &places).env("CLOUDROID_HOME", home);
        bash.env_remove("CLOUDROID_SERVER");
        Ok(run(&mut bash)?.expect_success()?.stdout)
    };
    let completed = |words: &[&str]| completed_at(&deployer.home, words);
    for (words, expected) in [
        (&["roll"][..], "rollback rollout"),
        (&["push", "--can"], "--canary"),
        (&["rollout", "s", "pro"], "promote"),
        // Names are those of the daemon.
        (&["rm", "local"], "localiser_py"),
        (&["stop", "--service", "="], "localiser_py"),
        (&["events", "--kind", "node-h"], "node-hung"),
    ] {
        // The daemon has two seconds for its names, which is little on a busy machine.
        support::wait_until(&format!("completion of {words:?}"), || {
            let found = completed(words)?;
            let is_offered = found.trim() == expected || found.split_whitespace().any(|word| word == expected);
            Ok(if is_offered { Ok(()) } else { Err(found) })
        })?;
    }
    // Without a daemon there are none, and nothing is said.
    let away = completed_at(pages.path(), &["rm", "local"])?;
    ensure!(away.trim().is_empty(), "{away}");
    for shell in ["zsh", "fish"] {
        let script = deployer.run(&["completions", shell])?.expect_success()?;
        ensure!(script.stdout.contains("rollback"), "{shell}");
    }
    let directory = pages.path().to_string_lossy().into_owned();
    deployer.run(&["man", &directory])?.expect_success()?;
    let page = |name: &str| std::fs::read_to_string(pages.path().join(name));
    let own = page("cloudroidctl.1")?;
    ensure!(own.contains("invalid or refused request"), "{own}");
    let help = deployer.run(&["--help"])?.expect_success()?.stdout;
    ensure!(help.lines().all(|line| line.chars().count() <= 100), "{help}");
    let verbs = help.split_once("Services:").context("verbs")?.1;
    let verbs = verbs.split_once("Options:").context("options")?.0;
    let mut count = 0;
    // Groups begin in the first column, and descriptions go on further in.
    let lines = verbs.lines().filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    for verb in lines.filter_map(|line| line.split_whitespace().next()) {
        let text = page(&format!("cloudroidctl-{verb}.1")).context(verb.to_owned())?;
        ensure!(text.contains(".SH NAME"), "{verb}: {text}");
        count += 1;
    }
    ensure!(count > 25, "{verbs}");
    let nowhere = format!("{directory}/cloudroidctl.1/below");
    deployer.run(&["man", &nowhere])?.expect_failure(&["cannot write the manual pages to"])?;
    Ok(())
}

pub fn top_shows_who_uses_the_machine() -> Verdict {
    let daemon = world().daemon_with(LOCALISER)?;
    let deployer = daemon.deployer();
    let mut robot = daemon.robot("localiser_py?robot=watched")?;
    robot.call("/rosapi/nodes", serde_json::json!({}))?;
    let only = ["top", "--service", "localiser_py", "--sort", "name"];
    let once = deployer.run(&only)?.expect_success()?.stdout;
    let row = once.lines().find(|line| line.contains("watched"));
    ensure!(row.is_some_and(|row| row.contains("ready")), "{once}");
    ensure!(once.contains("cores used"), "{once}");
    let other = ["top", "--once", "--service", "nobodys"];
    let other = deployer.run(&other)?.expect_success()?.stdout;
    ensure!(other.contains("no servants"), "{other}");
    let listed = deployer.run_json(&only)?;
    let listed = listed.as_array().context("servants")?;
    let robots = listed.iter().map(|one| &one["servant"]["robot"]);
    ensure!(robots.clone().any(|robot| robot == "watched"), "{listed:?}");
    // In a terminal, until the user types q.
    let typed = format!("{} top", binaries::path("cloudroidctl").display());
    let mut terminal = Command::new("script")
        .args(["--quiet", "--flush", "--return", "--command", &typed])
        .arg("/dev/null")
        .env("CLOUDROID_HOME", &deployer.home)
        .env_remove("CLOUDROID_SERVER")
        .env("TERM", "xterm")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let mut keys = terminal.stdin.take().context("its keys")?;
    let mut screen = terminal.stdout.take().context("its screen")?;
    let (drawn, seen) = channel();
    let reader = std::thread::spawn(move || -> std::io::Result<String> {
        let (mut all, mut more) = (Vec::new(), [0; 4096]);
        loop {
            match screen.read(&mut more)? {
                0 => return Ok(String::from_utf8_lossy(&all).into_owned()),
                count => all.extend_from_slice(&more[..count]),
            }
            if String::from_utf8_lossy(&all).contains("watched") {
                // One frame is enough.
                let _ = drawn.send(());
            }
        }
    });
    patience::receive(&seen).context("nothing is drawn")?;
    keys.write_all(b"mq")?;
    let ended = terminal.wait()?;
    let all = reader.join().map_err(|_| anyhow::anyhow!("the reader"))??;
    ensure!(ended.success(), "{ended}: {all}");
    ensure!(all.contains("\u{1b}[?1049l"), "the terminal is left as it was not: {all}");
    Ok(())
}
