//! Grants, such as `subscribe:/camera/**` or `call:/detect`.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Glob, as_text};

/// An operation of a client on a topic, service or action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Operation {
    /// Publish or advertise a topic.
    Publish,
    /// Subscribe to a topic.
    Subscribe,
    /// Call a service, or send goals to an action.
    Call,
    /// Serve a service or an action.
    Advertise,
}

impl Operation {
    /// All operations.
    pub const ALL: [Operation; 4] = [Operation::Publish, Operation::Subscribe, Operation::Call, Operation::Advertise];

    /// Returns the name used in grants.
    pub fn name(self) -> &'static str {
        match self {
            Operation::Publish => "publish",
            Operation::Subscribe => "subscribe",
            Operation::Call => "call",
            Operation::Advertise => "advertise",
        }
    }
}

/// Permission for one operation, or all, on the names matching a pattern.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Grant {
    /// The operation; `None` for all.
    operation: Option<Operation>,
    names: Glob,
}

as_text!(Grant);

impl Grant {
    /// Returns true if the grant covers the operation on an absolute name.
    pub fn permits(&self, operation: Operation, name: &str) -> bool {
        self.operation.is_none_or(|granted| granted == operation) && self.names.matches(name)
    }

    /// Creates a grant of one operation on all names.
    pub(crate) fn all(operation: Operation) -> Grant {
        Grant { operation: Some(operation), names: Glob::everything() }
    }

    /// Returns the part of the grant that covers `operation`, if any.
    pub(crate) fn restrict_to(&self, operation: Operation) -> Option<Grant> {
        let has = self.operation.is_none_or(|granted| granted == operation);
        has.then(|| Grant { operation: Some(operation), names: self.names.clone() })
    }

    /// Returns true if the grant covers all operations on all names.
    pub fn is_everything(&self) -> bool {
        let names = self.names.as_str();
        self.operation.is_none() && (names == "**" || names == "/**")
    }
}

impl FromStr for Grant {
    type Err = Error;

    fn from_str(text: &str) -> Result<Grant, Error> {
        let bad = || Error::Grant(text.to_owned());
        let (operation, names) = text.split_once(':').ok_or_else(bad)?;
        let operation = match operation {
            "*" => None,
            name => {
                let known = Operation::ALL.into_iter().find(|known| known.name() == name);
                Some(known.ok_or_else(bad)?)
            }
        };
        // Compared names are absolute, so another pattern would never match.
        if !names.starts_with('/') && !names.starts_with("**") {
            return Err(bad());
        }
        Ok(Grant { operation, names: names.parse().map_err(|_| bad())? })
    }
}

impl fmt::Display for Grant {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let operation = self.operation.map_or("*", Operation::name);
        write!(out, "{operation}:{}", self.names)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grants_are_read_as_they_are_written() {
        for text in ["subscribe:/camera/**", "call:/detect", "publish:/cmd_vel", "advertise:/robot/*", "*:**", "*:/a"] {
            let grant: Grant = text.parse().expect(text);
            assert_eq!(grant.to_string(), text);
        }
        for text in [
            "",
            "subscribe",
            "subscribe:",
            "subscribe:camera",
            "subscribe:*",
            "listen:/camera",
            "Subscribe:/x",
            ":/x",
            "call:/a b",
        ] {
            let refused = text.parse::<Grant>().expect_err(text).to_string();
            assert!(refused.contains("OPERATION:NAME"), "{refused}");
        }
    }

    #[test]
    fn an_operation_is_granted_alone() {
        let grant: Grant = "subscribe:/camera/**".parse().expect("a grant");
        for operation in Operation::ALL {
            let expected = operation == Operation::Subscribe;
            assert_eq!(grant.permits(operation, "/camera/x"), expected, "{operation:?}");
        }
        assert!(!grant.permits(Operation::Subscribe, "/cmd_vel"));
        let all: Grant = "*:/camera/**".parse().expect("a grant");
        assert!(Operation::ALL.iter().all(|operation| all.permits(*operation, "/camera/x")));
        assert!(!all.is_everything());
        for text in ["*:**", "*:/**"] {
            assert!(text.parse::<Grant>().expect(text).is_everything());
        }
        assert!(!"call:**".parse::<Grant>().expect("a grant").is_everything());
    }
}
