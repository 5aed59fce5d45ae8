//! Whether a principal may do something to an object. `docs/access.md` has the table of roles and actions; a test compares it
//! with what is decided here.

use std::fmt;

use crate::principal::{Principal, Role};

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Action {
    /// Ask what every principal is told, each in its scope: lists, the clock, who one is.
    Enter,
    /// See the whole machine: its state, its journal, its figures.
    Look,
    /// See a service: interface, revisions, servants, figures, images, its stub.
    See,
    /// Try a service with a recording, or measure it.
    Try,
    /// Read what a service's nodes print.
    Logs,
    /// Publish, roll back, remove a service; write its dictionary.
    Deploy,
    /// Stop a service's servants, and change their limits.
    Operate,
    /// Be a robot at a service.
    Connect,
    /// Pair robots, and end that.
    Pair,
    /// Tokens and policy.
    Administer,
}

impl Action {
    /// All of them.
    pub const ALL: [Action; 10] = [
        Action::Enter,
        Action::Look,
        Action::See,
        Action::Try,
        Action::Logs,
        Action::Deploy,
        Action::Operate,
        Action::Connect,
        Action::Pair,
        Action::Administer,
    ];

    /// As the documents name it.
    pub fn name(self) -> &'static str {
        match self {
            Action::Enter => "enter",
            Action::Look => "look",
            Action::See => "see",
            Action::Try => "try",
            Action::Logs => "logs",
            Action::Deploy => "deploy",
            Action::Operate => "operate",
            Action::Connect => "connect",
            Action::Pair => "pair",
            Action::Administer => "administer",
        }
    }

    /// In a sentence: may not … the object.
    fn verb(self) -> &'static str {
        match self {
            Action::Enter => "ask",
            Action::Look | Action::See => "see",
            Action::Try => "try",
            Action::Logs => "read the logs of",
            Action::Deploy => "deploy",
            Action::Operate => "operate",
            Action::Connect => "connect to",
            Action::Pair => "pair robots with",
            Action::Administer => "administer",
        }
    }
}

/// What an action is done to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Object<'a> {
    /// The service; none: the machine, or all services.
    pub service: Option<&'a str>,
    /// Whether the service is published.
    pub exists: bool,
    /// Who published it first, where that was a deployer.
    pub owner: Option<&'a str>,
    /// As which robot, where one is named.
    pub robot: Option<&'a str>,
}

impl<'a> Object<'a> {
    /// The machine, or all services.
    pub const MACHINE: Object<'static> = Object {
        service: None,
        exists: true,
        owner: None,
        robot: None,
    };

    /// A service that is published.
    pub fn service(name: &'a str, owner: Option<&'a str>) -> Object<'a> {
        Object {
            service: Some(name),
            exists: true,
            owner,
            robot: None,
        }
    }
}

/// Why something may not be done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{who} may not {} {object}", action.verb())]
pub struct Refusal {
    /// The principal, with its roles.
    pub who: String,
    /// The action that was refused.
    pub action: Action,
    /// The object, in words.
    pub object: String,
}

impl Refusal {
    /// Of this principal.
    pub fn new(principal: &Principal, action: Action, object: impl fmt::Display) -> Refusal {
        Refusal {
            who: principal.to_string(),
            action,
            object: object.to_string(),
        }
    }
}

/// Whether `principal` may do `action` to `object`.
pub fn decide(principal: &Principal, action: Action, object: &Object<'_>) -> Result<(), Refusal> {
    let allowed = principal
        .roles
        .iter()
        .any(|role| allows(*role, principal, action, object));
    match allowed {
        true => Ok(()),
        false => Err(Refusal::new(principal, action, describe(object))),
    }
}

fn describe(object: &Object<'_>) -> String {
    match (object.service, object.robot) {
        // Of none in particular: not even of one that were its own.
        (Some(""), _) => "any service".to_owned(),
        (Some(service), Some(robot)) => format!("service {service} as robot {robot}"),
        (Some(service), None) => format!("service {service}"),
        (None, _) => "this server as a whole".to_owned(),
    }
}

