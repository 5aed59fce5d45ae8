//! Access control: one policy, as pure functions over plain data. Input: a principal and the action it wants to
//! perform on an object. Output: permission, or a refusal with a message. What no role allows is refused.
//!
//! ```text
//!  Principal (roles, scope) ──┬─ decide(action, object) ─▶ may the request be answered?     HTTP, links, connections
//!                             └─ AccessPolicy::grants(service) ─▶ Grants::permits(operation, name)  rosbridge
//! ```
//!
//! Actions are decided by role and scope alone ([`decide`]). For services that a principal may connect to, the
//! policy's rules determine which topics, services and actions it may use ([`policy`]).

#![forbid(unsafe_code)]

pub mod decide;
pub mod glob;
pub mod grant;
pub mod guesses;
pub mod host;
pub mod policy;
pub mod principal;

pub use decide::{AccessAction, AccessDenied, AccessObject, decide};
pub use glob::Glob;
pub use grant::{Grant, Operation};
pub use guesses::{GuessLimiter, GuessSource};
pub use host::{Host, largest_network};
pub use policy::{AccessPolicy, AccessRule, ConnectionAccess, Grants, RuleSubject};
pub use principal::{Principal, Role, Scope};

/// Error for text that cannot be parsed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// Invalid name pattern.
    #[error(
        "{0:?} is not a pattern; use 1 to 255 characters, with * for any characters within a segment and ** for any at \
            all"
    )]
    Glob(String),
    /// Invalid grant.
    #[error(
        "{0:?} is not a grant; write OPERATION:NAME, such as subscribe:/camera/** or call:/detect, with publish, \
            subscribe, call, advertise or * as the operation"
    )]
    Grant(String),
    /// Unknown role.
    #[error("unknown role {0:?}; the roles are admin, operator, deployer, robot and viewer")]
    Role(String),
    /// Invalid name of a principal.
    #[error(
        "{0:?} is not a valid name; use 1 to 64 letters, digits, '.', '_' or '-', beginning with a letter or digit"
    )]
    Name(String),
}

/// Implements serde traits for a type by its text form.
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
