//! Who has a token, and wants more: robots, deployers, viewers, operators.

use anyhow::ensure;
use serde_json::json;
use support::Verdict;

use super::scene::{Attempt, Scene};
use super::{people, sockets};

/// Refused as what it may not do.
const NO: &[u16] = &[403];
/// Where what is asked for has no such form, or is nowhere.
const NOWHERE: &[u16] = &[400, 403, 404, 405, 414];

/// Administration: for admins alone.
pub fn administration<'a>() -> Vec<Attempt<'a>> {
    let new =
        |role: &str| json!({"name": "mallory", "role": role, "services": ["*"], "robot": "r1"});
    let person = json!({"name": "mallory", "password": "long enough a password", "role": "admin"});
    let rule = |who: &str| json!({"who": who, "services": "*", "allow": ["*:/**"]});
    let mut attempts: Vec<_> = ["admin", "operator", "deployer", "robot", "viewer"]
        .into_iter()
        .map(|role| Attempt::new("POST", "/api/v1/tokens", NO).body(new(role)))
        .collect();
    attempts.extend([
        Attempt::new("POST", "/api/v1/accounts", NO).body(person),
        Attempt::new("PATCH", "/api/v1/accounts/carol", NO).body(json!({"role": "admin"})),
        Attempt::new("PATCH", "/api/v1/accounts/carol", NO)
            .body(json!({"password": "four loud orange engines"})),
        Attempt::new("DELETE", "/api/v1/accounts/carol", NO),
        Attempt::new("DELETE", "/api/v1/accounts/carol/sessions", NO),
        Attempt::new("POST", "/api/v1/policy", NO).body(rule("narrow")),
        Attempt::new("POST", "/api/v1/policy", NO).body(rule("role:viewer")),
        Attempt::new("DELETE", "/api/v1/policy/1", NO),
        Attempt::new("DELETE", "/api/v1/tokens/chief", NO),
        // Of one that is over it is not told that it is.
        Attempt::new("DELETE", "/api/v1/tokens/over", NO),
        Attempt::new("DELETE", "/api/v1/tokens/nobody", NO),
    ]);
    for name in [
        "chief", "olga", "alice", "rover", "eve", "over", "nobody", "*",
    ] {
        attempts.push(Attempt::new(
            "POST",
            format!("/api/v1/tokens/{name}/rotate"),
            NO,
        ));
    }
    for path in [
        "tokens",
        "accounts",
        "sessions",
        "policy",
        "audit",
        "audit?follow=true",
    ] {
        attempts.push(Attempt::new("GET", format!("/api/v1/{path}"), NO));
        attempts.push(Attempt::new("HEAD", format!("/api/v1/{path}"), NO));
    }
    attempts
}

/// The machine, and pairing: for operators.
fn operation<'a>() -> Vec<Attempt<'a>> {
    let robot = |name: &str| json!({"robot": name, "services": ["*"]});
    vec![
        Attempt::new("GET", "/api/v1/pairings", NO),
        Attempt::new("POST", "/api/v1/pairings", NO).body(robot("r1")),
        Attempt::new("POST", "/api/v1/pairings", NO).body(robot("mallory")),
        Attempt::new("DELETE", "/api/v1/pairings/r1", NO),
        Attempt::new("DELETE", "/api/v1/pairings/r1/code", NO),
        Attempt::new("DELETE", "/api/v1/servants", NO),
        Attempt::new("DELETE", "/api/v1/servants?service=", NO),
        Attempt::new("DELETE", "/api/v1/servants?service=*", NO),
        Attempt::new("DELETE", "/api/v1/servants?service=vault", NO),
        Attempt::new(
            "DELETE",
            "/api/v1/servants?service=adder_py&service=vault",
            &[400, 403],
        ),
        // Through TLS and by the robot that shows its certificate alone.
        Attempt::new("POST", "/api/v1/renew", &[400]).body(json!({"request": "x"})),
        Attempt::new("POST", "/api/v1/pair", &[400])
            .body(json!({"robot": "r1", "code": "a".repeat(26), "request": "x"})),
    ]
}

