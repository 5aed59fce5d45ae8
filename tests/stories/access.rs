//! Principals, tokens and the policy: who may do what, and nothing else.

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::json;
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, Deployer};
use support::robot::Robot;
use support::world::world;

/// The document has the address of each route, which a unit test of the portal checks.
const MATRIX: &str = include_str!("../../docs/access.md");

pub fn daemon(name: &str) -> anyhow::Result<Daemon> {
    world().setup(name).start()
}

/// Creates a token and returns its secret.
pub fn create_token(daemon: &Daemon, arguments: &[&str]) -> anyhow::Result<String> {
    let made = daemon.deployer().run_json(&[&["token", "create"], arguments].concat())?;
    let secret = made["secret"].as_str().context("a secret")?;
    Ok(secret.to_owned())
}

/// Runs a command over TCP with a token.
pub fn run_with_token(daemon: &Daemon, token: &str, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let server = format!("http://{}", daemon.address);
    let deployer = Deployer { home: daemon.deployer().home };
    deployer.run(&[&["--server", &server, "--token", token], arguments].concat())
}

/// An address of the matrix in docs/access.md: who is answered there.
struct AccessRow {
    method: String,
    path: String,
    /// Cells by column name.
    cells: Vec<(String, String)>,
}

impl AccessRow {
    fn cell(&self, column: &str) -> anyhow::Result<&str> {
        let cell = self.cells.iter().find(|(name, _)| name == column);
        Ok(&cell.with_context(|| format!("no column {column}"))?.1)
    }

    /// Returns the path with parameters filled in from this story.
    fn request_path(&self, servant: &str, recording: &str) -> String {
        let name = if self.path.contains("/robots/") { "r1" } else { "adder_py" };
        let of_servants = ["/servants/", "/foxglove/"];
        let id = if of_servants.iter().any(|part| self.path.contains(part)) { servant } else { "x" };
        self.path
            .replace("{name}", name)
            .replace("{id}", id)
            .replace("{number}", recording)
            .replace("{file}", "adder_py.tar.gz")
            .replace("{service}", "adder_py")
            .replace("{reference}", "x")
            .replace("{digest}", "x")
    }

    /// Returns the method to request with; where the row allows any, one that changes nothing.
    fn request_method(&self) -> &str {
        match (&*self.method, &*self.path) {
            ("ANY", _) => "GET",
            // The first takes long, the others never end.
            (_, "/stubs/{file}" | "/api/v1/stream" | "/api/v1/events/follow" | "/api/v1/servants/{id}/topics") => {
                "HEAD"
            }
            (method, _) => method,
        }
    }

    fn is_read_only(&self) -> bool {
        matches!(self.request_method(), "GET" | "HEAD")
    }

    fn is_of_robots(&self) -> bool {
        self.path.starts_with("/{service}")
    }
}

/// Parses the matrix of the document, which a unit test compares with the portal's table.
fn read_matrix() -> anyhow::Result<Vec<AccessRow>> {
    let start = MATRIX.find("| no token |").context("the matrix")?;
    let mut lines = MATRIX[start..].lines().take_while(|line| !line.is_empty());
    let cells = |line: &str| -> Vec<String> {
        let cells = line.trim().trim_matches('|').split('|');
        cells.map(|cell| cell.trim().trim_matches('`').to_owned()).collect()
    };
    let columns = cells(lines.next().context("its head")?);
    let mut rows = Vec::new();
    for line in lines.skip(1) {
        let mut cells = cells(line);
        let addresses = cells.pop().unwrap_or_default();
        let cells: Vec<(String, String)> = columns.iter().cloned().zip(cells).collect();
        for address in addresses.split("`, `") {
            let (method, path) = address.split_once(' ').with_context(|| format!("no method: {address}"))?;
            rows.push(AccessRow { method: method.to_owned(), path: path.to_owned(), cells: cells.clone() });
        }
    }
    ensure!(rows.len() > 45, "the matrix was read badly: {}", rows.len());
    Ok(rows)
}

/// Creates a token and waits until it has expired.
pub fn expired_token(daemon: &Daemon) -> anyhow::Result<String> {
    let short = create_token(daemon, &["short", "--role", "admin", "--expires", "1s"])?;
    let bearer = format!("Bearer {short}");
    support::wait_until("the token's end", || {
        let asked = daemon.request("GET", "/api/v1/whoami", &[("Authorization", &bearer)])?;
        Ok(match asked.0 {
            401 => Ok(()),
            status => Err(format!("{status}")),
        })
    })?;
    Ok(short)
}

