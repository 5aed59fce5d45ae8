//! Principals, tokens and the policy: who may do what, and nothing else.

use anyhow::{Context, ensure};
use serde_json::json;
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::{Deployer, Outcome};
use support::robot::Robot;
use support::world::world;

/// The portal's own table, so that an address that is added to it is walked, too.
const TABLE: &str = include_str!("../../src/portal/src/routes.rs");

pub fn daemon(name: &str) -> anyhow::Result<Daemon> {
    world().own(name).start()
}

/// The secret of a token that is made for the story.
pub fn token(daemon: &Daemon, arguments: &[&str]) -> anyhow::Result<String> {
    let made = daemon
        .deployer()
        .asks(&[&["token", "create"], arguments].concat())?;
    let secret = made["secret"].as_str().context("a secret")?;
    Ok(secret.to_owned())
}

/// Types a command over TCP with a token.
pub fn with_token(daemon: &Daemon, token: &str, arguments: &[&str]) -> anyhow::Result<Outcome> {
    let server = format!("http://{}", daemon.address);
    let deployer = Deployer {
        home: daemon.deployer().home,
    };
    deployer.types(&[&["--server", &server, "--token", token], arguments].concat())
}

/// Method, address and access of each row, the access as it is written there.
fn routes() -> anyhow::Result<Vec<(String, String, String)>> {
    let (_, rows) = TABLE.split_once("ROUTES: &[Route]").context("the table")?;
    let mut routes = Vec::new();
    for row in rows.split("at(").skip(1) {
        let mut words = row.split('"');
        let method = words.nth(1).context("a method")?.to_owned();
        let path = words.nth(1).context("an address")?.to_owned();
        let (_, rest) = row.split_once(&format!("\"{path}\",")).context("a row")?;
        let (access, _) = rest.split_once("||").context("a handler")?;
        let access: String = access.split_whitespace().collect();
        routes.push((method, path, access.trim_end_matches(',').to_owned()));
    }
    Ok(routes)
}

/// Whether docs/access.md's table allows it: to whom a row of the table of routes answers at a service that `deployer` owns.
fn allowed(role: &str, access: &str) -> anyhow::Result<bool> {
    let of = |roles: &[&str]| Ok(roles.contains(&role));
    let everybody = ["admin", "operator", "deployer", "robot", "viewer"];
    match access {
        "ENTER" | "service(See)" | "May(See,Of::Stub(\"file\"))" => of(&everybody),
        "LOOK" => of(&["admin", "operator"]),
        "ADMINISTER" => of(&["admin"]),
        "service(Deploy)" | "service(Try)" | "May(Deploy,Of::Handler)" => {
            of(&["admin", "operator", "deployer"])
        }
        // Of all servants: the deployer may for services of its own.
        "May(Operate,Of::Handler)" => of(&["admin", "operator"]),
        // There is no such servant, and no such robot, which only those hear who are told of all.
        "servant(See)" | "servant(Operate)" | "servant(Logs)" | "May(See,Of::Robot(\"name\"))" => {
            of(&["admin", "operator"])
        }
        other => anyhow::bail!("{other} has no row here; say whom it allows"),
    }
}

