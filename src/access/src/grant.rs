//! Grants: `subscribe:/camera/**`, `call:/detect`.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Glob, as_text};

/// What a client does to a topic, a service or an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Operation {
    /// Sends messages on a topic, or advertises it.
    Publish,
    /// Receives a topic's messages.
    Subscribe,
    /// Calls a service, or sends goals to an action.
    Call,
    /// Serves a service or an action.
    Advertise,
}

impl Operation {
    /// All of them.
    pub const ALL: [Operation; 4] = [
        Operation::Publish,
        Operation::Subscribe,
        Operation::Call,
        Operation::Advertise,
    ];

    /// As grants name it.
    pub fn name(self) -> &'static str {
        match self {
            Operation::Publish => "publish",
            Operation::Subscribe => "subscribe",
            Operation::Call => "call",
            Operation::Advertise => "advertise",
        }
    }
}

/// The right to one operation, or all, on names of a pattern.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Grant {
    /// None: all.
    operation: Option<Operation>,
    names: Glob,
}

as_text!(Grant);

impl Grant {
    /// Whether it holds an operation on an absolute name.
    pub fn permits(&self, operation: Operation, name: &str) -> bool {
        self.operation.is_none_or(|granted| granted == operation) && self.names.matches(name)
    }

    /// One operation on all names.
    pub(crate) fn all(operation: Operation) -> Grant {
        Grant {
            operation: Some(operation),
            names: Glob::everything(),
        }
    }

    /// What is left of it where one operation alone may be granted.
    pub(crate) fn only(&self, operation: Operation) -> Option<Grant> {
        let has = self.operation.is_none_or(|granted| granted == operation);
        has.then(|| Grant {
            operation: Some(operation),
            names: self.names.clone(),
        })
    }

    /// Whether nothing is left out.
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
                let known = Operation::ALL
                    .into_iter()
                    .find(|known| known.name() == name);
                Some(known.ok_or_else(bad)?)
            }
        };
        // Names are absolute when they are compared; another pattern would never hold one.
        if !names.starts_with('/') && !names.starts_with("**") {
            return Err(bad());
        }
        Ok(Grant {
            operation,
            names: names.parse().map_err(|_| bad())?,
        })
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
        for text in [
            "subscribe:/camera/**",
            "call:/detect",
            "publish:/cmd_vel",
            "advertise:/robot/*",
            "*:**",
            "*:/a",
        ] {
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
            assert_eq!(
                grant.permits(operation, "/camera/x"),
                expected,
                "{operation:?}"
            );
        }
        assert!(!grant.permits(Operation::Subscribe, "/cmd_vel"));
        let all: Grant = "*:/camera/**".parse().expect("a grant");
        assert!(
            Operation::ALL
                .iter()
                .all(|operation| all.permits(*operation, "/camera/x"))
        );
        assert!(!all.is_everything());
        for text in ["*:**", "*:/**"] {
            assert!(text.parse::<Grant>().expect(text).is_everything());
        }
        assert!(!"call:**".parse::<Grant>().expect("a grant").is_everything());
    }
}