pub fn every_route_answers_those_whom_the_table_allows() -> Verdict {
    let daemon = world().setup("matrix");
    let daemon = daemon.config("[black_box]\nseconds = \"1s\"\n").start()?;
    let mut rows = read_matrix()?;
    // Requests with a pairing code are covered by the stories of pairing.
    rows.retain(|row| row.path != "/api/v1/pair");
    let asks = |row: &AccessRow, address: &str, token: Option<&str>| {
        let bearer = token.map(|token| format!("Bearer {token}"));
        let headers = bearer.as_deref().map(|bearer| ("Authorization", bearer));
        daemon.request(row.request_method(), address, headers.as_slice())
    };
    // As long as there are no principals.
    let mut walked = 0;
    for row in rows.iter().filter(|row| !row.is_of_robots()) {
        let allowed = row.cell("local")? == "yes";
        if allowed && !row.is_read_only() {
            continue;
        }
        let (status, body) = asks(row, &row.request_path("x", "1"), None)?;
        ensure!((status != 403) == allowed && status != 401, "local {} {}: {status} {body}", row.method, row.path);
        walked += 1;
    }
    // For each role, one principal whose scope includes the service, and one whose scope does not.
    let scoped = |name: &str, more: &[&str]| -> anyhow::Result<(String, String)> {
        let made = |name: &str, service: &str, robot: &str| {
            let given = [&[name, "--service", service], more].concat();
            let given: Vec<&str> = given.into_iter().map(|word| if word == "ROBOT" { robot } else { word }).collect();
            create_token(&daemon, &given)
        };
        Ok((made(name, "adder*", "r1")?, made(&format!("other-{name}"), "other*", "r2")?))
    };
    let (alice, bob) = scoped("deployer", &["--role", "deployer"])?;
    let (rover, other) = scoped("robot", &["--role", "robot", "--robot", "ROBOT"])?;
    let (eve, oscar) = scoped("viewer", &["--role", "viewer"])?;
    let mut principals =
        vec![("deployer", alice.clone(), bob), ("robot", rover.clone(), other), ("viewer", eve.clone(), oscar)];
    for role in ["admin", "operator"] {
        let one = create_token(&daemon, &[role, "--role", role])?;
        principals.push((role, one.clone(), one));
    }
    push_adder(&daemon, &alice, &[])?.expect_success()?;
    let at_work = daemon.robot(&format!("adder_py?token={rover}"))?;
    let servant = support::wait_until("the robot's servant", || {
        let servant = daemon.servant_of("adder_py", "r1");
        Ok(servant.map_err(|error| format!("{error:#}")))
    })?;
    let servant = servant["id"].as_str().context("an id")?.to_owned();
    let recording = support::wait_until("a recording", || {
        let taken = daemon.deployer().run(&["--format", "json", "recordings", "take", &servant])?;
        let taken: Result<serde_json::Value, _> = serde_json::from_str(&taken.stdout);
        let number = taken.map(|taken| taken[0]["number"].to_string());
        Ok(number.map_err(|error| error.to_string()))
    })?;
    let revoked = create_token(&daemon, &["over", "--role", "admin"])?;
    daemon.deployer().run(&["token", "revoke", "over"])?.expect_success()?;
    let expired = expired_token(&daemon)?;
    for row in &rows {
        let address = row.request_path(&servant, &recording);
        for (role, own, foreign) in &principals {
            let cell = row.cell(role)?;
            // Routes that name their service in the query or the body check it later; these requests name none.
            let named_later = matches!(&*row.path, "/api/v1/push" | "/api/v1/servants");
            for (whose, token, allowed) in [("own", own, cell != "-"), ("another's", foreign, cell == "yes")] {
                if row.is_of_robots() {
                    // Permitted connections are covered by the other stories.
                    if !allowed {
                        let path = format!("{}?token={token}", &address[1..]);
                        let Err(refusal) = Robot::try_connect(&daemon.url(&path)) else {
                            anyhow::bail!("{role} ({whose}) connected to {address}");
                        };
                        ensure!(refusal.status == 403, "{role} ({whose}) {address}: {refusal}");
                    }
                    continue;
                }
                // Requests that would change something are only made if they are refused.
                if (allowed || named_later && cell == "own") && !row.is_read_only() {
                    continue;
                }
                let (status, body) = asks(row, &address, Some(token))?;
                ensure!(
                    (status != 403) == allowed && status != 401,
                    "{role} ({whose}) {} {address} ({cell}): {status} {body}",
                    row.method
                );
                walked += 1;
            }
        }
        if row.is_of_robots() {
            continue;
        }
        let (status, body) = asks(row, &address, None)?;
        let open = row.cell("no token")? == "yes";
        ensure!((status != 401) == open, "{} {address}: {status} {body}", row.method);
        for (token, words) in [(&*revoked, "was revoked"), (&*expired, "has expired"), ("guess", "not known")] {
            let (status, body) = asks(row, &address, Some(token))?;
            // Repeated guesses are slowed down after a while.
            let slowed = token == "guess" && status == 429;
            ensure!(
                slowed || status == 401 && (row.request_method() == "HEAD" || body.contains(words)),
                "{} {address}: {status} {body}",
                row.method
            );
        }
    }
    ensure!(walked > 300, "{walked} were walked");
    drop(at_work);
    // Nobody is told about services outside their scope, nor whether they exist.
    let mut told = Vec::new();
    for name in ["hidden", "nothing_such"] {
        let path = format!("/api/v1/services/{name}");
        let bearer = format!("Bearer {eve}");
        let (status, body) = daemon.request("GET", &path, &[("Authorization", &bearer)])?;
        told.push((status, body.replace(name, "NAME")));
    }
    ensure!(told[0] == told[1] && told[0].0 == 403, "{told:?}");
    Ok(())
}

