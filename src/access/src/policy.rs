//! The policy: rules that say what principals may use of a service. A rule that names a principal stands in place of those of
//! its roles, so that one robot can be given less than the others; where no rule is, nothing is granted.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::principal::check_any_name;
use crate::{Error, Glob, Grant, Operation, Principal, Role, as_text};

/// For whom a rule is.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Who {
    /// One principal, by its name.
    Principal(String),
    /// All principals of a role.
    Role(Role),
}

as_text!(Who);

impl FromStr for Who {
    type Err = Error;

    fn from_str(text: &str) -> Result<Who, Error> {
        if let Some(role) = text.strip_prefix("role:") {
            return Ok(Who::Role(role.parse()?));
        }
        check_any_name(text)?;
        Ok(Who::Principal(text.to_owned()))
    }
}

impl fmt::Display for Who {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Who::Principal(name) => out.write_str(name),
            Who::Role(role) => write!(out, "role:{role}"),
        }
    }
}

/// What somebody may use of services.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rule {
    /// The principals that it is for.
    pub who: Who,
    /// The services that it is for.
    pub services: Glob,
    /// The operations on names that it allows.
    pub allow: Vec<Grant>,
}

/// All rules.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Policy {
    /// In any order: it does not matter.
    pub rules: Vec<Rule>,
}

impl Policy {
    /// What a principal may use of a service that it may connect to.
    pub fn grants(&self, principal: &Principal, service: &str) -> Grants {
        if principal.is_unscoped() {
            return Grants::everything();
        }
        let rules = self.rules_for(principal, service);
        Grants::new(
            rules
                .into_iter()
                .flat_map(|rule| rule.allow.iter().cloned()),
        )
    }

    /// What a principal may hear in a service's servants that it sees, and may not connect to: of what its rules grant it,
    /// subscriptions alone. A viewer for whom there is no rule hears everything.
    pub fn hearing(&self, principal: &Principal, service: &str) -> Grants {
        let unruled = principal.is(Role::Viewer) && self.rules_for(principal, service).is_empty();
        let grants = match unruled {
            true => Grants::everything(),
            false => self.grants(principal, service),
        };
        grants.only(Operation::Subscribe)
    }

    /// The rules that are for a principal at a service.
    fn rules_for(&self, principal: &Principal, service: &str) -> Vec<&Rule> {
        let here = || {
            self.rules
                .iter()
                .filter(|rule| rule.services.matches(service))
        };
        let named =
            |rule: &&Rule| matches!(&rule.who, Who::Principal(name) if *name == principal.name);
        let of_role = |rule: &&Rule| matches!(rule.who, Who::Role(role) if principal.is(role));
        match here().any(|rule| named(&rule)) {
            true => here().filter(named).collect(),
            false => here().filter(of_role).collect(),
        }
    }
}

/// What a client may do to topics, services and actions.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Grants {
    everything: bool,
    list: Vec<Grant>,
}

impl Grants {
    /// These.
    pub fn new(grants: impl IntoIterator<Item = Grant>) -> Grants {
        let list: Vec<Grant> = grants.into_iter().collect();
        Grants {
            everything: list.iter().any(Grant::is_everything),
            list,
        }
    }

    /// All operations on all names.
    pub fn everything() -> Grants {
        Grants {
            everything: true,
            list: Vec::new(),
        }
    }

    /// Whether nothing is left out.
    pub fn is_everything(&self) -> bool {
        self.everything
    }

    /// What is left of them where one operation alone may be granted.
    fn only(&self, operation: Operation) -> Grants {
        match self.everything {
            true => Grants::new([Grant::all(operation)]),
            false => Grants::new(self.list.iter().filter_map(|grant| grant.only(operation))),
        }
    }

    /// Whether an operation on an absolute name is granted.
    pub fn permits(&self, operation: Operation, name: &str) -> bool {
        self.everything || self.list.iter().any(|grant| grant.permits(operation, name))
    }

    /// Whether any operation on a name is granted: then it may be told that the name is there.
    pub fn shows(&self, name: &str) -> bool {
        Operation::ALL
            .into_iter()
            .any(|operation| self.permits(operation, name))
    }
}

impl fmt::Display for Grants {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.everything {
            return out.write_str("everything");
        }
        if self.list.is_empty() {
            return out.write_str("nothing");
        }
        let texts: Vec<String> = self.list.iter().map(ToString::to_string).collect();
        out.write_str(&texts.join(", "))
    }
}