/// What changes a service or its servants, or tells what its nodes print.
fn changes<'a>(service: &str, servant: &str) -> Vec<Attempt<'a>> {
    let of = |path: &str| format!("/api/v1/services/{service}{path}");
    let servant = |path: &str| format!("/api/v1/servants/{servant}{path}");
    let row = json!({"rows": [], "replace": true});
    vec![
        Attempt::new("DELETE", of(""), NO),
        Attempt::new("POST", of("/rollback"), NO),
        Attempt::new("POST", of("/rollback"), NO).body(json!({"revision": 1})),
        Attempt::new("POST", of("/rollout"), NO).body(json!("abort")),
        Attempt::new("POST", of("/trial?kind=bag"), NO),
        Attempt::new("POST", of("/calibration"), NO),
        Attempt::new("POST", of("/shadow"), NO).body(json!({"robot": "r1"})),
        Attempt::new("PUT", of("/sla"), NO).body(row),
        Attempt::new("DELETE", of("/sla/1"), NO),
        Attempt::new("GET", servant("/logs"), NO),
        Attempt::new("GET", servant("/logs?follow=true"), NO),
        Attempt::new("HEAD", servant("/logs"), NO),
        Attempt::new("POST", servant("/recording"), NO),
        Attempt::new("GET", of("/record"), NO),
        Attempt::new("PATCH", servant(""), NO).body(json!({"cpus": 0.01})),
        Attempt::new("DELETE", servant(""), NO),
        Attempt::new("DELETE", format!("/api/v1/servants?service={service}"), NO),
        pushes(json!({"name": service}), NO),
    ]
}

fn pushes<'a>(options: serde_json::Value, status: &'a [u16]) -> Attempt<'a> {
    let mut options = options;
    options["nodes"] = json!(["x"]);
    let text: String = options
        .to_string()
        .bytes()
        .map(|byte| format!("%{byte:02x}"))
        .collect();
    Attempt::new("POST", format!("/api/v1/push?options={text}"), status)
}

/// What is told of a service to those who see it.
fn reads<'a>(service: &str, image: &str, servant: &str) -> Vec<Attempt<'a>> {
    let mut attempts: Vec<_> = [
        "",
        "/interface",
        "/fit",
        "/rollout",
        "/sla",
        "/sla/explain?rrt=1s",
    ]
    .into_iter()
    .map(|path| Attempt::new("GET", format!("/api/v1/services/{service}{path}"), NO))
    .collect();
    for path in [
        format!("/v2/{service}/tags/list"),
        format!("/v2/{service}/manifests/latest"),
        format!("/v2/{service}/manifests/1"),
        format!("/v2/{service}/manifests/{image}"),
        format!("/v2/{service}/blobs/{image}"),
        format!("/stubs/{service}.tar.gz"),
        format!("/stubs/{service}.tar.gz.sig"),
        format!("/{service}"),
        format!("/{service}/"),
        format!("/api/v1/servants/{servant}"),
        format!("/api/v1/servants/{servant}/inside"),
        format!("/api/v1/servants/{servant}/topics"),
        format!("/api/v1/servants/{servant}/goals"),
        format!("/foxglove/{servant}"),
    ] {
        attempts.push(Attempt::new("HEAD", path.clone(), NO));
        attempts.push(Attempt::new("GET", path, NO));
    }
    // Of another service's image, by way of one's own.
    attempts.push(Attempt::new(
        "GET",
        format!("/v2/adder_py/manifests/{image}"),
        &[404],
    ));
    attempts.push(Attempt::new(
        "GET",
        format!("/v2/adder_py/blobs/{image}"),
        &[404],
    ));
    attempts
}