/// One row of the table above.
fn allows(role: Role, principal: &Principal, action: Action, object: &Object<'_>) -> bool {
    let owned = object.owner == Some(principal.name.as_str());
    let scoped = object
        .service
        .is_some_and(|service| principal.scope.has(service));
    match (role, action) {
        (Role::Admin, _) => true,
        (Role::Operator, action) => action != Action::Administer,
        (_, Action::Pair | Action::Administer) => false,
        (_, Action::Enter) => true,
        (Role::Viewer, Action::Look) => principal.scope.has_all(),
        (_, Action::Look) => false,
        (Role::Deployer, Action::See) => owned || scoped,
        (Role::Deployer, Action::Deploy) => owned || (!object.exists && scoped),
        (Role::Deployer, Action::Try | Action::Logs | Action::Operate | Action::Connect) => owned,
        (Role::Robot | Role::Viewer, Action::See) => scoped,
        (Role::Robot, Action::Connect) => {
            let own = principal.scope.robot.as_deref();
            scoped && own.is_none_or(|own| object.robot == Some(own))
        }
        (Role::Robot, Action::Try | Action::Logs | Action::Deploy | Action::Operate) => false,
        (Role::Viewer, _) => false,
    }
}

/// Whether a principal may name a class of the configuration.
pub fn may_use_class(principal: &Principal, class: &str) -> bool {
    principal.is_unscoped()
        || principal
            .scope
            .classes
            .iter()
            .any(|pattern| pattern.matches(class))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::principal::Scope;

    fn principal(role: Role) -> Principal {
        Principal {
            name: "me".into(),
            roles: vec![role],
            scope: Scope {
                services: vec!["in_*".parse().expect("a pattern")],
                robot: (role == Role::Robot).then(|| "r1".into()),
                classes: vec!["fast".parse().expect("a pattern")],
            },
        }
    }

    /// Objects by the words of the table.
    fn objects() -> [(&'static str, Object<'static>); 7] {
        let service = |name, owner| Object::service(name, owner);
        [
            ("machine", Object::MACHINE),
            ("own", service("out_a", Some("me"))),
            ("scope", service("in_a", Some("other"))),
            ("other", service("out_a", Some("other"))),
            ("nobody's", service("out_a", None)),
            (
                "new in scope",
                Object {
                    exists: false,
                    ..service("in_new", None)
                },
            ),
            (
                "new elsewhere",
                Object {
                    exists: false,
                    ..service("out_new", None)
                },
            ),
        ]
    }

    #[test]
    fn each_role_may_what_its_column_says() {
        use Action as A;
        // What is allowed to whom, beside admin and operator, and to which object.
        let table: &[(Role, Action, &[&str])] = &[
            (Role::Deployer, A::See, &["own", "scope", "new in scope"]),
            (Role::Deployer, A::Try, &["own"]),
            (Role::Deployer, A::Logs, &["own"]),
            (Role::Deployer, A::Operate, &["own"]),
            (Role::Deployer, A::Connect, &["own"]),
            (Role::Deployer, A::Deploy, &["own", "new in scope"]),
            (Role::Robot, A::See, &["scope", "new in scope"]),
            (Role::Viewer, A::See, &["scope", "new in scope"]),
        ];
        for role in Role::ALL {
            for action in Action::ALL {
                for (word, object) in objects() {
                    let listed = table
                        .iter()
                        .find(|row| (row.0, row.1) == (role, action))
                        .is_some_and(|row| row.2.contains(&word));
                    let expected = match role {
                        Role::Admin => true,
                        Role::Operator => action != A::Administer,
                        _ => action == A::Enter || listed,
                    };
                    let decided = decide(&principal(role), action, &object).is_ok();
                    assert_eq!(decided, expected, "{role} {action:?} {word}");
                }
            }
        }
    }

    /// The table, as it is decided: a line for each action, a cell for each role.
    fn table() -> String {
        let mut lines = String::new();
        for action in Action::ALL {
            let cells = Role::ALL.map(|role| {
                let at = |object| Object {
                    robot: Some("r1"),
                    ..object
                };
                let allowed: Vec<&str> = objects()
                    .into_iter()
                    .filter(|(_, object)| decide(&principal(role), action, &at(*object)).is_ok())
                    .map(|(word, _)| word)
                    .collect();
                match allowed.len() {
                    0 => "-".to_owned(),
                    all if all == objects().len() => "yes".to_owned(),
                    _ => allowed.join(", "),
                }
            });
            lines.push_str(&format!("| {} | {} |\n", action.name(), cells.join(" | ")));
        }
        lines
    }

    #[test]
    fn the_documents_say_what_is_decided() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/access.md");
        let document = std::fs::read_to_string(path).expect("docs/access.md");
        assert!(
            document.contains(&table()),
            "docs/access.md lacks:\n{}",
            table()
        );
    }

    #[test]
    fn a_robot_is_itself_alone() {
        let robot = principal(Role::Robot);
        let at = |service, robot| Object {
            robot,
            ..Object::service(service, None)
        };
        decide(&robot, Action::Connect, &at("in_a", Some("r1"))).expect("its own");
        for (service, name) in [("in_a", Some("r2")), ("in_a", None), ("out_a", Some("r1"))] {
            decide(&robot, Action::Connect, &at(service, name)).expect_err(service);
        }
        let any = Principal::local();
        for name in [Some("r1"), None] {
            decide(&any, Action::Connect, &at("in_a", name)).expect("any robot");
        }
    }

    #[test]
    fn a_viewer_of_everything_sees_the_machine_and_changes_nothing() {
        let local = Principal::local();
        decide(&local, Action::Look, &Object::MACHINE).expect("sees all");
        for action in [A::Try, A::Logs, A::Deploy, A::Operate, A::Administer] {
            for (word, object) in objects() {
                decide(&local, action, &object).expect_err(word);
            }
        }
        use Action as A;
    }

    #[test]
    fn classes_are_for_those_who_are_given_them() {
        for role in [Role::Deployer, Role::Robot, Role::Viewer] {
            assert!(may_use_class(&principal(role), "fast"));
            assert!(!may_use_class(&principal(role), "gold"));
        }
        for role in [Role::Admin, Role::Operator] {
            assert!(may_use_class(&principal(role), "gold"));
        }
        assert!(may_use_class(&Principal::local(), "gold"));
        assert!(!may_use_class(&Principal::nobody(), "gold"));
    }

    #[test]
    fn a_refusal_says_who_what_and_to_what() {
        let refused = decide(&principal(Role::Viewer), Action::Deploy, &objects()[2].1);
        assert_eq!(
            refused.expect_err("read only").to_string(),
            "me (viewer) may not deploy service in_a"
        );
        let any = Object::service("", Some("me"));
        let refused = decide(&principal(Role::Viewer), Action::Operate, &any);
        assert_eq!(
            refused.expect_err("read only").to_string(),
            "me (viewer) may not operate any service"
        );
        let refused = decide(&Principal::nobody(), Action::Enter, &Object::MACHINE);
        let refused = refused.expect_err("nobody").to_string();
        assert_eq!(
            refused,
            "who shows no token may not ask this server as a whole"
        );
    }

    fn some_principal() -> impl Strategy<Value = Principal> {
        let role = prop::sample::select(Role::ALL.to_vec());
        let pattern = prop::sample::select(vec!["*", "a*", "ab", "**", "b"]);
        let patterns = prop::collection::vec(pattern, 0..3);
        let robot = prop::option::of(prop::sample::select(vec!["r1", "r2"]));
        (prop::collection::vec(role, 0..3), patterns, robot).prop_map(|(roles, patterns, robot)| {
            Principal {
                name: "me".into(),
                roles,
                scope: Scope {
                    services: patterns
                        .iter()
                        .filter_map(|text| text.parse().ok())
                        .collect(),
                    robot: robot.map(str::to_owned),
                    classes: Vec::new(),
                },
            }
        })
    }

    proptest! {
        /// What no role allows is refused, a further role takes nothing away, and administration is the admin's alone.
        #[test]
        fn rights_only_come_from_roles(
            principal in some_principal(),
            action in prop::sample::select(Action::ALL.to_vec()),
            service in prop::option::of(prop::sample::select(vec!["ab", "a", "b", "c"])),
            exists: bool,
            owner in prop::option::of(prop::sample::select(vec!["me", "you"])),
            robot in prop::option::of(prop::sample::select(vec!["r1", "r2"])),
            further in prop::sample::select(Role::ALL.to_vec()),
        ) {
            let object = Object { service, exists, owner, robot };
            let allowed = decide(&principal, action, &object).is_ok();
            if principal.roles.is_empty() {
                prop_assert!(!allowed);
            }
            if action == Action::Administer {
                prop_assert_eq!(allowed, principal.is(Role::Admin));
            }
            if action == Action::Pair {
                prop_assert_eq!(allowed, principal.is_unscoped());
            }
            let changes = matches!(action, Action::Deploy | Action::Operate | Action::Logs | Action::Try);
            if changes && allowed && !principal.is_unscoped() {
                prop_assert!(principal.is(Role::Deployer));
                prop_assert!(owner == Some("me") || !exists);
            }
            let mut more = principal.clone();
            more.roles.push(further);
            if allowed {
                prop_assert!(decide(&more, action, &object).is_ok());
            }
        }
    }
}
