//! Decides whether a principal may perform an action on an object. `docs/access.md` has the table of roles and
//! actions; a test compares it with the decisions made here.

use std::fmt;

use crate::principal::{Principal, Role};

/// An action that needs permission.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AccessAction {
    /// Query what every principal may read, each within its scope: lists, the clock, its own identity.
    Enter,
    /// View the whole machine: its state, journal and metrics.
    Look,
    /// View a service: interface, revisions, servants, metrics, images and stub.
    See,
    /// Run a service on a recording, or measure it.
    Try,
    /// Read the output of a service's nodes.
    Logs,
    /// Publish, roll back or remove a service; write its dictionary.
    Deploy,
    /// Stop a service's servants and change their limits.
    Operate,
    /// Run programs in a service's servants.
    Exec,
    /// Connect to a service as a robot.
    Connect,
    /// Pair and unpair robots.
    Pair,
    /// Manage tokens and policy.
    Administer,
}

impl AccessAction {
    /// All actions.
    pub const ALL: [AccessAction; 11] = [
        AccessAction::Enter,
        AccessAction::Look,
        AccessAction::See,
        AccessAction::Try,
        AccessAction::Logs,
        AccessAction::Deploy,
        AccessAction::Operate,
        AccessAction::Exec,
        AccessAction::Connect,
        AccessAction::Pair,
        AccessAction::Administer,
    ];

    /// Returns the name used in the documentation.
    pub fn name(self) -> &'static str {
        match self {
            AccessAction::Enter => "enter",
            AccessAction::Look => "look",
            AccessAction::See => "see",
            AccessAction::Try => "try",
            AccessAction::Logs => "logs",
            AccessAction::Deploy => "deploy",
            AccessAction::Operate => "operate",
            AccessAction::Exec => "exec",
            AccessAction::Connect => "connect",
            AccessAction::Pair => "pair",
            AccessAction::Administer => "administer",
        }
    }

    /// Returns the verb for a sentence of the form "may not … the object".
    fn verb(self) -> &'static str {
        match self {
            AccessAction::Enter => "ask",
            AccessAction::Look | AccessAction::See => "see",
            AccessAction::Try => "try",
            AccessAction::Logs => "read the logs of",
            AccessAction::Deploy => "deploy",
            AccessAction::Operate => "operate",
            AccessAction::Exec => "run programs in",
            AccessAction::Connect => "connect to",
            AccessAction::Pair => "pair robots with",
            AccessAction::Administer => "administer",
        }
    }
}

/// The object of an action.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AccessObject<'a> {
    /// The service; `None` for the machine or all services.
    pub service: Option<&'a str>,
    /// True if the service is published.
    pub exists: bool,
    /// The deployer that first published the service, if it was a deployer.
    pub owner: Option<&'a str>,
    /// The robot to act as, if one is named.
    pub robot: Option<&'a str>,
}

impl<'a> AccessObject<'a> {
    /// The machine, or all services.
    pub const MACHINE: AccessObject<'static> = AccessObject { service: None, exists: true, owner: None, robot: None };

    /// Creates the object for a published service.
    pub fn service(name: &'a str, owner: Option<&'a str>) -> AccessObject<'a> {
        AccessObject { service: Some(name), exists: true, owner, robot: None }
    }
}

/// Refusal of an action.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{who} may not {} {object}", action.verb())]
pub struct AccessDenied {
    /// The principal with its roles.
    pub who: String,
    /// The refused action.
    pub action: AccessAction,
    /// Description of the object.
    pub object: String,
}

impl AccessDenied {
    /// Creates the refusal of an action to a principal.
    pub fn new(principal: &Principal, action: AccessAction, object: impl fmt::Display) -> AccessDenied {
        AccessDenied { who: principal.to_string(), action, object: object.to_string() }
    }
}

/// Checks whether `principal` may perform `action` on `object`.
pub fn decide(principal: &Principal, action: AccessAction, object: &AccessObject<'_>) -> Result<(), AccessDenied> {
    let allowed = principal.roles.iter().any(|role| role_allows(*role, principal, action, object));
    if allowed { Ok(()) } else { Err(AccessDenied::new(principal, action, describe(object))) }
}