pub fn every_route_answers_those_whom_the_table_allows() -> Verdict {
    let daemon = daemon("matrix")?;
    let alice = token(
        &daemon,
        &["alice", "--role", "deployer", "--service", "adder*"],
    )?;
    let pushed = pushes_adder(&daemon, &alice, &[])?;
    pushed.succeeded()?;
    let scope = ["--service", "adder_py"];
    let mut principals = vec![("deployer", alice)];
    for role in ["admin", "operator"] {
        principals.push((role, token(&daemon, &[role, "--role", role])?));
    }
    let viewer = [&["eve", "--role", "viewer"], &scope[..]].concat();
    principals.push(("viewer", token(&daemon, &viewer)?));
    let rover = [&["rover", "--role", "robot", "--robot", "r1"], &scope[..]].concat();
    principals.push(("robot", token(&daemon, &rover)?));
    let over = token(&daemon, &["over", "--role", "admin"])?;
    daemon
        .deployer()
        .types(&["token", "revoke", "over"])?
        .succeeded()?;
    let routes = routes()?;
    ensure!(routes.len() > 40, "the table was read badly: {routes:?}");
    let mut walked = 0;
    for (method, path, access) in &routes {
        if matches!(&**access, "Read" | "Connect" | "ReadOrConnect") {
            continue;
        }
        let filled = path
            .replace("{name}", "adder_py")
            .replace("{file}", "adder_py.tar.gz")
            .replace("{id}", "x")
            .replace("{reference}", "x")
            .replace("{digest}", "x");
        // An archive is no text.
        let method = match (&**method, &**path) {
            ("ANY", _) => "GET",
            (_, "/stubs/{file}") => "HEAD",
            (method, _) => method,
        };
        for (role, token) in &principals {
            let allowed = allowed(role, access)?;
            // What changes something is not done here: only that it is refused.
            if allowed && !matches!(method, "GET" | "HEAD") {
                continue;
            }
            let bearer = format!("Bearer {token}");
            let (status, body) = daemon.request(method, &filled, &[("Authorization", &bearer)])?;
            ensure!(
                (status != 403) == allowed && status != 401,
                "{role} {method} {filled} ({access}): {status} {body}"
            );
            walked += 1;
        }
        for (token, words) in [(&*over, "was revoked"), ("guess", "not known")] {
            let bearer = format!("Bearer {token}");
            let (status, body) = daemon.request(method, &filled, &[("Authorization", &bearer)])?;
            // Whoever guesses is slowed after a while.
            let guessed = token == "guess" && status == 429;
            ensure!(
                guessed || status == 401 && (method == "HEAD" || body.contains(words)),
                "{method} {filled}: {status} {body}"
            );
        }
    }
    ensure!(walked > 100, "{walked} were walked");
    // Nobody is told what is not of its scope, nor whether it is there.
    let (_, eve) = principals
        .iter()
        .find(|(role, _)| *role == "viewer")
        .context("eve")?;
    let bearer = format!("Bearer {eve}");
    let mut told = Vec::new();
    for name in ["hidden", "nothing_such"] {
        let path = format!("/api/v1/services/{name}");
        let (status, body) = daemon.request("GET", &path, &[("Authorization", &bearer)])?;
        told.push((status, body.replace(name, "NAME")));
    }
    ensure!(told[0] == told[1] && told[0].0 == 403, "{told:?}");
    Ok(())
}

pub fn pushes_adder(daemon: &Daemon, token: &str, more: &[&str]) -> anyhow::Result<Outcome> {
    let package = support::binaries::package("adder_py");
    let path = support::deployer::path_str(&package);
    let push = [&["push", path, "--node", "adder.py"], more].concat();
    with_token(daemon, token, &push)
}

pub fn a_deployer_changes_its_own_services_alone() -> Verdict {
    let daemon = daemon("owners")?;
    let alice = token(
        &daemon,
        &["alice", "--role", "deployer", "--service", "adder*"],
    )?;
    let bob = token(&daemon, &["bob", "--role", "deployer", "--service", "*"])?;
    pushes_adder(&daemon, &alice, &[])?.succeeded()?;
    // Where it is published by its name alone, that is found out when it is built.
    pushes_adder(&daemon, &bob, &[])?
        .failed_saying(&["bob (deployer) may not deploy service adder_py"])?;
    pushes_adder(&daemon, &alice, &["--name", "other"])?
        .failed_saying(&["alice (deployer) may not deploy service other"])?;
    with_token(&daemon, &bob, &["rm", "adder_py"])?.failed_saying(&["may not deploy"])?;
    let seen = with_token(&daemon, &bob, &["services"])?.succeeded()?;
    ensure!(seen.stdout.contains("adder_py"), "{}", seen.said());
    pushes_adder(&daemon, &alice, &[])?.succeeded()?;
    with_token(&daemon, &alice, &["rm", "adder_py"])?.succeeded()?;
    Ok(())
}

