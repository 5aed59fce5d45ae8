//! Holders of tokens who want more: robots, deployers, viewers, operators.

use anyhow::ensure;
use serde_json::json;
use support::Verdict;

use super::scene::{BreakinScene, RequestAttempt};
use super::{people, sockets};

/// Statuses of requests that are not permitted.
const NO: &[u16] = &[403];
/// Statuses of malformed requests and unknown addresses.
const NOWHERE: &[u16] = &[400, 403, 404, 405, 414];

/// Administration, which is for admins only.
pub fn administration_attempts<'a>() -> Vec<RequestAttempt<'a>> {
    let new = |role: &str| json!({"name": "mallory", "role": role, "services": ["*"], "robot": "r1"});
    let person = json!({"name": "mallory", "password": "long enough a password", "role": "admin"});
    let rule = |who: &str| json!({"who": who, "services": "*", "allow": ["*:/**"]});
    let mut attempts: Vec<_> = ["admin", "operator", "deployer", "robot", "viewer"]
        .into_iter()
        .map(|role| RequestAttempt::new("POST", "/api/v1/tokens", NO).body(new(role)))
        .collect();
    attempts.extend([
        RequestAttempt::new("POST", "/api/v1/accounts", NO).body(person),
        RequestAttempt::new("PATCH", "/api/v1/accounts/carol", NO).body(json!({"role": "admin"})),
        RequestAttempt::new("PATCH", "/api/v1/accounts/carol", NO)
            .body(json!({"password": "four loud orange engines"})),
        RequestAttempt::new("DELETE", "/api/v1/accounts/carol", NO),
        RequestAttempt::new("DELETE", "/api/v1/accounts/carol/sessions", NO),
        RequestAttempt::new("POST", "/api/v1/policy", NO).body(rule("narrow")),
        RequestAttempt::new("POST", "/api/v1/policy", NO).body(rule("role:viewer")),
        RequestAttempt::new("DELETE", "/api/v1/policy/1", NO),
        RequestAttempt::new("DELETE", "/api/v1/tokens/chief", NO),
        // For a revoked token the response does not say that it is revoked.
        RequestAttempt::new("DELETE", "/api/v1/tokens/over", NO),
        RequestAttempt::new("DELETE", "/api/v1/tokens/nobody", NO),
    ]);
    for name in ["chief", "olga", "alice", "rover", "eve", "over", "nobody", "*"] {
        attempts.push(RequestAttempt::new("POST", format!("/api/v1/tokens/{name}/rotate"), NO));
    }
    for path in ["tokens", "accounts", "sessions", "policy", "audit", "audit?follow=true"] {
        attempts.push(RequestAttempt::new("GET", format!("/api/v1/{path}"), NO));
        attempts.push(RequestAttempt::new("HEAD", format!("/api/v1/{path}"), NO));
    }
    attempts
}

/// The machine, and pairing, which are for operators.
fn operation_attempts<'a>() -> Vec<RequestAttempt<'a>> {
    let robot = |name: &str| json!({"robot": name, "services": ["*"]});
    vec![
        RequestAttempt::new("GET", "/api/v1/pairings", NO),
        RequestAttempt::new("POST", "/api/v1/pairings", NO).body(robot("r1")),
        RequestAttempt::new("POST", "/api/v1/pairings", NO).body(robot("mallory")),
        RequestAttempt::new("DELETE", "/api/v1/pairings/r1", NO),
        RequestAttempt::new("DELETE", "/api/v1/pairings/r1/code", NO),
        RequestAttempt::new("DELETE", "/api/v1/servants", NO),
        RequestAttempt::new("DELETE", "/api/v1/servants?service=", NO),
        RequestAttempt::new("DELETE", "/api/v1/servants?service=*", NO),
        RequestAttempt::new("DELETE", "/api/v1/servants?service=vault", NO),
        RequestAttempt::new("DELETE", "/api/v1/servants?service=adder_py&service=vault", &[400, 403]),
        // Only through TLS, and by the robot that shows its certificate.
        RequestAttempt::new("POST", "/api/v1/renew", &[400]).body(json!({"request": "x"})),
        RequestAttempt::new("POST", "/api/v1/pair", &[400])
            .body(json!({"robot": "r1", "code": "a".repeat(26), "request": "x"})),
    ]
}