/// Ways to write an address that lead elsewhere than they look.
fn paths<'a>() -> Vec<Attempt<'a>> {
    [
        "/api/v1/services/%76ault",
        "/api/v1/services/%2576ault",
        "/api/v1/services/vault/",
        "/api/v1/services/vault//",
        "/api/v1/services//vault",
        "//api/v1/services/vault",
        "/api//v1/services/vault",
        "/api/v1/services/./vault",
        "/api/v1/services/adder_py/../vault",
        "/api/v1/services/adder_py/%2e%2e/vault",
        "/api/v1/services/adder_py%2f..%2fvault",
        "/api/v1/services/adder_py%2F%2E%2E%2Fvault",
        "/api/v1/services/adder_py\\..\\vault",
        "/api/v1/services/adder_py%5c..%5cvault",
        "/api/v1/services/vault;name=adder_py",
        "/api/v1/services/adder_py;/../vault",
        "/api/v1/services/vault%00",
        "/api/v1/services/adder_py%00vault",
        "/api/v1/services/vault%20",
        "/api/v1/services/%20vault",
        "/api/v1/services/VAULT",
        "/API/v1/services/vault",
        "/api/V1/services/vault",
        "/api/v1/services/va%C5%ABlt",
        "/api/v1/services/%ff%fe",
        "/api/v1/services/*",
        "/api/v1/services/v%61*",
        "/api/v1/services/adder_py,vault",
        "/api/v1/services/%7Bname%7D",
        "/api/v1/services/vault?name=adder_py",
        "/api/v1/services/vault/interface/../../adder_py",
        "/api/v1/robots/r1/../r9/explain",
        "/api/v1/robots/r9%00r1/explain",
        "/api/v1/robots/r9/explain",
        "/api/v1/robots/*/explain",
        "/api/v1/robots/~/explain",
        "/stubs/vault.tar.gz?arch=../../../../etc",
        "/stubs/adder_py.tar.gz/../vault.tar.gz",
        "/stubs/..%2f..%2fcloudroid.db.tar.gz",
        "/stubs/%2fetc%2fpasswd.tar.gz",
        "/stubs/vault.tar.gz%00adder_py.tar.gz",
        "/stubs/vault.tar.gz.tar.gz",
        "/stubs/vault%2etar%2egz",
        "/stubs/.tar.gz",
        "/assets/..%2fcloudroid.db",
        "/assets/%2e%2e%2ftls%2fown.key",
        "/assets/..%5c..%5cetc%5cpasswd",
        "/assets/portal.js%00.css",
        "/v2/adder_py/manifests/..%2f..%2fvault%2fmanifests%2flatest",
        "/v2/adder_py/manifests/../../vault/manifests/latest",
        "/v2/adder_py/blobs/sha256:..%2f..%2f..%2fcloudroid.db",
        "/v2/adder_py/blobs/sha256:0000",
        "/v2/vault%2fadder_py/manifests/latest",
        "/v2/./vault/manifests/latest",
        "/%76ault",
        "/vault/adder_py",
        "/adder_py/../vault",
        "/metrics/",
        "/%6detrics",
        "/healthz/../metrics",
        "/api/v1/push/../tokens",
    ]
    .into_iter()
    .map(|path| Attempt::new("GET", path, NOWHERE))
    .collect()
}

/// Methods that are none of the row's, and ways to say another than is written.
fn methods<'a>() -> Vec<Attempt<'a>> {
    const REFUSED: &[u16] = &[400, 403, 404, 405];
    let mut attempts = Vec::new();
    for method in [
        "OPTIONS", "TRACE", "PUT", "PATCH", "PROPFIND", "DELETE ", "delete", "GETX",
    ] {
        attempts.push(Attempt::new(method.trim(), "/api/v1/tokens", REFUSED));
        attempts.push(Attempt::new(
            method.trim(),
            "/api/v1/services/vault",
            REFUSED,
        ));
    }
    for header in [
        "X-HTTP-Method-Override",
        "X-HTTP-Method",
        "X-Method-Override",
    ] {
        attempts
            .push(Attempt::new("POST", "/api/v1/services/vault", REFUSED).header(header, "DELETE"));
        attempts.push(Attempt::new("GET", "/api/v1/policy/1", REFUSED).header(header, "DELETE"));
    }
    for header in ["X-Original-URL", "X-Rewrite-URL", "X-Forwarded-Uri"] {
        attempts
            .push(Attempt::new("GET", "/nowhere/at/all", REFUSED).header(header, "/api/v1/tokens"));
    }
    for (header, value) in [
        ("X-Forwarded-For", "127.0.0.1"),
        ("Forwarded", "for=127.0.0.1;proto=https"),
        ("X-Real-IP", "127.0.0.1"),
        ("X-Remote-User", "root"),
        ("Remote-User", "chief"),
        ("X-Forwarded-User", "chief"),
        ("X-SSL-Client-Verify", "SUCCESS"),
        ("Host", "localhost"),
        ("X-Robot", "r9"),
        ("Authorization", "Bearer"),
    ] {
        attempts.push(Attempt::new("GET", "/api/v1/tokens", REFUSED).header(header, value));
    }
    for query in [
        "_method=DELETE",
        "method=DELETE",
        "role=admin",
        "robot=r9",
        "as=chief",
        "user=root",
    ] {
        attempts.push(Attempt::new(
            "POST",
            format!("/api/v1/services/vault?{query}"),
            REFUSED,
        ));
        attempts.push(Attempt::new(
            "GET",
            format!("/api/v1/tokens?{query}"),
            REFUSED,
        ));
    }
    attempts
}

