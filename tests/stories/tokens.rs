//! With configured tokens every request needs one, on loopback as well.

use anyhow::{Context, ensure};
use serde_json::json;
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::{ADDER, world};

/// The portal's own table, so that new routes are covered automatically.
const TABLE: &str = include_str!("../../src/portal/src/routes.rs");
const METHODS: [&str; 8] = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"];

/// Returns methods and paths of the table, with parameters filled in.
pub fn read_routes() -> anyhow::Result<Vec<(String, String)>> {
    let (_, rows) = TABLE.split_once("ROUTES: &[Route]").context("the table")?;
    let mut routes = Vec::new();
    for row in rows.split("route(").skip(1) {
        let mut words = row.split('"').skip(1).step_by(2);
        let (method, path) = (words.next().context("a method")?, words.next());
        let path = path.context("a path")?;
        let filled = path.split('/').map(|segment| match segment {
            "{service}" => "no_such_service",
            segment if segment.starts_with('{') => "x",
            segment => segment,
        });
        routes.push((method.to_owned(), filled.collect::<Vec<_>>().join("/")));
    }
    Ok(routes)
}

fn start_guarded(name: &str) -> anyhow::Result<Daemon> {
    world().setup(name).config("tokens = [\"open sesame\"]\n").start()
}

/// Without `Sec-WebSocket-Key`, so that a request which passes the token check is refused by the next check without
/// waiting.
const UPGRADE: [(&str, &str); 3] =
    [("Upgrade", "websocket"), ("Connection", "Upgrade, close"), ("Sec-WebSocket-Version", "13")];

pub fn no_route_answers_without_a_token() -> Verdict {
    let daemon = start_guarded("walked")?;
    let routes = read_routes()?;
    for known in [("POST", "/api/v1/push"), ("ANY", "/"), ("GET", "/v2/_catalog")] {
        let listed = routes.iter().any(|(method, path)| (&**method, &**path) == known);
        ensure!(listed, "{known:?} is not in the table as it was read: {routes:?}");
    }
    let mut answered = Vec::new();
    for (_, path) in &routes {
        for method in METHODS {
            for upgrade in [&[][..], &UPGRADE[..]] {
                for host in ["localhost", "elsewhere.example"] {
                    let headers = [upgrade, &[("Host", host)]].concat();
                    let (status, body) = daemon.request(method, path, &headers)?;
                    if status != 401 {
                        ensure!(!body.contains("open sesame"), "{body}");
                        answered.push((method, path.as_str(), !upgrade.is_empty(), status));
                    }
                }
            }
        }
    }
    answered.dedup();
    // A handshake without a token is admitted in order to authenticate later: this one is refused as incomplete, which
    // reveals nothing. There is no default service to connect to.
    let open = [
        ("GET", "/", false, 200),
        ("HEAD", "/", false, 200),
        ("GET", "/healthz", false, 200),
        ("HEAD", "/healthz", false, 200),
        ("GET", "/api/v1/session", false, 200),
        ("HEAD", "/api/v1/session", false, 200),
        ("POST", "/api/v1/session", false, 400),
        // No provider is configured.
        ("GET", "/api/v1/oidc/login", false, 404),
        ("HEAD", "/api/v1/oidc/login", false, 404),
        ("GET", "/api/v1/oidc/callback", false, 404),
        ("HEAD", "/api/v1/oidc/callback", false, 404),
        ("GET", "/assets/x", false, 404),
        ("HEAD", "/assets/x", false, 404),
        // A pairing code needs no token, but TLS.
        ("POST", "/api/v1/pair", false, 400),
        ("GET", "/no_such_service", true, 400),
        ("GET", "/no_such_service/", true, 400),
    ];
    answered.retain(|route| !open.contains(route));
    ensure!(answered.is_empty(), "answered without a token (method, address, as a handshake, status): {answered:?}");
    for (method, path, upgrade, expected) in open {
        let headers = if upgrade { &UPGRADE[..] } else { &[] };
        let (status, body) = daemon.request(method, path, headers)?;
        ensure!(status == expected, "{method} {path}: {status} {body}");
    }
    Ok(())
}

