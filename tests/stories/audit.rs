//! The audit log: what is recorded and what is not; and other users of the machine: members of groups, guessers of
//! tokens.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::patience::{self, PatientStream};
use support::robot::Robot;
use support::world::world;
use support::{Verdict, binaries};

use crate::access::{create_token, daemon, push_adder, run_with_token};

/// Returns the records of the audit log.
fn audit_records(daemon: &Daemon) -> anyhow::Result<Vec<Value>> {
    let told = daemon.deployer().run(&["--format", "json", "audit", "-n", "1000"])?.expect_success()?;
    told.stdout.lines().map(|line| Ok(serde_json::from_str(line)?)).collect()
}

fn find_record<'a>(records: &'a [Value], wanted: &[(&str, Value)]) -> anyhow::Result<&'a Value> {
    let is = |record: &&Value| wanted.iter().all(|(key, value)| record[*key] == *value);
    let found = records.iter().find(is);
    found.with_context(|| format!("nothing is recorded of {wanted:?}: {records:#?}"))
}

pub fn who_did_what_is_recorded_and_told_as_it_comes() -> Verdict {
    let setup = world().setup("audited");
    let daemon = setup.start()?;
    let mut follower = Command::new(binaries::path("cloudroidctl"))
        .args(["--format", "json", "audit", "-f"])
        .env("CLOUDROID_HOME", daemon.deployer().home)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()?;
    let followed = BufReader::new(follower.stdout.take().context("piped")?).lines();
    let (sender, lines) = std::sync::mpsc::channel();
    std::thread::spawn(move || followed.map_while(Result::ok).try_for_each(|line| sender.send(line)));
    let hears = |word: &str| -> Verdict {
        loop {
            let line = patience::receive(&lines).with_context(|| format!("{word} was not told"))?;
            if line.contains(word) {
                return Ok(());
            }
        }
    };
    // Before there are principals, a page whose host name was changed to resolve to this machine (DNS rebinding).
    let host = [("Host", "evil.example")];
    let (status, _) = daemon.request("GET", "/api/v1/status", &host)?;
    ensure!(status == 403, "{status}");
    hears("evil.example")?;
    let scope = ["--service", "adder*"];
    let alice = create_token(&daemon, &[&["alice", "--role", "deployer"], &scope[..]].concat())?;
    hears("token alice: ")?;
    let eve = create_token(&daemon, &[&["eve", "--role", "viewer"], &scope[..]].concat())?;
    push_adder(&daemon, &alice, &[])?.expect_success()?;
    hears(r#""did":"push""#)?;
    // A push that fails is told by its name, too.
    push_adder(&daemon, &alice, &["--name", "adder_broken", "--node", "no_such_node"])?.expect_failure(&[])?;
    for _ in 0..3 {
        run_with_token(&daemon, &eve, &["rm", "adder_py"])?.expect_failure(&["may not deploy"])?;
    }
    let rover = ["rover", "--role", "robot", "--robot", "r1"];
    let rover = create_token(&daemon, &[&rover, &scope[..]].concat())?;
    let robot = daemon.robot(&format!("adder_py?token={rover}"))?;
    hears("connected by rosbridge")?;
    drop(robot);
    let deployer = daemon.deployer();
    deployer.run(&["policy", "allow", "rover", "call:/x"])?.expect_success()?;
    let mut robot = daemon.robot(&format!("adder_py?token={rover}"))?;
    robot.send(json!({"op": "subscribe", "topic": "/cmd_vel", "type": "std_msgs/String"}))?;
    hears("was refused subscribe:/cmd_vel")?;
    drop(robot);
    deployer.run(&["token", "revoke", "eve"])?.expect_success()?;
    hears("token eve")?;
    let records = audit_records(&daemon)?;
    let root = json!("root (admin)");
    let made = find_record(
        &records,
        &[
            ("who", root.clone()),
            ("object", json!(r#"token alice: {"name":"alice","role":"deployer","services":["adder*"]}"#)),
        ],
    )?;
    ensure!(made["from"] == "user 0" && made["action"] == "administer", "{made}");
    let pushed = find_record(&records, &[("who", json!("alice (deployer)")), ("object", json!("service adder_py"))])?;
    let from = pushed["from"].as_str().unwrap_or_default();
    ensure!(from.starts_with("127.0.0.1:") && pushed["status"] == 200, "{pushed}");
    let failed = records.iter().find(|record| {
        let object = record["object"].as_str().unwrap_or_default();
        record["did"] == "push" && object.starts_with("service adder_broken: ")
    });
    ensure!(failed.is_some_and(|record| record["status"].as_u64() >= Some(400)), "{records:#?}");
    // Repeated refusals are recorded once.
    let refused = [("who", json!("eve (viewer)")), ("status", json!(403))];
    let refused = find_record(&records, &refused)?;
    ensure!(refused["did"] == "remove" && refused["object"] == "service adder_py", "{refused}");
    let often = records.iter().filter(|record| record["who"] == "eve (viewer)");
    ensure!(often.count() == 1, "{records:#?}");
    let connected = [("who", json!("rover (robot)")), ("action", json!("connect"))];
    let connected = find_record(&records, &connected)?;
    ensure!(connected["object"] == "service adder_py as robot r1", "{connected}");
    find_record(&records, &[("who", root), ("object", json!("rover at *: call:/x"))])?;
    // Users who may not read the log learn nothing, and the log survives a restart.
    run_with_token(&daemon, &alice, &["audit"])?.expect_failure(&["may not administer"])?;
    follower.kill()?;
    follower.wait()?;
    let before = audit_records(&daemon)?;
    daemon.stop()?;
    let daemon = setup.start()?;
    let after = audit_records(&daemon)?;
    ensure!(after.starts_with(&before), "{before:#?} {after:#?}");
    Ok(())
}

pub fn who_was_refused_a_robots_name_and_for_whom_a_proxy_asked_is_recorded() -> Verdict {
    let daemon = world().setup("audited-refusals").config("trusted_proxies = [\"127.0.0.1\"]\n").start()?;
    let scope = ["--role", "robot", "--service", "*", "--robot"];
    let robot = |name: &str, robot: &str| create_token(&daemon, &[&[name], &scope[..], &[robot]].concat());
    let (_, taker) = (robot("rover", "r1")?, robot("taker", "r2")?);
    let chief = create_token(&daemon, &["chief", "--role", "operator"])?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    // One is refused because of its scope, the other because the name belongs to another principal.
    for token in [&taker, &chief] {
        let url = daemon.url(&format!("adder_py?robot=r1&token={token}"));
        let Err(refusal) = Robot::try_connect(&url) else { anyhow::bail!("another's robot was taken over") };
        ensure!(refusal.status == 403, "{refusal}");
    }
    // Also over a connection that may authenticate later.
    let mut late = daemon.robot("adder_py?robot=r1")?;
    late.send(json!({"op": "auth", "mac": chief}))?;
    late.wait_for_close()?;
    let eve = create_token(&daemon, &["eve", "--role", "viewer", "--service", "*"])?;
    let bearer = format!("Bearer {eve}");
    let asks = |path: &str, forwarded: &str| {
        let headers = [("Authorization", &*bearer), ("Forwarded", forwarded)];
        Ok::<_, anyhow::Error>(daemon.request("DELETE", path, &headers)?.0)
    };
    // Without a valid address the proxy's own one is recorded; text from a client never takes the place of an address.
    for (number, (forwarded, status)) in [
        ("for=192.0.2.7", 403),
        ("for=\"[2001:db8::7]:4711\"", 403),
        ("for=unknown", 403),
        ("for=\"<script>\"", 403),
        ("for=192.0.2.7 audit: root did it", 403),
        ("for=", 403),
        (";;,,", 403),
        ("for=\"192.0.2.7", 400),
        ("for=\"\\\"\"", 400),
    ]
    .into_iter()
    .enumerate()
    {
        let told = asks(&format!("/api/v1/services/s{number}"), forwarded)?;
        ensure!(told == status, "{forwarded}: {told}");
    }
    let records = support::wait_until("all of them", || {
        let records = audit_records(&daemon)?;
        let enough = records.iter().filter(|one| one["status"] == 403).count() >= 9;
        Ok(if enough { Ok(records) } else { Err(format!("{records:#?}")) })
    })?;
    for who in ["taker (robot)", "chief (operator)"] {
        let refused = [
            ("who", json!(who)),
            ("action", json!("connect")),
            ("object", json!("service adder_py as robot r1")),
            ("status", json!(403)),
        ];
        find_record(&records, &refused)?;
    }
    for (number, from) in [
        "192.0.2.7:0",
        "[2001:db8::7]:4711",
        "127.0.0.1:",
        "127.0.0.1:",
        "127.0.0.1:",
        "127.0.0.1:",
        "127.0.0.1:",
        "127.0.0.1:",
        "127.0.0.1:",
    ]
    .into_iter()
    .enumerate()
    {
        let object = if number < 7 {
            format!("service s{number}")
        } else {
            format!("a client with a malformed proxy header (/api/v1/services/s{number})")
        };
        let record = find_record(&records, &[("did", json!("remove")), ("object", json!(object))])?;
        let told = record["from"].as_str().unwrap_or_default();
        ensure!(told.starts_with(from), "{record}");
        let who = if number < 7 { "eve (viewer)" } else { "a client without a token" };
        ensure!(record["who"] == who, "{record}");
    }
    Ok(())
}

/// Finds files below a directory that contain one of the texts, except in images.
fn find_files_with(directory: &Path, texts: &[(String, String)], found: &mut Vec<String>) -> Verdict {
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        let about = path.symlink_metadata()?;
        // The content of packages existed before any of the secrets.
        let is_of_images = path.ends_with("layers") || path.ends_with("images");
        if about.is_dir() && is_of_images {
            continue;
        } else if about.is_dir() {
            find_files_with(&path, texts, found)?;
        } else if about.is_file() {
            let bytes = std::fs::read(&path)?;
            let words = String::from_utf8_lossy(&bytes);
            for (name, text) in texts {
                if words.contains(text.as_str()) {
                    found.push(format!("{name} is in {}", path.display()));
                }
            }
        }
    }
    Ok(())
}

pub fn no_secret_is_in_any_log() -> Verdict {
    let configured = "opensesame4711";
    let daemon = world()
        .setup("secrets")
        .config(&format!("tokens = [{configured:?}]\n"))
        .environment("CLOUDROID_LOG", "debug")
        .start()?;
    let deployer = daemon.deployer();
    let mut secrets = vec![("the configuration's".to_owned(), configured.to_owned())];
    let mut said = String::new();
    let alice = create_token(&daemon, &["alice", "--role", "deployer", "--service", "*"])?;
    said += &push_adder(&daemon, &alice, &[])?.expect_success()?.output();
    let robot = ["--role", "robot", "--service", "*", "--robot", "r1"];
    let first = create_token(&daemon, &[&["rover"], &robot[..]].concat())?;
    let rotated = deployer.run_json(&["token", "rotate", "rover"])?;
    let rover = rotated["secret"].as_str().context("a secret")?.to_owned();
    let gone = create_token(&daemon, &["gone", "--role", "admin"])?;
    said += &deployer.run(&["token", "revoke", "gone"])?.expect_success()?.output();
    // Before the guesses, after which this token would have to wait.
    said += &run_with_token(&daemon, configured, &["services"])?.expect_success()?.output();
    for path in ["/metrics", "/api/v1/events?limit=1000", "/api/v1/tokens", "/api/v1/policy"] {
        let bearer = format!("Bearer {configured}");
        said += &daemon.request("GET", path, &[("Authorization", &bearer)])?.1;
    }
    // Every way to show a token, valid or not.
    let guess = "guessedatrandom".to_owned();
    let resume = "resumewithwhat4711".to_owned();
    for (name, secret) in [
        ("alice's", &alice),
        ("rover's first", &first),
        ("rover's", &rover),
        ("the revoked", &gone),
        ("a guess", &guess),
    ] {
        let bearer = format!("Bearer {secret}");
        for path in ["/api/v1/services", "/api/v1/tokens"] {
            said += &daemon.request("GET", path, &[("Authorization", &bearer)])?.1;
        }
        said += &daemon.get(&format!("/api/v1/services?token={secret}"))?.1;
        let url = daemon.url(&format!("adder_py?resume={resume}&token={secret}"));
        if let Err(refusal) = Robot::try_connect(&url) {
            said += &refusal.to_string();
        }
        let protocol = format!("bearer.{secret}");
        for offered in [&["rosbridge", &protocol][..], &[&protocol]] {
            match Robot::try_connect_with_protocols(&daemon.url("adder_py"), offered) {
                Ok((_, chosen)) => ensure!(chosen.as_deref() == Some("rosbridge"), "{chosen:?}"),
                Err(refusal) => said += &refusal.to_string(),
            }
        }
        let mut robot = daemon.robot("adder_py")?;
        robot.send(json!({"op": "auth", "mac": secret}))?;
        if secret == &alice || secret == &rover {
            robot.call("/add_two", json!({"a": 1, "b": 2}))?;
        } else {
            said += &robot.wait_for_close()?.reason
        }
        said += &run_with_token(&daemon, secret, &["services"])?.output();
        secrets.push((name.to_owned(), secret.clone()));
    }
    secrets.push(("the resume token".to_owned(), resume));
    for words in
        [&["token", "list"][..], &["events"], &["audit", "-n", "1000"], &["status"], &["servants"], &["doctor"]]
    {
        said += &deployer.run(words)?.output();
    }
    for (name, secret) in &secrets {
        // Commands that failed are quoted with their arguments.
        let told = said.lines().filter(|line| !line.contains("--token"));
        let told: Vec<&str> = told.filter(|line| line.contains(secret.as_str())).collect();
        ensure!(told.is_empty(), "{name} token was told: {told:?}");
    }
    // The log is verbose enough to show them.
    let home = deployer.home.clone();
    let log = std::fs::read_to_string(home.join("daemon.log"))?;
    ensure!(log.contains("DEBUG"), "{log}");
    daemon.stop()?;
    // Texts that are not secret are found there.
    let mut found = Vec::new();
    let no_secret = ("the name".to_owned(), "rover".to_owned());
    find_files_with(&home, &[no_secret], &mut found)?;
    let is_kept = |found: &String| found.contains("cloudroid.db");
    ensure!(found.iter().any(is_kept), "looked badly: {found:?}");
    found.clear();
    find_files_with(&home, &secrets, &mut found)?;
    found.retain(|found| !found.ends_with("test-config.toml"));
    ensure!(found.is_empty(), "{found:#?}");
    Ok(())
}

/// Sends a request to a socket as a user of this machine with these groups. To the kernel credentials belong to
/// threads.
fn request_as(socket: &Path, uid: u32, groups: &[u32]) -> anyhow::Result<String> {
    use nix::libc;
    let asks = || -> anyhow::Result<String> {
        // SAFETY: `groups` has the length that is passed; the calls affect only this thread, which ends afterwards.
        let changed = unsafe {
            libc::syscall(libc::SYS_setgroups, groups.len(), groups.as_ptr()) == 0
                && libc::syscall(libc::SYS_setresgid, uid, uid, uid) == 0
                && libc::syscall(libc::SYS_setresuid, uid, uid, uid) == 0
        };
        ensure!(changed, "{}", std::io::Error::last_os_error());
        let mut stream = PatientStream::new(UnixStream::connect(socket)?)?;
        stream.write_all(b"GET /api/v1/tokens HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        Ok(answer)
    };
    std::thread::scope(|scope| scope.spawn(asks).join()).map_err(|_| anyhow::anyhow!("the thread ended badly"))?
}

pub fn members_of_a_group_are_admins_at_a_socket_of_theirs() -> Verdict {
    // Other users cannot enter a home, but this directory.
    let place = tempfile::Builder::new().prefix("cloudroid-members-").tempdir()?;
    std::fs::set_permissions(place.path(), std::os::unix::fs::PermissionsExt::from_mode(0o755))?;
    let (member, group) = (61_001, 61_002);
    let socket = place.path().join("below/daemon.sock");
    let daemon =
        world().setup("members").config(&format!("admin_group = \"{group}\"\nadmin_socket = {socket:?}\n")).start()?;
    // By a supplementary group, and by the primary group.
    for (uid, groups) in [(member, &[group][..]), (group, &[]), (0, &[])] {
        let answer = request_as(&socket, uid, groups)?;
        ensure!(answer.starts_with("HTTP/1.1 200"), "{uid} {groups:?}: {answer}");
    }
    // The file's permissions keep others out; with open permissions the peer credentials do.
    ensure!(request_as(&socket, member, &[]).is_err(), "let in without the group");
    std::fs::set_permissions(&socket, std::os::unix::fs::PermissionsExt::from_mode(0o666))?;
    let answer = request_as(&socket, member, &[member])?;
    ensure!(
        answer.starts_with("HTTP/1.1 403") && answer.contains("user 61001 may not use the daemon's socket"),
        "{answer}"
    );
    // The user of the portal's threads is refused as well.
    let answer = request_as(&socket, 65_521, &[])?;
    ensure!(answer.starts_with("HTTP/1.1 403"), "{answer}");
    // None of them may use the daemon's own socket.
    let own = daemon.deployer().home.join("run/daemon.sock");
    ensure!(request_as(&own, member, &[group]).is_err(), "let into the home");
    daemon.stop()?;
    ensure!(!socket.exists(), "the socket is left");
    Ok(())
}

pub fn whoever_guesses_is_slowed_and_counted() -> Verdict {
    let daemon = daemon("guessed")?;
    let rover = create_token(&daemon, &["rover", "--role", "viewer", "--service", "*"])?;
    let shows = |token: &str| {
        let bearer = format!("Bearer {token}");
        daemon.request("GET", "/api/v1/services", &[("Authorization", &bearer)])
    };
    let mut guesses = 0;
    // Waiting times double, so that at some point they exceed the duration of a request, however slow this machine is.
    let body = loop {
        guesses += 1;
        let (status, body) = shows(&format!("guess {guesses}"))?;
        match status {
            401 => ensure!(guesses < 30, "not slowed"),
            429 => break body,
            other => anyhow::bail!("{other} {body}"),
        }
    };
    ensure!(guesses > 10, "slowed after {guesses}");
    let problem: Value = serde_json::from_str(&body)?;
    ensure!(problem["retry_after"].as_u64().is_some_and(|after| after > 0), "{body}");
    // Valid tokens of the database are not slowed down.
    ensure!(shows(&rover)?.0 == 200);
    let (_, metrics) = {
        let bearer = format!("Bearer {rover}");
        daemon.request("GET", "/metrics", &[("Authorization", &bearer)])?
    };
    let counted = metrics
        .lines()
        .find_map(|line| line.strip_prefix("cloudroid_refused_tokens_total{why=\"unknown\"} "))
        .context("a count")?;
    ensure!(counted.parse::<u64>()? == guesses - 1, "{counted} of {guesses}");
    Ok(())
}