pub fn push_adder(daemon: &Daemon, token: &str, more: &[&str]) -> anyhow::Result<CommandOutcome> {
    let package = support::binaries::package("adder_py");
    let path = support::deployer::path_str(&package);
    let push = [&["push", path, "--node", "adder.py"], more].concat();
    run_with_token(daemon, token, &push)
}

pub fn what_is_asked_badly_is_refused_in_words() -> Verdict {
    let daemon = daemon("badly")?;
    let admin = create_token(&daemon, &["chief", "--role", "admin"])?;
    let bearer = format!("Bearer {admin}");
    for (path, words) in [
        ("/api/v1/audit?limit=x", "limit: invalid digit"),
        ("/api/v1/audit?limit=-1", "limit: invalid digit"),
        ("/api/v1/audit?limit=99999999999", "limit: number too large"),
        ("/api/v1/audit?since=yesterday", "since: invalid digit"),
        ("/api/v1/events?since=", "since: cannot parse integer"),
        ("/api/v1/events?limit=1&limit=2", "duplicate field `limit`"),
    ] {
        let (status, body) = daemon.request("GET", path, &[("Authorization", &bearer)])?;
        let problem: serde_json::Value = serde_json::from_str(&body).with_context(|| format!("{path}: {body}"))?;
        let detail = problem["detail"].as_str().unwrap_or_default();
        ensure!(
            status == 400 && detail.contains("the query cannot be read") && detail.contains(words),
            "{path}: {status} {body}"
        );
    }
    for (typed, words) in [
        (&["policy", "rm", "9999"][..], "no rule \"9999\""),
        (&["policy", "allow", "role:fool", "call:/x"], "unknown role \"fool\""),
        (&["policy", "allow", "rover", "fly:/x"], "\"fly:/x\" is not a grant"),
        (&["policy", "allow", "rover", "call:[/x"], "is not a grant"),
        (&["token", "revoke", "nobody"], "there is no valid token \"nobody\""),
        (&["token", "rotate", "nobody"], "there is no valid token \"nobody\""),
        (&["token", "create", "a b", "--role", "viewer"], "is not a valid name"),
        (&["token", "create", "r", "--role", "robot"], "--service"),
        (&["token", "create", "k", "--role", "king"], "king"),
        (&["token", "create", "chief", "--role", "viewer", "--service", "*"], "chief"),
    ] {
        daemon.deployer().run(typed)?.expect_failure(&[words])?;
    }
    let rules = daemon.deployer().run_json(&["policy", "list"])?;
    ensure!(rules.as_array().is_some_and(|rules| rules.len() == 2), "{rules}");
    Ok(())
}