/// What a deployer may not publish, nor how.
fn publishing<'a>() -> Vec<Attempt<'a>> {
    const BAD: &[u16] = &[400, 403, 409, 422];
    let mut attempts = Vec::new();
    // Outside its scope, the system's, and such as look like another's.
    for name in [
        "vault",
        "other",
        "api",
        "v2",
        "stubs",
        "metrics",
        "healthz",
        "assets",
        "API",
        "Adder_py",
        "adder*",
        "*",
        "adder_py/../vault",
        "adder_py\u{0}",
        "\u{430}dder_py",
        "adder_py ",
        " adder_py",
        "adder_py\n",
        "-adder",
        "adder_",
        "../adder",
        "adder.py",
        "",
    ] {
        attempts.push(pushes(json!({"name": name}), BAD));
    }
    attempts.push(pushes(json!({"name": "a".repeat(100_000 / 30)}), BAD));
    // More than it may give: directories and devices of the server, ways out, limits, somebody else's name.
    for options in [
        json!({"name": "adder_new", "owner": "chief"}),
        json!({"name": "adder_new", "grants": {"volumes": ["/:/host"]}}),
        json!({"name": "adder_new", "grants": {"volumes": ["models:/models"]}}),
        json!({"name": "adder_new", "grants": {"devices": ["/dev/sda"]}}),
        json!({"name": "adder_new", "grants": {"devices": ["vendor.example/gpu=all"]}}),
        json!({"name": "adder_new", "grants": {"egress": ["0.0.0.0/0"]}}),
        json!({"name": "adder_new", "limits": {"cpus": 1e9}}),
        json!({"name": "adder_new", "limits": {"cpus": -1}}),
        json!({"name": "adder_new", "limits": {"memory": "1000T"}}),
        json!({"name": "adder_new", "sla": {"class": "gold"}}),
    ] {
        attempts.push(pushes(options, BAD));
    }
    // What is found out on the way is the last line of the answer.
    for base in ["../../etc", "/etc/shadow"] {
        attempts.push(pushes(json!({"name": "adder_new", "base": base}), &[200]));
    }
    attempts.push(Attempt::new("POST", "/api/v1/push?options=%7B", &[400]));
    attempts.push(Attempt::new(
        "POST",
        "/api/v1/push?options=%7B%22name%22%3A1%7D",
        &[400],
    ));
    attempts
}

/// Tokens that are none, and such as are shown beside another.
fn showing<'a>(scene: &Scene) -> Vec<Attempt<'a>> {
    const NOBODY: &[u16] = &[401, 429];
    let tokens = &scene.tokens;
    let at = |path: &str| Attempt::new("GET", path, NOBODY);
    let mut attempts = vec![
        at("/api/v1/tokens").bearer(&tokens.over),
        at("/api/v1/tokens").header("Authorization", format!("Basic {}", tokens.admin)),
        at("/api/v1/tokens").header("Authorization", format!("Token {}", tokens.admin)),
        at("/api/v1/tokens").header("Authorization", tokens.admin.clone()),
        at("/api/v1/tokens").header("Authorization", format!("Bearer{}", tokens.admin)),
        at("/api/v1/tokens").header("X-Token", tokens.admin.clone()),
        at("/api/v1/tokens").header("Cookie", format!("token={}", tokens.admin)),
        at("/api/v1/tokens").header("Cookie", format!("cloudroid={}", tokens.admin)),
        at("/api/v1/tokens").bearer(&tokens.admin[..tokens.admin.len() - 1]),
        at("/api/v1/tokens").bearer(&tokens.admin.to_uppercase()),
        at(&format!("/api/v1/tokens?Token={}", tokens.admin)),
        at(&format!("/api/v1/tokens;token={}", tokens.admin)),
        at(&format!("/api/v1/tokens#?token={}", tokens.admin)),
    ];
    // The better way counts, whoever the other shows.
    for (header, query) in [(&tokens.eve, &tokens.admin), (&tokens.rover, &tokens.admin)] {
        let path = format!("/api/v1/tokens?token={query}");
        attempts.push(Attempt::new("GET", path, NO).bearer(header));
        let path = format!("/api/v1/tokens?token={header}&token={query}");
        attempts.push(Attempt::new("GET", path, NO));
        let twice = Attempt::new("GET", "/api/v1/tokens", &[400, 403]);
        attempts.push(twice.bearer(header).bearer(query));
    }
    attempts
}

