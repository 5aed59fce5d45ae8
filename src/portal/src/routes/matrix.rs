//! The matrix of `docs/access.md`: who may use which address. Computed from the route table and the policy, and
//! compared with the document; stories walk it.

use ::access::{AccessAction, AccessObject, Principal, Role, Scope, decide};

use super::{Access, AccessTarget, ROUTES, Route};
use crate::authorisation::check_robot;

/// Principals of the columns, each for the service `mine`; a robot is `me`.
fn columns() -> Vec<(&'static str, Principal)> {
    let of = |role: Role| Principal {
        name: "me".into(),
        roles: vec![role],
        scope: if role.is_scoped() {
            Scope {
                services: "mine".parse().into_iter().collect(),
                robot: (role == Role::Robot).then(|| "me".to_owned()),
                classes: Vec::new(),
            }
        } else {
            Scope::everything()
        },
    };
    vec![
        ("no token", Principal::nobody()),
        ("local", Principal::local()),
        ("viewer", of(Role::Viewer)),
        ("robot", of(Role::Robot)),
        ("deployer", of(Role::Deployer)),
        ("operator", of(Role::Operator)),
        ("admin", of(Role::Admin)),
    ]
}

fn cell_word(everywhere: bool, at_its_own: bool) -> &'static str {
    match (everywhere, at_its_own) {
        (true, _) => "yes",
        (false, true) => "own",
        (false, false) => "-",
    }
}

/// Returns the cell of a route that concerns services.
fn at_services(principal: &Principal, action: AccessAction) -> &'static str {
    let at = |name, owner| {
        let object =
            AccessObject { robot: principal.scope.robot.as_deref(), ..AccessObject::service(name, Some(owner)) };
        decide(principal, action, &object).is_ok()
    };
    cell_word(at("theirs", "them"), at("mine", "me"))
}

fn cell(route: &Route, principal: &Principal) -> &'static str {
    match route.access {
        Access::Read | Access::ReadOrConnect | Access::SignIn => "yes",
        Access::Code => "code",
        Access::Connect if principal.roles.is_empty() => "auth",
        Access::Connect => at_services(principal, AccessAction::Connect),
        Access::May(action, of) => match of {
            AccessTarget::Machine => cell_word(decide(principal, action, &AccessObject::MACHINE).is_ok(), false),
            AccessTarget::Robot(_) => {
                let at = |robot| check_robot(principal, action, robot).is_ok();
                cell_word(at("them"), at("me"))
            }
            AccessTarget::Service(_)
            | AccessTarget::Stub(_)
            | AccessTarget::Servant(_)
            | AccessTarget::Recording(_)
            | AccessTarget::Handler => at_services(principal, action),
        },
    }
}

#[test]
fn the_document_has_the_matrix_as_it_is_decided() {
    let columns = columns();
    let names: Vec<&str> = columns.iter().map(|(name, _)| *name).collect();
    // Addresses for the same callers share a row.
    let mut rows: Vec<(Vec<&str>, Vec<String>)> = Vec::new();
    for route in ROUTES {
        let cells: Vec<&str> = columns.iter().map(|(_, who)| cell(route, who)).collect();
        let address = format!("`{} {}`", route.method, route.path);
        match rows.iter_mut().find(|(known, _)| *known == cells) {
            Some((_, addresses)) => addresses.push(address),
            None => rows.push((cells, vec![address])),
        }
    }
    let mut matrix = format!("| {} | addresses |\n|{}\n", names.join(" | "), "---|".repeat(names.len() + 1));
    for (cells, addresses) in rows {
        matrix += &format!("| {} | {} |\n", cells.join(" | "), addresses.join(", "));
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/access.md");
    let document = std::fs::read_to_string(path).expect("docs/access.md");
    assert!(document.contains(&matrix), "docs/access.md lacks:\n{matrix}");
}
