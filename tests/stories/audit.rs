//! What is told of who did what, what is not, and who else comes in: groups of this machine, guessers.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::patience::{self, Patient};
use support::robot::Robot;
use support::world::world;
use support::{Verdict, binaries};

use crate::access::{daemon, pushes_adder, token, with_token};

/// The records of the audit log.
fn audited(daemon: &Daemon) -> anyhow::Result<Vec<Value>> {
    let told = daemon
        .deployer()
        .types(&["--format", "json", "audit", "-n", "1000"])?
        .succeeded()?;
    told.stdout
        .lines()
        .map(|line| Ok(serde_json::from_str(line)?))
        .collect()
}

fn find<'a>(records: &'a [Value], wanted: &[(&str, Value)]) -> anyhow::Result<&'a Value> {
    let is = |record: &&Value| wanted.iter().all(|(key, value)| record[*key] == *value);
    let found = records.iter().find(is);
    found.with_context(|| format!("nothing is recorded of {wanted:?}: {records:#?}"))
}

pub fn who_did_what_is_recorded_and_told_as_it_comes() -> Verdict {
    let setup = world().own("audited");
    let daemon = setup.start()?;
    let mut follower = Command::new(binaries::path("cloudroidctl"))
        .args(["--format", "json", "audit", "-f"])
        .env("CLOUDROID_HOME", daemon.deployer().home)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()?;
    let followed = BufReader::new(follower.stdout.take().context("piped")?).lines();
    let (sender, lines) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        followed
            .map_while(Result::ok)
            .try_for_each(|line| sender.send(line))
    });
    let hears = |word: &str| -> Verdict {
        loop {
            let line = patience::receive(&lines).with_context(|| format!("{word} was not told"))?;
            if line.contains(word) {
                return Ok(());
            }
        }
    };
    // Before anybody is named, a page that has made its name point here.
    let host = [("Host", "evil.example")];
    let (status, _) = daemon.request("GET", "/api/v1/status", &host)?;
    ensure!(status == 403, "{status}");
    hears("evil.example")?;
    let scope = ["--service", "adder*"];
    let alice = token(
        &daemon,
        &[&["alice", "--role", "deployer"], &scope[..]].concat(),
    )?;
    hears("token alice: ")?;
    let eve = token(
        &daemon,
        &[&["eve", "--role", "viewer"], &scope[..]].concat(),
    )?;
    pushes_adder(&daemon, &alice, &[])?.succeeded()?;
    hears("published")?;
    for _ in 0..3 {
        with_token(&daemon, &eve, &["rm", "adder_py"])?.failed_saying(&["may not deploy"])?;
    }
    let rover = ["rover", "--role", "robot", "--robot", "r1"];
    let rover = token(&daemon, &[&rover, &scope[..]].concat())?;
    let robot = daemon.robot(&format!("adder_py?token={rover}"))?;
    hears("connected by rosbridge")?;
    drop(robot);
    let deployer = daemon.deployer();
    deployer
        .types(&["policy", "allow", "rover", "call:/x"])?
        .succeeded()?;
    let mut robot = daemon.robot(&format!("adder_py?token={rover}"))?;
    robot.says(json!({"op": "subscribe", "topic": "/cmd_vel", "type": "std_msgs/String"}))?;
    hears("was refused subscribe:/cmd_vel")?;
    drop(robot);
    deployer.types(&["token", "revoke", "eve"])?.succeeded()?;
    hears("token eve")?;
    let records = audited(&daemon)?;
    let root = json!("root (admin)");
    let made = find(
        &records,
        &[
            ("who", root.clone()),
            (
                "object",
                json!(r#"token alice: {"name":"alice","role":"deployer","services":["adder*"]}"#),
            ),
        ],
    )?;
    ensure!(
        made["from"] == "user 0" && made["action"] == "administer",
        "{made}"
    );
    let pushed = find(
        &records,
        &[
            ("who", json!("alice (deployer)")),
            ("object", json!("service adder_py")),
        ],
    )?;
    let from = pushed["from"].as_str().unwrap_or_default();
    ensure!(
        from.starts_with("127.0.0.1:") && pushed["status"] == 200,
        "{pushed}"
    );
    // Refused again and again, it is recorded once.
    let refused = [("who", json!("eve (viewer)")), ("status", json!(403))];
    let refused = find(&records, &refused)?;
    ensure!(
        refused["did"] == "DELETE /api/v1/services/adder_py",
        "{refused}"
    );
    let often = records
        .iter()
        .filter(|record| record["who"] == "eve (viewer)");
    ensure!(often.count() == 1, "{records:#?}");
    let connected = [
        ("who", json!("rover (robot)")),
        ("action", json!("connect")),
    ];
    let connected = find(&records, &connected)?;
    ensure!(
        connected["object"] == "service adder_py as robot r1",
        "{connected}"
    );
    find(
        &records,
        &[("who", root), ("object", json!("rover at *: call:/x"))],
    )?;
    // Whoever may not read it learns nothing, and a restart forgets nothing.
    with_token(&daemon, &alice, &["audit"])?.failed_saying(&["may not administer"])?;
    follower.kill()?;
    follower.wait()?;
    let before = audited(&daemon)?;
    daemon.ends()?;
    let daemon = setup.start()?;
    let after = audited(&daemon)?;
    ensure!(after.starts_with(&before), "{before:#?} {after:#?}");
    Ok(())
}