/// Requests that change a service or its servants, or return the output of its nodes.
fn change_attempts<'a>(service: &str, servant: &str) -> Vec<RequestAttempt<'a>> {
    let of = |path: &str| format!("/api/v1/services/{service}{path}");
    let servant = |path: &str| format!("/api/v1/servants/{servant}{path}");
    let row = json!({"rows": [], "replace": true});
    vec![
        RequestAttempt::new("DELETE", of(""), NO),
        RequestAttempt::new("POST", of("/rollback"), NO),
        RequestAttempt::new("POST", of("/rollback"), NO).body(json!({"revision": 1})),
        RequestAttempt::new("POST", of("/rollout"), NO).body(json!("abort")),
        RequestAttempt::new("POST", of("/trial?kind=bag"), NO),
        RequestAttempt::new("POST", of("/calibration"), NO),
        RequestAttempt::new("POST", of("/shadow"), NO).body(json!({"robot": "r1"})),
        RequestAttempt::new("PUT", of("/sla"), NO).body(row),
        RequestAttempt::new("DELETE", of("/sla/1"), NO),
        RequestAttempt::new("GET", servant("/logs"), NO),
        RequestAttempt::new("GET", servant("/logs?follow=true"), NO),
        RequestAttempt::new("HEAD", servant("/logs"), NO),
        RequestAttempt::new("POST", servant("/recording"), NO),
        RequestAttempt::new("GET", of("/record"), NO),
        RequestAttempt::new("PATCH", servant(""), NO).body(json!({"cpus": 0.01})),
        RequestAttempt::new("DELETE", servant(""), NO),
        RequestAttempt::new("DELETE", format!("/api/v1/servants?service={service}"), NO),
        push_attempt(json!({"name": service}), NO),
    ]
}

fn push_attempt<'a>(options: serde_json::Value, status: &'a [u16]) -> RequestAttempt<'a> {
    let mut options = options;
    options["nodes"] = json!(["x"]);
    let text: String = options.to_string().bytes().map(|byte| format!("%{byte:02x}")).collect();
    RequestAttempt::new("POST", format!("/api/v1/push?options={text}"), status)
}

/// Information about a service for those who may see it.
fn read_attempts<'a>(service: &str, image: &str, servant: &str) -> Vec<RequestAttempt<'a>> {
    let mut attempts: Vec<_> = ["", "/interface", "/fit", "/rollout", "/sla", "/sla/explain?rrt=1s"]
        .into_iter()
        .map(|path| RequestAttempt::new("GET", format!("/api/v1/services/{service}{path}"), NO))
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
        format!("/api/v1/servants/{servant}/exec"),
        format!("/api/v1/servants/{servant}/inside"),
        format!("/api/v1/servants/{servant}/topics"),
        format!("/api/v1/servants/{servant}/goals"),
        format!("/foxglove/{servant}"),
    ] {
        attempts.push(RequestAttempt::new("HEAD", path.clone(), NO));
        attempts.push(RequestAttempt::new("GET", path, NO));
    }
    // A blob of another service's image, requested through the own one.
    attempts.push(RequestAttempt::new("GET", format!("/v2/adder_py/manifests/{image}"), &[404]));
    attempts.push(RequestAttempt::new("GET", format!("/v2/adder_py/blobs/{image}"), &[404]));
    attempts
}

/// Paths that refer to something other than they seem to.
fn path_attempts<'a>() -> Vec<RequestAttempt<'a>> {
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
    .map(|path| RequestAttempt::new("GET", path, NOWHERE))
    .collect()
}

