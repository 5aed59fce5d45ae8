//! Who may do what: one policy, pure functions over plain data. In: a principal, and what it wants to do to which object.
//! Out: yes, or a refusal in words. What no role allows is refused.
//!
//! ```text
//!  Principal (roles, scope) ──┬─ decide(action, object) ─▶ may the request be answered?     HTTP, links, connections
//!                             └─ Policy::grants(service) ─▶ Grants::permits(operation, name)  each rosbridge operation
//! ```
//!
//! Actions are decided by role and scope alone ([`decide`]). Within a service that a principal may connect to, the rules of
//! the policy say which topics, services and actions it may use ([`policy`]).

#![forbid(unsafe_code)]

pub mod decide;
pub mod glob;
pub mod grant;
pub mod guesses;
pub mod host;
pub mod policy;
pub mod principal;
pub mod sparing;

pub use decide::{Action, Object, Refusal, decide};
pub use glob::Glob;
pub use grant::{Grant, Operation};
pub use guesses::{Guesser, Guesses};
pub use host::{Host, largest_network};
pub use policy::{Grants, Policy, Rule, Standing, Who};
pub use principal::{Principal, Role, Scope};
pub use sparing::Sparing;

/// A text that is none of what it should be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// A pattern.
    #[error(
        "{0:?} is no pattern of names; use 1 to 255 characters, with * for any characters within a segment and ** for any at all"
    )]
    Glob(String),
    /// A grant.
    #[error(
        "{0:?} is no grant; write OPERATION:NAME, such as subscribe:/camera/** or call:/detect, with publish, subscribe, call, \
         advertise or * as the operation"
    )]
    Grant(String),
    /// A role.
    #[error("there is no role {0:?}; there are admin, operator, deployer, robot and viewer")]
    Role(String),
    /// A principal's name.
    #[error(
        "{0:?} is no name of a principal; use 1 to 64 letters, digits, '.', '_' or '-', beginning with a letter or digit"
    )]
    Name(String),
}

/// Reads and writes a type as its text.
macro_rules! as_text {
    ($type:ty) => {
        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.collect_str(self)
            }
        }

        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let text = <std::borrow::Cow<'de, str>>::deserialize(deserializer)?;
                text.parse().map_err(serde::de::Error::custom)
            }
        }
    };
}
pub(crate) use as_text;