pub fn who_was_refused_a_robots_name_and_for_whom_a_proxy_asked_is_recorded() -> Verdict {
    let daemon = world()
        .own("audited-refusals")
        .config("trusted_proxies = [\"127.0.0.1\"]\n")
        .start()?;
    let scope = ["--role", "robot", "--service", "*", "--robot"];
    let robot = |name: &str, robot: &str| token(&daemon, &[&[name], &scope[..], &[robot]].concat());
    let (_, taker) = (robot("rover", "r1")?, robot("taker", "r2")?);
    let chief = token(&daemon, &["chief", "--role", "operator"])?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    // One by its scope, one because the name is another's.
    for token in [&taker, &chief] {
        let url = daemon.url(&format!("adder_py?robot=r1&token={token}"));
        let Err(refusal) = Robot::try_connect(&url) else {
            anyhow::bail!("another's robot was taken over")
        };
        ensure!(refusal.status == 403, "{refusal}");
    }
    // And over a connection that was let in to say who it is.
    let mut late = daemon.robot("adder_py?robot=r1")?;
    late.says(json!({"op": "auth", "mac": chief}))?;
    late.hears_close()?;
    let eve = token(&daemon, &["eve", "--role", "viewer", "--service", "*"])?;
    let bearer = format!("Bearer {eve}");
    let asks = |path: &str, forwarded: &str| {
        let headers = [("Authorization", &*bearer), ("Forwarded", forwarded)];
        Ok::<_, anyhow::Error>(daemon.request("DELETE", path, &headers)?.0)
    };
    // What names nobody is the proxy's own; no text of a client stands in an address's place.
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
    let records = support::until("all of them", || {
        let records = audited(&daemon)?;
        let enough = records.iter().filter(|one| one["status"] == 403).count() >= 9;
        Ok(if enough {
            Ok(records)
        } else {
            Err(format!("{records:#?}"))
        })
    })?;
    for who in ["taker (robot)", "chief (operator)"] {
        let refused = [
            ("who", json!(who)),
            ("action", json!("connect")),
            ("object", json!("service adder_py as robot r1")),
            ("status", json!(403)),
        ];
        find(&records, &refused)?;
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
        let did = format!("DELETE /api/v1/services/s{number}");
        let record = find(&records, &[("did", json!(did))])?;
        let told = record["from"].as_str().unwrap_or_default();
        ensure!(told.starts_with(from), "{record}");
        let who = if number < 7 {
            "eve (viewer)"
        } else {
            "who shows no token"
        };
        ensure!(record["who"] == who, "{record}");
    }
    Ok(())
}

