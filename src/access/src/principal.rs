//! Principals: callers, their roles and the services they may use.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Glob, as_text};

/// Role of a principal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Role {
    /// Everything, including tokens and policy.
    Admin,
    /// Everything except tokens and policy.
    Operator,
    /// Publishes services and manages its own.
    Deployer,
    /// Acts as one robot and connects to services.
    Robot,
    /// Read-only access.
    Viewer,
}

as_text!(Role);

impl Role {
    /// All roles.
    pub const ALL: [Role; 5] = [Role::Admin, Role::Operator, Role::Deployer, Role::Robot, Role::Viewer];

    /// Returns the name of the role.
    pub fn name(self) -> &'static str {
        match self {
            Role::Admin => "admin",
            Role::Operator => "operator",
            Role::Deployer => "deployer",
            Role::Robot => "robot",
            Role::Viewer => "viewer",
        }
    }

    /// Returns true if principals of this role are limited to named services.
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

/// Scope of a principal.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Scope {
    /// Services, as name patterns.
    pub services: Vec<Glob>,
    /// The robot that the principal is; `None` for any robot.
    pub robot: Option<String>,
    /// Classes of the configuration that it may use.
    pub classes: Vec<Glob>,
}

impl Scope {
    /// Creates the scope of all services, any robot and every class.
    pub fn everything() -> Scope {
        let all = || "*".parse().into_iter().collect();
        Scope { services: all(), robot: None, classes: all() }
    }

    /// Returns true if the scope includes the service.
    pub fn includes(&self, service: &str) -> bool {
        self.services.iter().any(|pattern| pattern.matches(service))
    }

    /// Returns true if the scope includes every service.
    pub fn includes_all(&self) -> bool {
        self.services.iter().any(Glob::is_everything)
    }
}

/// An authenticated caller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Principal {
    /// Name, as used in rules of the policy and as owner of services.
    pub name: String,
    /// Roles; the principal may do whatever any of them allows.
    pub roles: Vec<Role>,
    /// Services, robot and classes to which the roles apply.
    pub scope: Scope,
}

impl Principal {
    /// Creates a principal with all permissions.
    pub fn admin(name: &str) -> Principal {
        Principal { name: name.to_owned(), roles: vec![Role::Admin], scope: Scope::everything() }
    }

    /// Creates the unauthenticated principal, which has no permissions.
    pub fn nobody() -> Principal {
        Principal { name: String::new(), roles: Vec::new(), scope: Scope::default() }
    }

    /// Creates the principal of loopback callers on a machine where no credentials exist: it views everything and may
    /// act as any robot.
    pub fn local() -> Principal {
        Principal { name: "local".to_owned(), roles: vec![Role::Viewer, Role::Robot], scope: Scope::everything() }
    }

    /// Creates the principal of this machine's robots where credentials exist and the operator admits robots without
    /// one: it may act as any robot and views nothing else.
    pub fn local_robot() -> Principal {
        Principal { roles: vec![Role::Robot], ..Principal::local() }
    }

    /// Returns the role of a token or a person, which have one; that of a viewer without any.
    pub fn first_role(&self) -> Role {
        self.roles.first().copied().unwrap_or(Role::Viewer)
    }

    /// Returns true if the principal has the role.
    pub fn has_role(&self, role: Role) -> bool {
        self.roles.contains(&role)
    }

    /// Returns true if any of its roles applies to all services.
    pub fn is_unscoped(&self) -> bool {
        self.roles.iter().any(|role| !role.is_scoped())
    }

    /// Returns true if it may see every service and the machine.
    pub fn sees_all(&self) -> bool {
        self.is_unscoped() || (self.has_role(Role::Viewer) && self.scope.includes_all())
    }
}

impl fmt::Display for Principal {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let roles: Vec<_> = self.roles.iter().map(|role| role.name()).collect();
        match roles.as_slice() {
            [] => out.write_str("a client without a token"),
            roles => write!(out, "{} ({})", self.name, roles.join(", ")),
        }
    }
}

/// Name prefix of people known to the identity provider; accounts and tokens cannot have such names.
pub const PROVIDER_PREFIX: &str = "oidc:";

/// Maximum length of such a name without the prefix.
const LONGEST_PROVIDED: usize = 48;

/// Returns the principal name for a name given by the identity provider. Characters outside ASCII letters, digits and
/// `._-@+` are replaced, so that nobody can impersonate somebody else with similar letters of another alphabet.
pub fn oidc_principal_name(called: &str) -> String {
    let kept = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-' | '@' | '+');
    let plain = called.chars().map(|c| if kept(c) { c } else { '-' });
    let name: String = plain.take(LONGEST_PROVIDED).collect();
    if name.is_empty() { format!("{PROVIDER_PREFIX}-") } else { format!("{PROVIDER_PREFIX}{name}") }
}

/// Checks that a name can belong to an account, a token or a person of the identity provider.
pub(crate) fn check_any_name(name: &str) -> Result<(), Error> {
    let Some(called) = name.strip_prefix(PROVIDER_PREFIX) else {
        return check_name(name);
    };
    // Of people with the same name, all but the first have a number.
    let (called, number) = called.split_once('~').unwrap_or((called, "2"));
    let numbered = number.bytes().all(|byte| byte.is_ascii_digit()) && !number.is_empty();
    if numbered && !called.is_empty() && oidc_principal_name(called) == format!("{PROVIDER_PREFIX}{called}") {
        Ok(())
    } else {
        Err(Error::Name(name.to_owned()))
    }
}

/// Checks that a name is a valid name of a principal.
pub fn check_name(name: &str) -> Result<(), Error> {
    let inner = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    let well_formed = (1..=64).contains(&name.len())
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name.chars().all(inner);
    if well_formed { Ok(()) } else { Err(Error::Name(name.to_owned())) }
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
            assert_eq!(oidc_principal_name(called), name);
            check_any_name(name).expect(name);
            check_name(name).expect_err(name);
        }
        assert_eq!(oidc_principal_name(&"x".repeat(99)).len(), 53);
        check_any_name("oidc:alice~2").expect("the second");
        for name in ["oidc:", "oidc:a b", "oidc:a~", "oidc:a~2~3", "oidc:a~b", "other:a"] {
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
        assert!(Scope::everything().includes_all());
        assert!(!Scope::default().includes_all());
        let some = Scope { services: vec!["det*".parse().expect("a pattern")], ..Scope::default() };
        assert!(some.includes("detector") && !some.includes("mapper") && !some.includes_all());
    }
}
