//! Words of the audit log for requests: what each does, as an order.

use axum::http::Method;

use crate::route_access::matches_path;

/// Routes that change something, by method and path. A test compares them with the route table.
const ROUTE_WORDS: &[(&str, &str, &str)] = &[
    ("DELETE", "/api/v1/services/{name}", "remove"),
    ("POST", "/api/v1/services/{name}/rollback", "roll back"),
    ("POST", "/api/v1/services/{name}/rollout", "order a rollout"),
    ("POST", "/api/v1/services/{name}/trial", "try"),
    ("POST", "/api/v1/services/{name}/calibration", "calibrate"),
    ("POST", "/api/v1/services/{name}/shadow", "shadow"),
    ("PUT", "/api/v1/services/{name}/sla", "write the SLA table"),
    ("DELETE", "/api/v1/services/{name}/sla/{id}", "remove an entry of the SLA table"),
    ("DELETE", "/api/v1/servants", "stop servants"),
    ("PATCH", "/api/v1/servants/{id}", "set limits"),
    ("DELETE", "/api/v1/servants/{id}", "stop"),
    ("GET", "/api/v1/servants/{id}/exec", "start a program"),
    ("POST", "/api/v1/servants/{id}/recording", "take a recording"),
    ("DELETE", "/api/v1/recordings/{number}", "remove a recording"),
    ("POST", "/api/v1/session", "sign in"),
    ("DELETE", "/api/v1/session", "sign out"),
    ("POST", "/api/v1/accounts", "create an account"),
    ("PATCH", "/api/v1/accounts/{name}", "change an account"),
    ("DELETE", "/api/v1/accounts/{name}", "remove an account"),
    ("DELETE", "/api/v1/accounts/{name}/sessions", "end sessions"),
    ("POST", "/api/v1/tokens", "create a token"),
    ("DELETE", "/api/v1/tokens/{name}", "revoke a token"),
    ("POST", "/api/v1/tokens/{name}/rotate", "rotate a token"),
    ("POST", "/api/v1/policy", "add a rule"),
    ("DELETE", "/api/v1/policy/{id}", "remove a rule"),
    ("POST", "/api/v1/pairings", "begin a pairing"),
    ("DELETE", "/api/v1/pairings/{name}", "unpair"),
    ("DELETE", "/api/v1/pairings/{name}/code", "cancel a pairing"),
    ("POST", "/api/v1/pair", "pair by a code"),
    ("POST", "/api/v1/renew", "renew a certificate"),
    ("POST", "/api/v1/push", "begin a push"),
    ("DELETE", "/api/v1/pushes/{number}", "cancel a push"),
    ("DELETE", "/api/v1/underlays/{name}", "remove an underlay"),
    ("POST", "/api/v1/bases", "import a base"),
    ("PUT", "/api/v1/bases/{name}", "make a base from an image"),
    ("DELETE", "/api/v1/bases/{name}", "remove a base"),
];

/// Describes a request: what it does or, if it only reads, what it reads.
pub fn describe_request(method: &Method, path: &str) -> String {
    let row = ROUTE_WORDS.iter().find(|(of, pattern, _)| method.as_str() == *of && matches_path(pattern, path));
    match row {
        Some((_, _, words)) => (*words).to_owned(),
        None if *method == Method::GET || *method == Method::HEAD => format!("read {path}"),
        None => format!("ask for {method} {path}"),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::audit::is_recorded;
    use crate::route_access::Access;
    use crate::routes::ROUTES;

    #[test]
    fn each_route_that_changes_something_has_words_of_its_own() {
        let recorded_by_their_handlers =
            ["GET /api/v1/servants/{id}/exec", "DELETE /api/v1/session", "POST /api/v1/renew"];
        let changes = ROUTES.iter().filter(|route| {
            let method: Method = route.method.parse().expect("a method");
            match route.access {
                Access::May(action, _) => is_recorded(action, &method),
                Access::Code | Access::SignIn => method == Method::POST,
                Access::Read | Access::Connect | Access::ReadOrConnect => false,
            }
        });
        let changes = changes.map(|route| format!("{} {}", route.method, route.path));
        let changes: BTreeSet<String> =
            changes.chain(recorded_by_their_handlers.into_iter().map(str::to_owned)).collect();
        let told: BTreeSet<String> = ROUTE_WORDS.iter().map(|(method, path, _)| format!("{method} {path}")).collect();
        assert_eq!(told, changes);
        let words: BTreeSet<&str> = ROUTE_WORDS.iter().map(|(_, _, words)| *words).collect();
        assert_eq!(words.len(), ROUTE_WORDS.len(), "two have the same words");
        for (method, path, _) in ROUTE_WORDS {
            assert!(ROUTES.iter().any(|route| (route.method, route.path) == (*method, *path)), "{method} {path}");
        }
    }

    #[test]
    fn a_request_is_told_by_what_it_does() {
        for (method, path, words) in [
            (Method::DELETE, "/api/v1/services/adder_py", "remove"),
            (Method::DELETE, "/api/v1/tokens/alice", "revoke a token"),
            (Method::POST, "/api/v1/push", "begin a push"),
            (Method::GET, "/api/v1/servants/s1/logs", "read /api/v1/servants/s1/logs"),
            (Method::HEAD, "/api/v1/tokens", "read /api/v1/tokens"),
            (Method::POST, "/nothing/there", "ask for POST /nothing/there"),
        ] {
            assert_eq!(describe_request(&method, path), words, "{method} {path}");
        }
    }
}