/// Files below a directory that hold one of the texts; images aside.
fn holding(directory: &Path, texts: &[(String, String)], found: &mut Vec<String>) -> Verdict {
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        let about = path.symlink_metadata()?;
        // What packages bring with them was there before any secret.
        let is_of_images = path.ends_with("layers") || path.ends_with("images");
        if about.is_dir() && is_of_images {
            continue;
        } else if about.is_dir() {
            holding(&path, texts, found)?;
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
        .own("secrets")
        .config(&format!("tokens = [{configured:?}]\n"))
        .environment("CLOUDROID_LOG", "debug")
        .start()?;
    let deployer = daemon.deployer();
    let mut secrets = vec![("the configuration's".to_owned(), configured.to_owned())];
    let mut said = String::new();
    let alice = token(&daemon, &["alice", "--role", "deployer", "--service", "*"])?;
    said += &pushes_adder(&daemon, &alice, &[])?.succeeded()?.said();
    let robot = ["--role", "robot", "--service", "*", "--robot", "r1"];
    let first = token(&daemon, &[&["rover"], &robot[..]].concat())?;
    let rotated = deployer.asks(&["token", "rotate", "rover"])?;
    let rover = rotated["secret"].as_str().context("a secret")?.to_owned();
    let gone = token(&daemon, &["gone", "--role", "admin"])?;
    said += &deployer
        .types(&["token", "revoke", "gone"])?
        .succeeded()?
        .said();
    // Before the guesses, after which it waits.
    said += &with_token(&daemon, configured, &["services"])?
        .succeeded()?
        .said();
    for path in [
        "/metrics",
        "/api/v1/events?limit=1000",
        "/api/v1/tokens",
        "/api/v1/policy",
    ] {
        let bearer = format!("Bearer {configured}");
        said += &daemon
            .request("GET", path, &[("Authorization", &bearer)])?
            .1;
    }
    // Each is shown in every way there is, good and bad ones alike.
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
            said += &daemon
                .request("GET", path, &[("Authorization", &bearer)])?
                .1;
        }
        said += &daemon.get(&format!("/api/v1/services?token={secret}"))?.1;
        let url = daemon.url(&format!("adder_py?resume={resume}&token={secret}"));
        if let Err(refusal) = Robot::try_connect(&url) {
            said += &refusal.to_string();
        }
        let protocol = format!("bearer.{secret}");
        for offered in [&["rosbridge", &protocol][..], &[&protocol]] {
            match Robot::try_connect_offering(&daemon.url("adder_py"), offered) {
                Ok((_, chosen)) => ensure!(chosen.as_deref() == Some("rosbridge"), "{chosen:?}"),
                Err(refusal) => said += &refusal.to_string(),
            }
        }
        let mut robot = daemon.robot("adder_py")?;
        robot.says(json!({"op": "auth", "mac": secret}))?;
        match secret == &alice || secret == &rover {
            true => {
                robot.calls("/add_two", json!({"a": 1, "b": 2}))?;
            }
            false => said += &robot.hears_close()?.reason,
        }
        said += &with_token(&daemon, secret, &["services"])?.said();
        secrets.push((name.to_owned(), secret.clone()));
    }
    secrets.push(("the resume token".to_owned(), resume));
    for words in [
        &["token", "list"][..],
        &["events"],
        &["audit", "-n", "1000"],
        &["status"],
        &["servants"],
        &["doctor"],
    ] {
        said += &deployer.types(words)?.said();
    }
    for (name, secret) in &secrets {
        // What was typed is in the words by which a story tells what failed.
        let told = said.lines().filter(|line| !line.contains("--token"));
        let told: Vec<&str> = told.filter(|line| line.contains(secret.as_str())).collect();
        ensure!(told.is_empty(), "{name} token was told: {told:?}");
    }
    // The log is one that would show them.
    let home = deployer.home.clone();
    let log = std::fs::read_to_string(home.join("daemon.log"))?;
    ensure!(log.contains("DEBUG"), "{log}");
    daemon.ends()?;
    // What is no secret is found there.
    let mut found = Vec::new();
    let no_secret = ("the name".to_owned(), "rover".to_owned());
    holding(&home, &[no_secret], &mut found)?;
    let is_kept = |found: &String| found.contains("cloudroid.db");
    ensure!(found.iter().any(is_kept), "looked badly: {found:?}");
    found.clear();
    holding(&home, &secrets, &mut found)?;
    found.retain(|found| !found.ends_with("test-config.toml"));
    ensure!(found.is_empty(), "{found:#?}");
    Ok(())
}