fn describe(object: &AccessObject<'_>) -> String {
    match (object.service, object.robot) {
        // Any service, even one that the principal owns.
        (Some(""), _) => "any service".to_owned(),
        (Some(service), Some(robot)) => format!("service {service} as robot {robot}"),
        (Some(service), None) => format!("service {service}"),
        (None, _) => "this server as a whole".to_owned(),
    }
}

/// One row of the table above.
fn role_allows(role: Role, principal: &Principal, action: AccessAction, object: &AccessObject<'_>) -> bool {
    let owned = object.owner == Some(principal.name.as_str());
    let scoped = object.service.is_some_and(|service| principal.scope.includes(service));
    match (role, action) {
        (Role::Admin, _) => true,
        (Role::Operator, action) => action != AccessAction::Administer,
        (_, AccessAction::Pair | AccessAction::Administer) => false,
        (_, AccessAction::Enter) => true,
        (Role::Viewer, AccessAction::Look) => principal.scope.includes_all(),
        (_, AccessAction::Look) => false,
        (Role::Deployer, AccessAction::See) => owned || scoped,
        (Role::Deployer, AccessAction::Deploy) => owned || (!object.exists && scoped),
        (
            Role::Deployer,
            AccessAction::Try | AccessAction::Logs | AccessAction::Operate | AccessAction::Exec | AccessAction::Connect,
        ) => owned,
        (Role::Robot | Role::Viewer, AccessAction::See) => scoped,
        (Role::Robot, AccessAction::Connect) => {
            let own = principal.scope.robot.as_deref();
            scoped && own.is_none_or(|own| object.robot == Some(own))
        }
        (
            Role::Robot,
            AccessAction::Try | AccessAction::Logs | AccessAction::Deploy | AccessAction::Operate | AccessAction::Exec,
        ) => false,
        (Role::Viewer, _) => false,
    }
}

