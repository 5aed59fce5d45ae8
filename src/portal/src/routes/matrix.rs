//! The matrix of `docs/access.md`: who is answered at which address. It is computed from the table of routes and the policy, and
//! compared with the document; stories walk it.

use ::access::{Action, Object, Principal, Role, Scope, decide};

use super::{Access, Of, ROUTES, Route};
use crate::allowed::at_robot;

/// The principals of its columns, each for the service `mine` and, a robot, itself.
fn columns() -> Vec<(&'static str, Principal)> {
    let of = |role: Role| Principal {
        name: "me".into(),
        roles: vec![role],
        scope: match role.is_scoped() {
            false => Scope::everything(),
            true => Scope {
                services: "mine".parse().into_iter().collect(),
                robot: (role == Role::Robot).then(|| "me".to_owned()),
                classes: Vec::new(),
            },
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

fn word(everywhere: bool, at_its_own: bool) -> &'static str {
    match (everywhere, at_its_own) {
        (true, _) => "yes",
        (false, true) => "own",
        (false, false) => "-",
    }
}

/// At services.
fn at_services(principal: &Principal, action: Action) -> &'static str {
    let at = |name, owner| {
        let object = Object {
            robot: principal.scope.robot.as_deref(),
            ..Object::service(name, Some(owner))
        };
        decide(principal, action, &object).is_ok()
    };
    word(at("theirs", "them"), at("mine", "me"))
}

fn cell(route: &Route, principal: &Principal) -> &'static str {
    match route.access {
        Access::Read | Access::ReadOrConnect | Access::SignIn => "yes",
        Access::Code => "code",
        Access::Connect if principal.roles.is_empty() => "auth",
        Access::Connect => at_services(principal, Action::Connect),
        Access::May(action, of) => match of {
            Of::Machine => word(decide(principal, action, &Object::MACHINE).is_ok(), false),
            Of::Robot(_) => {
                let at = |robot| at_robot(principal, action, robot).is_ok();
                word(at("them"), at("me"))
            }
            Of::Service(_) | Of::Stub(_) | Of::Servant(_) | Of::Recording(_) | Of::Handler => {
                at_services(principal, action)
            }
        },
    }
}

#[test]
fn the_document_has_the_matrix_as_it_is_decided() {
    let columns = columns();
    let names: Vec<&str> = columns.iter().map(|(name, _)| *name).collect();
    let mut matrix = format!(
        "| method | address | {} |\n|---|---|{}\n",
        names.join(" | "),
        "---|".repeat(names.len())
    );
    for route in ROUTES {
        let cells: Vec<&str> = columns.iter().map(|(_, who)| cell(route, who)).collect();
        matrix += &format!(
            "| {} | `{}` | {} |\n",
            route.method,
            route.path,
            cells.join(" | ")
        );
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/access.md");
    let document = std::fs::read_to_string(path).expect("docs/access.md");
    assert!(
        document.contains(&matrix),
        "docs/access.md lacks:\n{matrix}"
    );
}