/// Methods that the route does not have, and ways to override the method.
fn method_attempts<'a>() -> Vec<RequestAttempt<'a>> {
    const REFUSED: &[u16] = &[400, 403, 404, 405];
    let mut attempts = Vec::new();
    for method in ["OPTIONS", "TRACE", "PUT", "PATCH", "PROPFIND", "DELETE ", "delete", "GETX"] {
        attempts.push(RequestAttempt::new(method.trim(), "/api/v1/tokens", REFUSED));
        attempts.push(RequestAttempt::new(method.trim(), "/api/v1/services/vault", REFUSED));
    }
    for header in ["X-HTTP-Method-Override", "X-HTTP-Method", "X-Method-Override"] {
        attempts.push(RequestAttempt::new("POST", "/api/v1/services/vault", REFUSED).header(header, "DELETE"));
        attempts.push(RequestAttempt::new("GET", "/api/v1/policy/1", REFUSED).header(header, "DELETE"));
    }
    for header in ["X-Original-URL", "X-Rewrite-URL", "X-Forwarded-Uri"] {
        attempts.push(RequestAttempt::new("GET", "/nowhere/at/all", REFUSED).header(header, "/api/v1/tokens"));
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
        attempts.push(RequestAttempt::new("GET", "/api/v1/tokens", REFUSED).header(header, value));
    }
    for query in ["_method=DELETE", "method=DELETE", "role=admin", "robot=r9", "as=chief", "user=root"] {
        attempts.push(RequestAttempt::new("POST", format!("/api/v1/services/vault?{query}"), REFUSED));
        attempts.push(RequestAttempt::new("GET", format!("/api/v1/tokens?{query}"), REFUSED));
    }
    attempts
}

/// Names and options that a deployer may not publish with.
fn publish_attempts<'a>() -> Vec<RequestAttempt<'a>> {
    const BAD: &[u16] = &[400, 403, 409, 422];
    let mut attempts = Vec::new();
    // Outside of its scope, reserved by the system, or similar to another name.
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
        attempts.push(push_attempt(json!({"name": name}), BAD));
    }
    attempts.push(push_attempt(json!({"name": "a".repeat(100_000 / 30)}), BAD));
    // Options that it may not grant: directories and devices of the server, egress, limits, another owner.
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
        attempts.push(push_attempt(options, BAD));
    }
    // Errors during the push are reported in the last line of the response.
    for base in ["../../etc", "/etc/shadow"] {
        attempts.push(push_attempt(json!({"name": "adder_new", "base": base}), &[200]));
    }
    attempts.push(RequestAttempt::new("POST", "/api/v1/push?options=%7B", &[400]));
    attempts.push(RequestAttempt::new("POST", "/api/v1/push?options=%7B%22name%22%3A1%7D", &[400]));
    attempts
}

/// Invalid tokens, and tokens shown next to another one.
fn token_attempts<'a>(scene: &BreakinScene) -> Vec<RequestAttempt<'a>> {
    const NOBODY: &[u16] = &[401, 429];
    let tokens = &scene.tokens;
    let at = |path: &str| RequestAttempt::new("GET", path, NOBODY);
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
    // The more secure way of showing a token takes precedence, whatever the other one contains.
    for (header, query) in [(&tokens.eve, &tokens.admin), (&tokens.rover, &tokens.admin)] {
        let path = format!("/api/v1/tokens?token={query}");
        attempts.push(RequestAttempt::new("GET", path, NO).bearer(header));
        let path = format!("/api/v1/tokens?token={header}&token={query}");
        attempts.push(RequestAttempt::new("GET", path, NO));
        let twice = RequestAttempt::new("GET", "/api/v1/tokens", &[400, 403]);
        attempts.push(twice.bearer(header).bearer(query));
    }
    attempts
}