/// Returns true if the principal may use a class of the configuration.
pub fn can_use_class(principal: &Principal, class: &str) -> bool {
    principal.is_unscoped() || principal.scope.classes.iter().any(|pattern| pattern.matches(class))
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

    /// Objects, by their names in the table.
    fn objects() -> [(&'static str, AccessObject<'static>); 7] {
        let service = |name, owner| AccessObject::service(name, owner);
        [
            ("machine", AccessObject::MACHINE),
            ("own", service("out_a", Some("me"))),
            ("scope", service("in_a", Some("other"))),
            ("other", service("out_a", Some("other"))),
            ("nobody's", service("out_a", None)),
            ("new in scope", AccessObject { exists: false, ..service("in_new", None) }),
            ("new elsewhere", AccessObject { exists: false, ..service("out_new", None) }),
        ]
    }

    #[test]
    fn each_role_may_what_its_column_says() {
        use AccessAction as A;
        // What roles other than admin and operator may do, and on which objects.
        let table: &[(Role, AccessAction, &[&str])] = &[
            (Role::Deployer, A::See, &["own", "scope", "new in scope"]),
            (Role::Deployer, A::Try, &["own"]),
            (Role::Deployer, A::Logs, &["own"]),
            (Role::Deployer, A::Operate, &["own"]),
            (Role::Deployer, A::Exec, &["own"]),
            (Role::Deployer, A::Connect, &["own"]),
            (Role::Deployer, A::Deploy, &["own", "new in scope"]),
            (Role::Robot, A::See, &["scope", "new in scope"]),
            (Role::Viewer, A::See, &["scope", "new in scope"]),
        ];
        for role in Role::ALL {
            for action in AccessAction::ALL {
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

    /// Renders the table from the decisions: a line for each action, a cell for each role.
    fn table() -> String {
        let mut lines = String::new();
        for action in AccessAction::ALL {
            let cells = Role::ALL.map(|role| {
                let at = |object| AccessObject { robot: Some("r1"), ..object };
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
        assert!(document.contains(&table()), "docs/access.md lacks:\n{}", table());
    }

    #[test]
    fn a_robot_is_itself_alone() {
        let robot = principal(Role::Robot);
        let at = |service, robot| AccessObject { robot, ..AccessObject::service(service, None) };
        decide(&robot, AccessAction::Connect, &at("in_a", Some("r1"))).expect("its own");
        for (service, name) in [("in_a", Some("r2")), ("in_a", None), ("out_a", Some("r1"))] {
            decide(&robot, AccessAction::Connect, &at(service, name)).expect_err(service);
        }
        let any = Principal::local();
        for name in [Some("r1"), None] {
            decide(&any, AccessAction::Connect, &at("in_a", name)).expect("any robot");
        }
    }

    #[test]
    fn a_viewer_of_everything_sees_the_machine_and_changes_nothing() {
        let local = Principal::local();
        decide(&local, AccessAction::Look, &AccessObject::MACHINE).expect("sees all");
        for action in [A::Try, A::Logs, A::Deploy, A::Operate, A::Administer] {
            for (word, object) in objects() {
                decide(&local, action, &object).expect_err(word);
            }
        }
        use AccessAction as A;
    }

    #[test]
    fn classes_are_for_those_who_are_given_them() {
        for role in [Role::Deployer, Role::Robot, Role::Viewer] {
            assert!(can_use_class(&principal(role), "fast"));
            assert!(!can_use_class(&principal(role), "gold"));
        }
        for role in [Role::Admin, Role::Operator] {
            assert!(can_use_class(&principal(role), "gold"));
        }
        assert!(can_use_class(&Principal::local(), "gold"));
        assert!(!can_use_class(&Principal::nobody(), "gold"));
    }

    #[test]
    fn a_refusal_says_who_what_and_to_what() {
        let refused = decide(&principal(Role::Viewer), AccessAction::Deploy, &objects()[2].1);
        assert_eq!(refused.expect_err("read only").to_string(), "me (viewer) may not deploy service in_a");
        let any = AccessObject::service("", Some("me"));
        let refused = decide(&principal(Role::Viewer), AccessAction::Operate, &any);
        assert_eq!(refused.expect_err("read only").to_string(), "me (viewer) may not operate any service");
        let refused = decide(&Principal::nobody(), AccessAction::Enter, &AccessObject::MACHINE);
        let refused = refused.expect_err("nobody").to_string();
        assert_eq!(refused, "a client without a token may not ask this server as a whole");
    }

    fn some_principal() -> impl Strategy<Value = Principal> {
        let role = prop::sample::select(Role::ALL.to_vec());
        let pattern = prop::sample::select(vec!["*", "a*", "ab", "**", "b"]);
        let patterns = prop::collection::vec(pattern, 0..3);
        let robot = prop::option::of(prop::sample::select(vec!["r1", "r2"]));
        (prop::collection::vec(role, 0..3), patterns, robot).prop_map(|(roles, patterns, robot)| Principal {
            name: "me".into(),
            roles,
            scope: Scope {
                services: patterns.iter().filter_map(|text| text.parse().ok()).collect(),
                robot: robot.map(str::to_owned),
                classes: Vec::new(),
            },
        })
    }

    proptest! {
        /// No role, no permission; an additional role never takes a permission away; only admins administer.
        #[test]
        fn rights_only_come_from_roles(
            principal in some_principal(),
            action in prop::sample::select(AccessAction::ALL.to_vec()),
            service in prop::option::of(prop::sample::select(vec!["ab", "a", "b", "c"])),
            exists: bool,
            owner in prop::option::of(prop::sample::select(vec!["me", "you"])),
            robot in prop::option::of(prop::sample::select(vec!["r1", "r2"])),
            further in prop::sample::select(Role::ALL.to_vec()),
        ) {
            let object = AccessObject { service, exists, owner, robot };
            let allowed = decide(&principal, action, &object).is_ok();
            if principal.roles.is_empty() {
                prop_assert!(!allowed);
            }
            if action == AccessAction::Administer {
                prop_assert_eq!(allowed, principal.has_role(Role::Admin));
            }
            if action == AccessAction::Pair {
                prop_assert_eq!(allowed, principal.is_unscoped());
            }
            let changes = matches!(action,
                AccessAction::Deploy | AccessAction::Operate | AccessAction::Logs | AccessAction::Try);
            if changes && allowed && !principal.is_unscoped() {
                prop_assert!(principal.has_role(Role::Deployer));
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
