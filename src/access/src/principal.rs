//! Principals: who asks, in which roles, and for which services.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Glob, as_text};

/// What a principal is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Role {
    /// Everything, tokens and policy included.
    Admin,
    /// Everything but tokens and policy.
    Operator,
    /// Publishes services, and does with them what it likes.
    Deployer,
    /// Is one robot, and connects to services.
    Robot,
    /// Reads.
    Viewer,
}

as_text!(Role);

impl Role {
    /// All of them.
    pub const ALL: [Role; 5] = [
        Role::Admin,
        Role::Operator,
        Role::Deployer,
        Role::Robot,
        Role::Viewer,
    ];

    /// As it is written.
    pub fn name(self) -> &'static str {
        match self {
            Role::Admin => "admin",
            Role::Operator => "operator",
            Role::Deployer => "deployer",
            Role::Robot => "robot",
            Role::Viewer => "viewer",
        }
    }

    /// Whether services are named that a principal of this role is for; the others are for all.
    pub fn is_scoped(self) -> bool {
        matches!(self, Role::Deployer | Role::Robot | Role::Viewer)
    }
}

impl FromStr for Role {
    type Err = Error;

    fn from_str(text: &str) -> Result<Role, Error> {
        let known = Role::ALL.into_iter().find(|role| role.name() == text);
        known.ok_or_else(|| Error::Role(text.to_owned()))
    }
}

impl fmt::Display for Role {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.name())
    }
}

/// What a principal is for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Scope {
    /// Services, by name.
    pub services: Vec<Glob>,
    /// The one robot that it is; none: any.
    pub robot: Option<String>,
    /// Classes of the configuration that it may name.
    pub classes: Vec<Glob>,
}

impl Scope {
    /// All services, any robot, every class.
    pub fn everything() -> Scope {
        let all = || "*".parse().into_iter().collect();
        Scope {
            services: all(),
            robot: None,
            classes: all(),
        }
    }

    /// Whether a service is of it.
    pub fn has(&self, service: &str) -> bool {
        self.services.iter().any(|pattern| pattern.matches(service))
    }

    /// Whether every service is of it.
    pub fn has_all(&self) -> bool {
        self.services.iter().any(Glob::is_everything)
    }
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Principal {
    /// By which rules of the policy and the records of services know it.
    pub name: String,
    /// It may what any of them allows.
    pub roles: Vec<Role>,
    /// For what.
    pub scope: Scope,
}

impl Principal {
    /// Somebody who may do everything.
    pub fn admin(name: &str) -> Principal {
        Principal {
            name: name.to_owned(),
            roles: vec![Role::Admin],
            scope: Scope::everything(),
        }
    }

    /// Somebody who has not said who it is: nothing is allowed.
    pub fn nobody() -> Principal {
        Principal {
            name: String::new(),
            roles: Vec::new(),
            scope: Scope::default(),
        }
    }

    /// Whoever asks over loopback on a machine whose operator has named nobody: sees everything, and is any robot.
    pub fn local() -> Principal {
        Principal {
            name: "local".to_owned(),
            roles: vec![Role::Viewer, Role::Robot],
            scope: Scope::everything(),
        }
    }

    /// Whether it has a role.
    pub fn is(&self, role: Role) -> bool {
        self.roles.contains(&role)
    }

    /// Whether it has a role that is for everything.
    pub fn is_unscoped(&self) -> bool {
        self.roles.iter().any(|role| !role.is_scoped())
    }

    /// Whether it is told of every service, and of the machine.
    pub fn sees_all(&self) -> bool {
        self.is_unscoped() || (self.is(Role::Viewer) && self.scope.has_all())
    }
}

impl fmt::Display for Principal {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let roles: Vec<_> = self.roles.iter().map(|role| role.name()).collect();
        match roles.as_slice() {
            [] => out.write_str("who shows no token"),
            roles => write!(out, "{} ({})", self.name, roles.join(", ")),
        }
    }
}

/// What names of people begin with whom an identity provider knows: accounts and tokens have no such names.
pub const PROVIDED: &str = "oidc:";

/// Longest name of somebody whom a provider knows, without what it begins with.
const LONGEST_PROVIDED: usize = 48;

/// The name of somebody whom an identity provider calls so. Letters and digits that look like others (of other alphabets) are
/// not kept: nobody is to be taken for somebody else.
pub fn provided_name(called: &str) -> String {
    let kept = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-' | '@' | '+');
    let plain = called.chars().map(|c| if kept(c) { c } else { '-' });
    let name: String = plain.take(LONGEST_PROVIDED).collect();
    match name.is_empty() {
        true => format!("{PROVIDED}-"),
        false => format!("{PROVIDED}{name}"),
    }
}

/// Refuses what is the name of nobody: of no account or token, and of nobody whom a provider knows.
pub(crate) fn check_any_name(name: &str) -> Result<(), Error> {
    let Some(called) = name.strip_prefix(PROVIDED) else {
        return check_name(name);
    };
    // Of those that are called alike all but the first have a number.
    let (called, number) = called.split_once('~').unwrap_or((called, "2"));
    let numbered = number.bytes().all(|byte| byte.is_ascii_digit()) && !number.is_empty();
    match numbered && !called.is_empty() && provided_name(called) == format!("{PROVIDED}{called}") {
        true => Ok(()),
        false => Err(Error::Name(name.to_owned())),
    }
}

/// Refuses what cannot be the name of a principal.
pub fn check_name(name: &str) -> Result<(), Error> {
    let inner = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    let well_formed = (1..=64).contains(&name.len())
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name.chars().all(inner);
    match well_formed {
        true => Ok(()),
        false => Err(Error::Name(name.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roles_are_read_as_they_are_written() {
        for role in Role::ALL {
            assert_eq!(role.to_string().parse(), Ok(role));
        }
        let refused = "root".parse::<Role>().expect_err("no role").to_string();
        assert!(refused.contains("deployer"), "{refused}");
    }

    #[test]
    fn people_of_a_provider_have_names_that_are_no_accounts() {
        for (called, name) in [
            ("alice", "oidc:alice"),
            ("a@lab.example", "oidc:a@lab.example"),
            ("Jörg M\u{fc}ller", "oidc:J-rg-M-ller"),
            ("\u{430}lice", "oidc:-lice"),
            ("a~2", "oidc:a-2"),
            ("", "oidc:-"),
        ] {
            assert_eq!(provided_name(called), name);
            check_any_name(name).expect(name);
            check_name(name).expect_err(name);
        }
        assert_eq!(provided_name(&"x".repeat(99)).len(), 53);
        check_any_name("oidc:alice~2").expect("the second");
        for name in [
            "oidc:",
            "oidc:a b",
            "oidc:a~",
            "oidc:a~2~3",
            "oidc:a~b",
            "other:a",
        ] {
            check_any_name(name).expect_err(name);
        }
    }

    #[test]
    fn names_are_checked() {
        for name in ["r1", "alice.lab-2_x", "0"] {
            check_name(name).expect(name);
        }
        for name in ["", "-x", "a b", "role:robot", "ä", &"x".repeat(65)] {
            check_name(name).expect_err(name);
        }
    }

    #[test]
    fn a_scope_of_all_services_is_told_from_one_that_names_them() {
        assert!(Scope::everything().has_all());
        assert!(!Scope::default().has_all());
        let some = Scope {
            services: vec!["det*".parse().expect("a pattern")],
            ..Scope::default()
        };
        assert!(some.has("detector") && !some.has("mapper") && !some.has_all());
    }
}