pub fn nobody_gets_beyond_its_role_and_scope() -> Verdict {
    let mut scene = Scene::new("breakin")?;
    let tokens = &scene.tokens;
    let [r1, r2, r9] = &scene.servants;
    let kept = [r9.as_str(), scene.image.as_str()];
    let fail = |who: &str, token: &str, kept: &[&str], attempts| {
        scene.all_fail(who, Some(token), kept, attempts)
    };
    // Who sees none of vault.
    for (who, token) in [
        ("a robot", &tokens.rover),
        ("a viewer", &tokens.eve),
        ("a deployer", &tokens.alice),
    ] {
        fail(who, token, &kept, reads("vault", &scene.image, r9))?;
        fail(who, token, &kept, paths())?;
        fail(who, token, &kept, changes("vault", r9))?;
    }
    // Who may change nothing of what it sees.
    for (who, token) in [
        ("a robot", &tokens.rover),
        ("a viewer", &tokens.eve),
        ("a viewer of all", &tokens.oscar),
        ("a deployer whose it is not", &tokens.bob),
    ] {
        fail(who, token, &[], changes("adder_py", r1))?;
        fail(who, token, &[], operation())?;
        fail(who, token, &[], methods())?;
    }
    for (who, token) in [
        ("an operator", &tokens.operator),
        ("a deployer", &tokens.alice),
        ("a robot", &tokens.rover),
        ("a viewer of all", &tokens.oscar),
    ] {
        fail(who, token, &[], administration())?;
    }
    fail("a deployer", &tokens.alice, &kept, operation())?;
    fail("a deployer", &tokens.alice, &kept, publishing())?;
    // A robot sees its own servant alone, though the other's service is its own, too.
    let beside = [r2.as_str()];
    let others = ["", "/logs", "/inside"]
        .map(|path| Attempt::new("GET", format!("/api/v1/servants/{r2}{path}"), NO));
    fail("a robot", &tokens.rover, &beside, others.into())?;
    fail(
        "a robot",
        &tokens.rover,
        &beside,
        vec![
            Attempt::new("GET", "/api/v1/servants", &[200]),
            Attempt::new("GET", "/api/v1/servants?robot=r2", &[200]),
            Attempt::new("GET", "/api/v1/events?limit=1000", &[200]),
            Attempt::new("GET", format!("/api/v1/events?servant={r2}"), &[200]),
            Attempt::new("GET", "/api/v1/events?robot=r2", &[200]),
            Attempt::new("GET", "/api/v1/services/adder_py", &[200]),
            Attempt::new("GET", "/api/v1/services/adder_py/fit?cpus=100", &[200, 422]),
            Attempt::new("GET", "/api/v1/robots/r2/explain", NO),
            Attempt::new("GET", "/api/v1/back-offs", &[200]),
        ],
    )?;
    for (who, token) in [("a robot", &tokens.rover), ("a viewer", &tokens.eve)] {
        let lists = [
            "services",
            "servants",
            "events?limit=1000",
            "events?service=vault",
            "back-offs",
        ];
        let mut lists: Vec<_> = lists
            .into_iter()
            .map(|path| Attempt::new("GET", format!("/api/v1/{path}"), &[200]))
            .collect();
        lists.push(Attempt::new("GET", "/stubs", &[200]));
        lists.push(Attempt::new("GET", "/v2/_catalog", &[200]));
        fail(who, token, &["vault", r9], lists)?;
    }
    scene.all_fail("who shows it badly", None, &kept, showing(&scene))?;
    people::cannot_be_made_to_ask(&scene)?;
    sockets::nobody_is_somebody_else(&scene)?;
    sockets::nobody_uses_what_it_is_not_granted(&scene)?;
    scene.goes_on()?;
    println!("{} attempts", scene.tried());
    ensure!(scene.tried() > 1000, "{}", scene.tried());
    Ok(())
}