/// How a connection stands: what it may do now, or why it ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Standing {
    /// It may do this.
    Granted(Arc<Grants>),
    /// It ends, for this reason.
    Ended(String),
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::principal::Scope;

    fn rule(who: &str, services: &str, allow: &[&str]) -> Rule {
        Rule {
            who: who.parse().expect("a principal or a role"),
            services: services.parse().expect("a pattern"),
            allow: allow
                .iter()
                .map(|text| text.parse().expect("a grant"))
                .collect(),
        }
    }

    fn robot(name: &str) -> Principal {
        Principal {
            name: name.into(),
            roles: vec![Role::Robot],
            scope: Scope::everything(),
        }
    }

    #[test]
    fn nothing_is_granted_where_no_rule_is() {
        let grants = Policy::default().grants(&robot("r1"), "detector");
        assert_eq!(grants.to_string(), "nothing");
        for operation in Operation::ALL {
            assert!(!grants.permits(operation, "/x"));
        }
        assert!(!grants.shows("/x"));
    }

    #[test]
    fn who_may_only_look_hears_and_does_nothing() {
        let viewer = Principal {
            roles: vec![Role::Viewer],
            ..robot("eve")
        };
        let is = |policy: &Policy, principal: &Principal, said: &str| {
            let grants = policy.hearing(principal, "detector");
            assert_eq!(grants.to_string(), said);
            for operation in Operation::ALL {
                let heard = operation == Operation::Subscribe && said != "nothing";
                assert_eq!(
                    grants.permits(operation, "/camera/x"),
                    heard,
                    "{operation:?}"
                );
            }
        };
        let none = Policy::default();
        is(&none, &viewer, "subscribe:/**");
        is(&none, &Principal::admin("root"), "subscribe:/**");
        // A deployer of another's service, for example: what no rule grants, it does not hear.
        is(&none, &robot("r1"), "nothing");
        let ruled = Policy {
            rules: vec![
                rule("role:robot", "*", &["*:**"]),
                rule("role:viewer", "*", &["*:/camera/**", "call:/detect"]),
                rule("mallory", "*", &["publish:/**"]),
            ],
        };
        is(&ruled, &robot("r1"), "subscribe:/**");
        is(&ruled, &viewer, "subscribe:/camera/**");
        let named = Principal {
            name: "mallory".into(),
            ..viewer
        };
        is(&ruled, &named, "nothing");
    }

    #[test]
    fn a_rule_for_a_principal_stands_in_place_of_those_of_its_role() {
        let policy = Policy {
            rules: vec![
                rule("role:robot", "*", &["*:**"]),
                rule("r1", "detector", &["subscribe:/camera/**"]),
                rule("r1", "det*", &["call:/detect"]),
                rule("role:viewer", "*", &["publish:/never"]),
            ],
        };
        let narrow = policy.grants(&robot("r1"), "detector");
        assert!(
            narrow.permits(Operation::Subscribe, "/camera/x")
                && narrow.permits(Operation::Call, "/detect")
        );
        assert!(!narrow.permits(Operation::Publish, "/cmd_vel") && !narrow.is_everything());
        assert!(narrow.shows("/detect") && !narrow.shows("/cmd_vel"));
        assert!(policy.grants(&robot("r1"), "mapper").is_everything());
        assert!(policy.grants(&robot("r2"), "detector").is_everything());
        assert!(
            Policy::default()
                .grants(&Principal::admin("root"), "detector")
                .is_everything()
        );
    }

    #[test]
    fn who_is_read_as_it_is_written() {
        for text in ["r1", "role:robot", "role:viewer"] {
            assert_eq!(text.parse::<Who>().expect(text).to_string(), text);
        }
        for text in ["", "role:", "role:root", "a b", "*"] {
            text.parse::<Who>().expect_err(text);
        }
        let json = serde_json::to_string(&Who::Role(Role::Robot)).expect("JSON");
        assert_eq!(json, "\"role:robot\"");
        assert_eq!(
            serde_json::from_str::<Who>(&json).expect("read back"),
            Who::Role(Role::Robot)
        );
    }

    fn some_rule() -> impl Strategy<Value = Rule> {
        let who = prop::sample::select(vec!["r1", "r2", "role:robot", "role:viewer"]);
        let services = prop::sample::select(vec!["*", "a", "b"]);
        let grant = prop::sample::select(vec![
            "*:**",
            "call:/x",
            "*:/x",
            "subscribe:/**",
            "publish:/y",
        ]);
        (who, services, prop::collection::vec(grant, 0..3))
            .prop_map(|(who, services, allow)| rule(who, services, &allow))
    }

    proptest! {
        /// Whatever is granted stands in a rule for this principal, or for its role where none names it; the order of rules
        /// does not matter.
        #[test]
        fn what_is_granted_stands_in_a_rule(
            rules in prop::collection::vec(some_rule(), 0..6),
            service in prop::sample::select(vec!["a", "b", "c"]),
            operation in prop::sample::select(Operation::ALL.to_vec()),
            name in prop::sample::select(vec!["/x", "/y", "/z"]),
        ) {
            let here = |rule: &&Rule| rule.services.matches(service);
            let own: Vec<&Rule> = rules.iter().filter(here).filter(|rule| rule.who.to_string() == "r1").collect();
            let role: Vec<&Rule> = rules.iter().filter(here).filter(|rule| rule.who.to_string() == "role:robot").collect();
            let counted = if own.is_empty() { role } else { own };
            let expected = counted.iter().flat_map(|rule| &rule.allow).any(|grant| grant.permits(operation, name));
            let granted = |rules: Vec<Rule>| Policy { rules }.grants(&robot("r1"), service).permits(operation, name);
            let turned: Vec<Rule> = rules.iter().rev().cloned().collect();
            prop_assert_eq!(granted(rules.clone()), expected);
            prop_assert_eq!(granted(turned), expected);
        }
    }
}