pub fn a_deployer_changes_its_own_services_alone() -> Verdict {
    let daemon = daemon("owners")?;
    let alice = create_token(&daemon, &["alice", "--role", "deployer", "--service", "adder*"])?;
    let bob = create_token(&daemon, &["bob", "--role", "deployer", "--service", "*"])?;
    push_adder(&daemon, &alice, &[])?.expect_success()?;
    // If only the name is given, the owner is found out when the package is built.
    push_adder(&daemon, &bob, &[])?.expect_failure(&["bob (deployer) may not deploy service adder_py"])?;
    push_adder(&daemon, &alice, &["--name", "other"])?
        .expect_failure(&["alice (deployer) may not deploy service other"])?;
    run_with_token(&daemon, &bob, &["rm", "adder_py"])?.expect_failure(&["may not deploy"])?;
    let seen = run_with_token(&daemon, &bob, &["services"])?.expect_success()?;
    ensure!(seen.stdout.contains("adder_py"), "{}", seen.output());
    push_adder(&daemon, &alice, &[])?.expect_success()?;
    run_with_token(&daemon, &alice, &["rm", "adder_py"])?.expect_success()?;
    Ok(())
}

pub fn what_robots_may_changes_while_they_are_connected() -> Verdict {
    let daemon = daemon("policies")?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let robot = ["--role", "robot", "--service", "adder_py", "--robot"];
    let rover = create_token(&daemon, &[&["rover"], &robot[..], &["r1"]].concat())?;
    let other = create_token(&daemon, &[&["other"], &robot[..], &["r2"]].concat())?;
    // A token cannot be used for another robot, and a robot without a name gets that of its token.
    let refused = Robot::try_connect(&daemon.url(&format!("adder_py?robot=r1&token={other}")));
    let Err(refusal) = refused else { anyhow::bail!("one robot was let in as another") };
    ensure!(refusal.status == 403 && refusal.body.contains("as robot r1"), "{refusal}");
    let class = Robot::try_connect(&daemon.url(&format!("adder_py?class=gold&token={rover}")));
    let Err(refusal) = class else { anyhow::bail!("a class was given to who may not have it") };
    ensure!(refusal.status == 403 && refusal.body.contains("class gold"), "{refusal}");
    let mut at_work = daemon.robot(&format!("adder_py?token={rover}"))?;
    let mut beside = daemon.robot("adder_py?robot=r2")?;
    beside.send(json!({"op": "auth", "mac": other}))?;
    for robot in [&mut at_work, &mut beside] {
        ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    }
    daemon.servant_of("adder_py", "r1")?;
    at_work.send(json!({"op": "subscribe", "topic": "/rosout", "type": "rosgraph_msgs/Log"}))?;
    deployer.run(&["policy", "allow", "rover", "call:/nothing", "--service", "adder_*"])?.expect_success()?;
    at_work.wait_for_status("subscribe:/rosout is no longer granted to this client")?;
    let refused = at_work.call("/add_two", json!({"a": 1, "b": 2}))?;
    let reason = refused["values"].as_str().unwrap_or_default();
    ensure!(refused["result"] == false && reason.contains("call:/add_two is not granted"), "{refused}");
    let services = at_work.call("/rosapi/services", json!({}))?.to_string();
    ensure!(!services.contains("/add_two"), "{services}");
    ensure!(beside.call("/add_two", json!({"a": 2, "b": 2}))?["values"]["sum"] == 4);
    // The connection of a revoked token ends; the other one continues.
    deployer.run(&["token", "revoke", "rover"])?.expect_success()?;
    let close = at_work.wait_for_close()?;
    ensure!(u16::from(close.code) == 1008 && close.reason.contains("revoked"), "{close:?}");
    let Err(refusal) = Robot::try_connect(&daemon.url(&format!("adder_py?token={rover}"))) else {
        anyhow::bail!("a revoked token let a robot in")
    };
    ensure!(refusal.status == 401, "{refusal}");
    ensure!(beside.call("/add_two", json!({"a": 3, "b": 2}))?["values"]["sum"] == 5);
    Ok(())
}

pub fn this_machines_users_see_and_are_robots_and_change_nothing() -> Verdict {
    let daemon = daemon("locals")?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let mut robot = daemon.robot("adder_py?robot=r1")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    ensure!(daemon.get("/api/v1/services")?.0 == 200 && daemon.get("/metrics")?.0 == 200);
    for (method, path) in [
        ("DELETE", "/api/v1/services/adder_py"),
        ("DELETE", "/api/v1/servants"),
        ("POST", "/api/v1/push"),
        ("GET", "/api/v1/tokens"),
        ("POST", "/api/v1/tokens"),
    ] {
        let (status, body) = daemon.request(method, path, &[])?;
        ensure!(status == 403 && body.contains("local (viewer, robot) may not"), "{method} {path}: {status} {body}");
    }
    // From the first token on everyone needs one. At a terminal the deployer is asked first.
    let create = ["token", "create", "root2", "--role", "admin"];
    let cut_off = "1 robot that is connected without one is cut off: r1";
    answer_at_terminal(&daemon, &create, "n")?.expect_failure(&[cut_off, "nothing was created"])?;
    ensure!(robot.call("/add_two", json!({"a": 2, "b": 2}))?["values"]["sum"] == 4, "it was not cut off");
    // A script is told, and goes on; a client without a token is disconnected.
    let told = deployer.run(&create)?.expect_success()?;
    ensure!(told.stderr.contains(cut_off), "{}", told.stderr);
    let close = robot.wait_for_close()?;
    ensure!(u16::from(close.code) == 1008, "{close:?}");
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    deployer.run(&["token", "revoke", "root2"])?.expect_success()?;
    ensure!(daemon.get("/api/v1/services")?.0 == 401, "the door does not open again");
    deployer.run(&["services"])?.expect_success()?;
    Ok(())
}

