//! The policy: rules that grant principals the use of a service's topics, services and actions. Rules that name a
//! principal replace those of its roles, so that one robot can be given less than others; without a rule, nothing is
//! granted.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::principal::check_any_name;
use crate::{Error, Glob, Grant, Operation, Principal, Role, as_text};

/// Subject of a rule.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum RuleSubject {
    /// One principal, by name.
    Principal(String),
    /// All principals with a role.
    Role(Role),
}

as_text!(RuleSubject);

impl FromStr for RuleSubject {
    type Err = Error;

    fn from_str(text: &str) -> Result<RuleSubject, Error> {
        if let Some(role) = text.strip_prefix("role:") {
            return Ok(RuleSubject::Role(role.parse()?));
        }
        check_any_name(text)?;
        Ok(RuleSubject::Principal(text.to_owned()))
    }
}

impl fmt::Display for RuleSubject {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RuleSubject::Principal(name) => out.write_str(name),
            RuleSubject::Role(role) => write!(out, "role:{role}"),
        }
    }
}

/// A rule of the policy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccessRule {
    /// Principals to which the rule applies.
    pub who: RuleSubject,
    /// Services to which the rule applies.
    pub services: Glob,
    /// Granted operations on names.
    pub allow: Vec<Grant>,
}

/// All rules of the policy.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AccessPolicy {
    /// Rules, in any order.
    pub rules: Vec<AccessRule>,
}

impl AccessPolicy {
    /// Returns what a principal may use of a service to which it may connect.
    pub fn grants(&self, principal: &Principal, service: &str) -> Grants {
        if principal.is_unscoped() {
            return Grants::everything();
        }
        let rules = self.rules_for(principal, service);
        Grants::new(rules.into_iter().flat_map(|rule| rule.allow.iter().cloned()))
    }

    /// Returns what a principal may subscribe to inside a service's servants that it may view but not connect to: the
    /// subscriptions among its grants. A viewer without any rule may subscribe to everything.
    pub fn observer_grants(&self, principal: &Principal, service: &str) -> Grants {
        let unruled = principal.has_role(Role::Viewer) && self.rules_for(principal, service).is_empty();
        let grants = if unruled { Grants::everything() } else { self.grants(principal, service) };
        grants.restrict_to(Operation::Subscribe)
    }

    /// Returns the rules that apply to a principal at a service.
    fn rules_for(&self, principal: &Principal, service: &str) -> Vec<&AccessRule> {
        let here = || self.rules.iter().filter(|rule| rule.services.matches(service));
        let named = |rule: &&AccessRule| matches!(&rule.who, RuleSubject::Principal(name) if *name == principal.name);
        let of_role = |rule: &&AccessRule| matches!(rule.who, RuleSubject::Role(role) if principal.has_role(role));
        if here().any(|rule| named(&rule)) { here().filter(named).collect() } else { here().filter(of_role).collect() }
    }
}

/// Set of grants of a client.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Grants {
    everything: bool,
    list: Vec<Grant>,
}

impl Grants {
    /// Creates a set of these grants.
    pub fn new(grants: impl IntoIterator<Item = Grant>) -> Grants {
        let list: Vec<Grant> = grants.into_iter().collect();
        Grants { everything: list.iter().any(Grant::is_everything), list }
    }

    /// Creates the grant of all operations on all names.
    pub fn everything() -> Grants {
        Grants { everything: true, list: Vec::new() }
    }

    /// Returns true if everything is granted.
    pub fn is_everything(&self) -> bool {
        self.everything
    }

    /// Returns the part of the grants that covers `operation`.
    fn restrict_to(&self, operation: Operation) -> Grants {
        if self.everything {
            Grants::new([Grant::all(operation)])
        } else {
            Grants::new(self.list.iter().filter_map(|grant| grant.restrict_to(operation)))
        }
    }

    /// Returns true if the operation on an absolute name is granted.
    pub fn permits(&self, operation: Operation, name: &str) -> bool {
        self.everything || self.list.iter().any(|grant| grant.permits(operation, name))
    }