pub fn whoever_lacks_a_token_is_told_how_to_give_one() -> Verdict {
    let daemon = start_guarded("told")?;
    let server = format!("http://{}", daemon.address);
    let deployer = daemon.deployer();
    deployer.run(&["--server", &server, "services"])?.expect_failure(&["--token", "CLOUDROID_TOKEN"])?;
    deployer.run(&["--server", &server, "--token", "guess", "services"])?.expect_failure(&["not known", "--token"])?;
    deployer.run(&["--server", &server, "--token", "open sesame", "services"])?.expect_success()?;
    // Root of this machine needs none on the socket.
    deployer.run(&["services"])?.expect_success()?;
    let (status, body) = daemon.get("/api/v1/services")?;
    ensure!(
        status == 401 && body.contains("Authorization: Bearer TOKEN") && body.contains("?token="),
        "{status} {body}"
    );
    ensure!(daemon.get("/api/v1/services?token=open%20sesame")?.0 == 200);
    Ok(())
}

pub fn a_proxy_s_clients_are_told_from_this_machine_s() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let (status, body) =
        daemon.request("GET", "/api/v1/services", &[("Host", "localhost"), ("X-Forwarded-Proto", "https")])?;
    ensure!(status == 403 && body.contains("configure tokens"), "{status} {body}");
    Ok(())
}

pub fn a_page_of_another_site_uses_nobodys_browser() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let evil = [
        // A page that uses fetch, and one whose name was changed to resolve to this machine.
        ("Origin", "http://evil.example"),
        ("Origin", "null"),
        ("Host", "evil.example"),
    ];
    for header in evil {
        for path in ["/api/v1/services", "/adder_py"] {
            for upgrade in [&[][..], &UPGRADE[..]] {
                let headers = [upgrade, &[header]].concat();
                let (status, body) = daemon.request("GET", path, &headers)?;
                ensure!(status == 403 && !body.contains("revision"), "{header:?} {path}: {status} {body}");
            }
        }
    }
    ensure!(daemon.get("/api/v1/services")?.0 == 200);
    Ok(())
}

pub fn services_are_told_to_those_who_have_shown_a_token() -> Verdict {
    let daemon = start_guarded("untold")?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    for path in ["", "adder_py", "no_such_service"] {
        if let Err(refusal) = Robot::try_connect(&daemon.url(path)) {
            ensure!(refusal.status == 401, "{path:?}: {refusal}");
            ensure!(!refusal.body.contains("adder_py"), "{path:?}: {refusal}");
        }
    }
    let mut guesser = daemon.robot("no_such_service")?;
    guesser.send(json!({"op": "auth", "mac": "guess"}))?;
    let close = guesser.wait_for_close()?;
    ensure!(u16::from(close.code) == 1008 && !close.reason.contains("service"), "{close:?}");
    let mut known = daemon.robot("no_such_service")?;
    known.send(json!({"op": "auth", "mac": "open sesame"}))?;
    let close = known.wait_for_close()?;
    ensure!(close.reason.contains("no_such_service"), "{close:?}");
    let Err(refusal) = Robot::try_connect(&daemon.url("no_such_service?token=open%20sesame")) else {
        anyhow::bail!("an unknown service accepted a robot")
    };
    ensure!(refusal.status == 404 && refusal.body.contains("adder_py"), "{refusal}");
    // The auth message of rosbridge gives access.
    let mut robot = daemon.robot("adder_py")?;
    robot.send(json!({"op": "auth", "mac": "open sesame"}))?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    Ok(())
}

pub fn a_resume_token_is_no_way_into_another_s_servant() -> Verdict {
    let daemon = world()
        .setup("resumers")
        .config("tokens = [\"open sesame\", \"rosebuds\"]\n[servant]\nanonymous_grace = \"60s\"\n")
        .start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let asks = |token: &str| daemon.robot(&format!("adder_py?resume=mine&token={token}"));
    let count = || Ok::<_, anyhow::Error>(daemon.servants_of("adder_py")?.len());
    let first = asks("open%20sesame")?;
    let second = asks("rosebuds")?;
    ensure!(count()? == 2, "two tokens share a servant");
    let third = asks("rosebuds")?;
    ensure!(count()? == 2, "one token has two servants");
    drop((first, second, third));
    Ok(())
}