/// Runs `cloudroidctl` at a terminal of its own, and answers its question.
fn answer_at_terminal(daemon: &Daemon, arguments: &[&str], answer: &str) -> anyhow::Result<CommandOutcome> {
    let command = format!("{} {}", support::binaries::path("cloudroidctl").display(), arguments.join(" "));
    let mut child = Command::new("script")
        .args(["--quiet", "--return", "--command", &command, "/dev/null"])
        .env("CLOUDROID_HOME", &daemon.home)
        .env_remove("CLOUDROID_SERVER")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .context("script, which is a part of Debian")?;
    let mut input = child.stdin.take().context("its standard input")?;
    input.write_all(format!("{answer}\n").as_bytes())?;
    drop(input);
    let output = child.wait_with_output()?;
    Ok(CommandOutcome {
        command,
        status: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

pub fn robots_of_this_machine_stay_where_that_is_allowed() -> Verdict {
    let daemon = world().setup("locals-stay").config("[portal]\nloopback_robots = \"allowed\"\n").start()?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let mut robot = daemon.robot("adder_py?robot=r1")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    let told = deployer.run(&["token", "create", "ann", "--role", "operator"])?.expect_success()?;
    ensure!(told.stderr.contains("first credential") && !told.stderr.contains("cut off"), "{}", told.stderr);
    let secret = told.stdout.trim();
    // Robots work on and come anew; nothing else is open, and a wrong token is one.
    let mut later = daemon.robot("adder_py?robot=r2")?;
    for robot in [&mut robot, &mut later] {
        ensure!(robot.call("/add_two", json!({"a": 2, "b": 2}))?["values"]["sum"] == 4);
    }
    for path in ["/api/v1/services", "/api/v1/servants", "/metrics", "/adder_py"] {
        ensure!(daemon.get(path)?.0 == 401, "{path}");
    }
    let url = daemon.url("adder_py?robot=r3&token=wrong-and-long-enough");
    let Err(refusal) = Robot::try_connect(&url) else { anyhow::bail!("a wrong token was let in") };
    ensure!(refusal.status == 401, "{refusal}");
    // A robot's name that a token owns is that token's.
    let mut owned = daemon.robot(&format!("adder_py?robot=r4&token={secret}"))?;
    ensure!(owned.call("/add_two", json!({"a": 3, "b": 2}))?["values"]["sum"] == 5);
    let Err(refusal) = Robot::try_connect(&daemon.url("adder_py?robot=r4")) else {
        anyhow::bail!("it took a robot's name")
    };
    ensure!(refusal.status == 403, "{refusal}");
    Ok(())
}

pub fn what_was_begun_with_a_token_ends_with_it() -> Verdict {
    let daemon = daemon("access-revoked")?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let secret = create_token(&daemon, &["watcher", "--role", "operator"])?;
    // Nobody uses the service, so it would wait for an hour.
    let mut going = Command::new(support::binaries::path("cloudroidctl"))
        .args(["--server", &format!("http://{}", daemon.address)])
        .args(["--token", &secret, "--format", "json"])
        .args(["shadow", "adder_py", "1", "--seconds", "3600"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()?;
    let said = going.stdout.take().context("its standard output")?;
    let first = BufReader::new(said).lines().next();
    let first = first.context("it said nothing")??;
    ensure!(first.contains("waiting for a robot"), "{first}");
    daemon.deployer().run(&["token", "revoke", "watcher"])?.expect_success()?;
    let ended = support::wait_until("its end", || Ok(going.try_wait()?.ok_or_else(|| "it goes on".to_owned())));
    let _ = going.kill();
    let _ = going.wait();
    ensure!(!ended?.success(), "nothing was compared");
    Ok(())
}