pub fn nobody_gets_beyond_its_role_and_scope() -> Verdict {
    let mut scene = BreakinScene::new("breakin")?;
    let tokens = &scene.tokens;
    let [r1, r2, r9] = &scene.servants;
    let kept = [r9.as_str(), scene.image.as_str()];
    let fail = |who: &str, token: &str, kept: &[&str], attempts| scene.all_fail(who, Some(token), kept, attempts);
    // Principals who may not see vault.
    for (who, token) in [("a robot", &tokens.rover), ("a viewer", &tokens.eve), ("a deployer", &tokens.alice)] {
        fail(who, token, &kept, read_attempts("vault", &scene.image, r9))?;
        fail(who, token, &kept, path_attempts())?;
        fail(who, token, &kept, change_attempts("vault", r9))?;
    }
    // Principals who may not change anything that they see.
    for (who, token) in [
        ("a robot", &tokens.rover),
        ("a viewer", &tokens.eve),
        ("a viewer of all", &tokens.oscar),
        ("a deployer whose it is not", &tokens.bob),
    ] {
        fail(who, token, &[], change_attempts("adder_py", r1))?;
        fail(who, token, &[], operation_attempts())?;
        fail(who, token, &[], method_attempts())?;
    }
    for (who, token) in [
        ("an operator", &tokens.operator),
        ("a deployer", &tokens.alice),
        ("a robot", &tokens.rover),
        ("a viewer of all", &tokens.oscar),
    ] {
        fail(who, token, &[], administration_attempts())?;
    }
    fail("a deployer", &tokens.alice, &kept, operation_attempts())?;
    fail("a deployer", &tokens.alice, &kept, publish_attempts())?;
    // A robot sees only its own servant, although it may use the other's service as well.
    let beside = [r2.as_str()];
    let others = ["", "/logs", "/exec", "/inside"]
        .map(|path| RequestAttempt::new("GET", format!("/api/v1/servants/{r2}{path}"), NO));
    fail("a robot", &tokens.rover, &beside, others.into())?;
    fail(
        "a robot",
        &tokens.rover,
        &beside,
        vec![
            RequestAttempt::new("GET", "/api/v1/servants", &[200]),
            RequestAttempt::new("GET", "/api/v1/servants?robot=r2", &[200]),
            RequestAttempt::new("GET", "/api/v1/events?limit=1000", &[200]),
            RequestAttempt::new("GET", format!("/api/v1/events?servant={r2}"), &[200]),
            RequestAttempt::new("GET", "/api/v1/events?robot=r2", &[200]),
            RequestAttempt::new("GET", "/api/v1/services/adder_py", &[200]),
            RequestAttempt::new("GET", "/api/v1/services/adder_py/fit?cpus=100", &[200, 422]),
            RequestAttempt::new("GET", "/api/v1/robots/r2/explain", NO),
            RequestAttempt::new("GET", "/api/v1/back-offs", &[200]),
        ],
    )?;
    for (who, token) in [("a robot", &tokens.rover), ("a viewer", &tokens.eve)] {
        let lists = ["services", "servants", "logs", "events?limit=1000", "events?service=vault", "back-offs"];
        let mut lists: Vec<_> =
            lists.into_iter().map(|path| RequestAttempt::new("GET", format!("/api/v1/{path}"), &[200])).collect();
        lists.push(RequestAttempt::new("GET", "/stubs", &[200]));
        lists.push(RequestAttempt::new("GET", "/v2/_catalog", &[200]));
        fail(who, token, &["vault", r9], lists)?;
    }
    scene.all_fail("who shows it badly", None, &kept, token_attempts(&scene))?;
    people::cannot_be_made_to_ask(&scene)?;
    sockets::nobody_is_somebody_else(&scene)?;
    sockets::nobody_uses_what_it_is_not_granted(&scene)?;
    scene.expect_robots_working()?;
    println!("{} attempts", scene.attempt_count());
    ensure!(scene.attempt_count() > 1000, "{}", scene.attempt_count());
    Ok(())
}