pub fn what_robots_may_changes_while_they_are_connected() -> Verdict {
    let daemon = daemon("granted")?;
    let deployer = daemon.deployer();
    deployer
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    let robot = ["--role", "robot", "--service", "adder_py", "--robot"];
    let rover = token(&daemon, &[&["rover"], &robot[..], &["r1"]].concat())?;
    let other = token(&daemon, &[&["other"], &robot[..], &["r2"]].concat())?;
    // Nobody is somebody else, and who names no robot is its token's.
    let refused = Robot::try_connect(&daemon.url(&format!("adder_py?robot=r1&token={other}")));
    let Err(refusal) = refused else {
        anyhow::bail!("one robot was let in as another")
    };
    ensure!(
        refusal.status == 403 && refusal.body.contains("as robot r1"),
        "{refusal}"
    );
    let class = Robot::try_connect(&daemon.url(&format!("adder_py?class=gold&token={rover}")));
    let Err(refusal) = class else {
        anyhow::bail!("a class was given to who may not have it")
    };
    ensure!(
        refusal.status == 403 && refusal.body.contains("class gold"),
        "{refusal}"
    );
    let mut at_work = daemon.robot(&format!("adder_py?token={rover}"))?;
    let mut beside = daemon.robot("adder_py?robot=r2")?;
    beside.says(json!({"op": "auth", "mac": other}))?;
    for robot in [&mut at_work, &mut beside] {
        ensure!(robot.calls("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    }
    daemon.servant_of("adder_py", "r1")?;
    at_work.says(json!({"op": "subscribe", "topic": "/rosout", "type": "rosgraph_msgs/Log"}))?;
    deployer
        .types(&[
            "policy",
            "allow",
            "rover",
            "call:/nothing",
            "--service",
            "adder_*",
        ])?
        .succeeded()?;
    at_work.hears_status("subscribe:/rosout is not granted to this client any more")?;
    let refused = at_work.calls("/add_two", json!({"a": 1, "b": 2}))?;
    let reason = refused["values"].as_str().unwrap_or_default();
    ensure!(
        refused["result"] == false && reason.contains("call:/add_two is not granted"),
        "{refused}"
    );
    let services = at_work.calls("/rosapi/services", json!({}))?.to_string();
    ensure!(!services.contains("/add_two"), "{services}");
    ensure!(beside.calls("/add_two", json!({"a": 2, "b": 2}))?["values"]["sum"] == 4);
    // The connection of a revoked token ends; the other goes on.
    deployer.types(&["token", "revoke", "rover"])?.succeeded()?;
    let close = at_work.hears_close()?;
    ensure!(
        u16::from(close.code) == 1008 && close.reason.contains("revoked"),
        "{close:?}"
    );
    let Err(refusal) = Robot::try_connect(&daemon.url(&format!("adder_py?token={rover}"))) else {
        anyhow::bail!("a revoked token let a robot in")
    };
    ensure!(refusal.status == 401, "{refusal}");
    ensure!(beside.calls("/add_two", json!({"a": 3, "b": 2}))?["values"]["sum"] == 5);
    Ok(())
}

pub fn this_machines_users_see_and_are_robots_and_change_nothing() -> Verdict {
    let daemon = daemon("locals")?;
    let deployer = daemon.deployer();
    deployer
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    let mut robot = daemon.robot("adder_py?robot=r1")?;
    ensure!(robot.calls("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    ensure!(daemon.get("/api/v1/services")?.0 == 200 && daemon.get("/metrics")?.0 == 200);
    for (method, path) in [
        ("DELETE", "/api/v1/services/adder_py"),
        ("DELETE", "/api/v1/servants"),
        ("POST", "/api/v1/push"),
        ("GET", "/api/v1/tokens"),
        ("POST", "/api/v1/tokens"),
    ] {
        let (status, body) = daemon.request(method, path, &[])?;
        ensure!(
            status == 403 && body.contains("local (viewer, robot) may not"),
            "{method} {path}: {status} {body}"
        );
    }
    // From the first token on everybody needs one, and who has none is not served any further.
    token(&daemon, &["root2", "--role", "admin"])?;
    let close = robot.hears_close()?;
    ensure!(u16::from(close.code) == 1008, "{close:?}");
    ensure!(daemon.get("/api/v1/services")?.0 == 401);
    deployer.types(&["token", "revoke", "root2"])?.succeeded()?;
    ensure!(
        daemon.get("/api/v1/services")?.0 == 401,
        "the door does not open again"
    );
    deployer.types(&["services"])?.succeeded()?;
    Ok(())
}