/// What the daemon answers at a socket to a user of this machine, in these groups. Rights are a thread's own to the kernel.
fn asks_as(socket: &Path, uid: u32, groups: &[u32]) -> anyhow::Result<String> {
    use nix::libc;
    let asks = || -> anyhow::Result<String> {
        // SAFETY: `groups` is as long as it says; the calls change this thread alone, which ends after this.
        let changed = unsafe {
            libc::syscall(libc::SYS_setgroups, groups.len(), groups.as_ptr()) == 0
                && libc::syscall(libc::SYS_setresgid, uid, uid, uid) == 0
                && libc::syscall(libc::SYS_setresuid, uid, uid, uid) == 0
        };
        ensure!(changed, "{}", std::io::Error::last_os_error());
        let mut stream = Patient::new(UnixStream::connect(socket)?)?;
        stream.write_all(b"GET /api/v1/tokens HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        Ok(answer)
    };
    std::thread::scope(|scope| scope.spawn(asks).join())
        .map_err(|_| anyhow::anyhow!("the thread ended badly"))?
}

pub fn members_of_a_group_are_admins_at_a_socket_of_theirs() -> Verdict {
    // Below a home nobody else enters; this is where everybody may.
    let place = tempfile::Builder::new()
        .prefix("cloudroid-members-")
        .tempdir()?;
    std::fs::set_permissions(
        place.path(),
        std::os::unix::fs::PermissionsExt::from_mode(0o755),
    )?;
    let (member, group) = (61_001, 61_002);
    let socket = place.path().join("below/daemon.sock");
    let daemon = world()
        .own("members")
        .config(&format!(
            "admin_group = \"{group}\"\nadmin_socket = {socket:?}\n"
        ))
        .start()?;
    // By a supplementary group, and by the first one.
    for (uid, groups) in [(member, &[group][..]), (group, &[]), (0, &[])] {
        let answer = asks_as(&socket, uid, groups)?;
        ensure!(
            answer.starts_with("HTTP/1.1 200"),
            "{uid} {groups:?}: {answer}"
        );
    }
    // The file's rights keep others out, and where those are opened, the kernel's word does.
    ensure!(
        asks_as(&socket, member, &[]).is_err(),
        "let in without the group"
    );
    std::fs::set_permissions(&socket, std::os::unix::fs::PermissionsExt::from_mode(0o666))?;
    let answer = asks_as(&socket, member, &[member])?;
    ensure!(
        answer.starts_with("HTTP/1.1 403")
            && answer.contains("user 61001 may not use the daemon's socket"),
        "{answer}"
    );
    // Nor is it for the user whose rights the portal's threads have.
    let answer = asks_as(&socket, 65_521, &[])?;
    ensure!(answer.starts_with("HTTP/1.1 403"), "{answer}");
    // The daemon's own socket is for none of them.
    let own = daemon.deployer().home.join("run/daemon.sock");
    ensure!(
        asks_as(&own, member, &[group]).is_err(),
        "let into the home"
    );
    daemon.ends()?;
    ensure!(!socket.exists(), "the socket is left");
    Ok(())
}

pub fn whoever_guesses_is_slowed_and_counted() -> Verdict {
    let daemon = daemon("guessed")?;
    let rover = token(&daemon, &["rover", "--role", "viewer", "--service", "*"])?;
    let shows = |token: &str| {
        let bearer = format!("Bearer {token}");
        daemon.request("GET", "/api/v1/services", &[("Authorization", &bearer)])
    };
    let mut guesses = 0;
    // Waits double, so that one is longer than a request takes, however slow this machine is.
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
    ensure!(
        problem["retry_after"]
            .as_u64()
            .is_some_and(|after| after > 0),
        "{body}"
    );
    // Who has a token of the database is held up by nobody.
    ensure!(shows(&rover)?.0 == 200);
    let (_, metrics) = {
        let bearer = format!("Bearer {rover}");
        daemon.request("GET", "/metrics", &[("Authorization", &bearer)])?
    };
    let counted = metrics
        .lines()
        .find_map(|line| line.strip_prefix("cloudroid_refused_tokens_total{why=\"unknown\"} "))
        .context("a count")?;
    ensure!(
        counted.parse::<u64>()? == guesses - 1,
        "{counted} of {guesses}"
    );
    Ok(())
}