    /// Returns true if any operation on the name is granted, so that its existence may be revealed.
    pub fn permits_any(&self, name: &str) -> bool {
        Operation::ALL.into_iter().any(|operation| self.permits(operation, name))
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

/// Access of an open connection: its current grants, or the reason to close it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ConnectionAccess {
    /// The connection has these grants.
    Granted(Arc<Grants>),
    /// The connection must be closed for this reason.
    Ended(String),
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::principal::Scope;

    fn rule(who: &str, services: &str, allow: &[&str]) -> AccessRule {
        AccessRule {
            who: who.parse().expect("a principal or a role"),
            services: services.parse().expect("a pattern"),
            allow: allow.iter().map(|text| text.parse().expect("a grant")).collect(),
        }
    }

    fn robot(name: &str) -> Principal {
        Principal { name: name.into(), roles: vec![Role::Robot], scope: Scope::everything() }
    }

    #[test]
    fn nothing_is_granted_where_no_rule_is() {
        let grants = AccessPolicy::default().grants(&robot("r1"), "detector");
        assert_eq!(grants.to_string(), "nothing");
        for operation in Operation::ALL {
            assert!(!grants.permits(operation, "/x"));
        }
        assert!(!grants.permits_any("/x"));
    }

    #[test]
    fn a_viewer_subscribes_and_does_nothing_else() {
        let viewer = Principal { roles: vec![Role::Viewer], ..robot("eve") };
        let is = |policy: &AccessPolicy, principal: &Principal, said: &str| {
            let grants = policy.observer_grants(principal, "detector");
            assert_eq!(grants.to_string(), said);
            for operation in Operation::ALL {
                let heard = operation == Operation::Subscribe && said != "nothing";
                assert_eq!(grants.permits(operation, "/camera/x"), heard, "{operation:?}");
            }
        };
        let none = AccessPolicy::default();
        is(&none, &viewer, "subscribe:/**");
        is(&none, &Principal::admin("root"), "subscribe:/**");
        // For example, a deployer of another service may not subscribe to what no rule grants.
        is(&none, &robot("r1"), "nothing");
        let ruled = AccessPolicy {
            rules: vec![
                rule("role:robot", "*", &["*:**"]),
                rule("role:viewer", "*", &["*:/camera/**", "call:/detect"]),
                rule("mallory", "*", &["publish:/**"]),
            ],
        };
        is(&ruled, &robot("r1"), "subscribe:/**");
        is(&ruled, &viewer, "subscribe:/camera/**");
        let named = Principal { name: "mallory".into(), ..viewer };
        is(&ruled, &named, "nothing");
    }

    #[test]
    fn a_rule_for_a_principal_stands_in_place_of_those_of_its_role() {
        let policy = AccessPolicy {
            rules: vec![
                rule("role:robot", "*", &["*:**"]),
                rule("r1", "detector", &["subscribe:/camera/**"]),
                rule("r1", "det*", &["call:/detect"]),
                rule("role:viewer", "*", &["publish:/never"]),
            ],
        };
        let narrow = policy.grants(&robot("r1"), "detector");
        assert!(narrow.permits(Operation::Subscribe, "/camera/x") && narrow.permits(Operation::Call, "/detect"));
        assert!(!narrow.permits(Operation::Publish, "/cmd_vel") && !narrow.is_everything());
        assert!(narrow.permits_any("/detect") && !narrow.permits_any("/cmd_vel"));
        assert!(policy.grants(&robot("r1"), "mapper").is_everything());
        assert!(policy.grants(&robot("r2"), "detector").is_everything());
        assert!(AccessPolicy::default().grants(&Principal::admin("root"), "detector").is_everything());
    }

    #[test]
    fn who_is_read_as_it_is_written() {
        for text in ["r1", "role:robot", "role:viewer"] {
            assert_eq!(text.parse::<RuleSubject>().expect(text).to_string(), text);
        }
        for text in ["", "role:", "role:root", "a b", "*"] {
            text.parse::<RuleSubject>().expect_err(text);
        }
        let json = serde_json::to_string(&RuleSubject::Role(Role::Robot)).expect("JSON");
        assert_eq!(json, "\"role:robot\"");
        assert_eq!(serde_json::from_str::<RuleSubject>(&json).expect("read back"), RuleSubject::Role(Role::Robot));
    }

    fn some_rule() -> impl Strategy<Value = AccessRule> {
        let who = prop::sample::select(vec!["r1", "r2", "role:robot", "role:viewer"]);
        let services = prop::sample::select(vec!["*", "a", "b"]);
        let grant = prop::sample::select(vec!["*:**", "call:/x", "*:/x", "subscribe:/**", "publish:/y"]);
        (who, services, prop::collection::vec(grant, 0..3))
            .prop_map(|(who, services, allow)| rule(who, services, &allow))
    }

    proptest! {
        /// Everything granted comes from a rule for this principal or, if none names it, for its role; the order of
        /// rules does not matter.
        #[test]
        fn what_is_granted_stands_in_a_rule(
            rules in prop::collection::vec(some_rule(), 0..6),
            service in prop::sample::select(vec!["a", "b", "c"]),
            operation in prop::sample::select(Operation::ALL.to_vec()),
            name in prop::sample::select(vec!["/x", "/y", "/z"]),
        ) {
            let here = |rule: &&AccessRule| rule.services.matches(service);
            let own: Vec<&AccessRule> = rules.iter().filter(here).filter(|rule| rule.who.to_string() == "r1").collect();
            let of_role = |rule: &&AccessRule| rule.who.to_string() == "role:robot";
            let role: Vec<&AccessRule> = rules.iter().filter(here).filter(of_role).collect();
            let counted = if own.is_empty() { role } else { own };
            let expected = counted.iter().flat_map(|rule| &rule.allow).any(|grant| grant.permits(operation, name));
            let granted = |rules: Vec<AccessRule>| {
                AccessPolicy { rules }.grants(&robot("r1"), service).permits(operation, name)
            };
            let turned: Vec<AccessRule> = rules.iter().rev().cloned().collect();
            prop_assert_eq!(granted(rules.clone()), expected);
            prop_assert_eq!(granted(turned), expected);
        }
    }
}
