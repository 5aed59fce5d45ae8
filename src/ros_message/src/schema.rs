//! Definitions of messages, services and actions: reads `.msg`, `.srv` and `.action` texts and produces
//! [`MessageType`]s with resolved fields, digest and a compiled codec plan.
//!
//! A [`Registry`] belongs to one ROS version. ROS 1's grammar, MD5 and full text are those of genmsg
//! (<http://wiki.ros.org/msg>), ROS 2's grammar and type hash those of rosidl (REP 2016): both ends of a connection
//! compare the digest, so it must agree to the bit. Each difference is confined to one module: the grammar (`parse` and
//! `parse::ros2`), the messages generated from services and actions (`action` and `derived`), the digest (`resolve` and
//! `description`). Names are `package/Type` in ROS 1 and `package/msg/Type` in ROS 2; both forms are accepted.

mod action;
mod derived;
mod description;
pub(crate) mod initial;
mod interface_files;
mod kind;
mod limits;
mod parse;
pub(crate) mod plan;
mod primitive;
mod registry;
mod resolve;
mod syntax;
mod text;
mod types;

#[cfg(test)]
mod tests;

pub use interface_files::{IdlError, InterfaceFile};
pub use limits::{ExceededLimit, MAX_DEPTH, MAX_FIELDS, MAX_MESSAGE_BYTES, MAX_TEXT_BYTES};
pub use primitive::Primitive;
pub use registry::Registry;
pub use syntax::SyntaxError;
pub use types::{ActionDef, ActionServices, Arity, Base, Constant, Field, FieldBounds, MessageType, ServiceDef};

/// Errors of definitions.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// A name is not of the form `package/Type`.
    #[error("{0:?} is not a type name, write package/Type")]
    BadName(String),
    /// The definition is unknown.
    #[error("no definition of {0} is known, install the package that has it or supply its text")]
    Unknown(String),
    /// A dependency is missing.
    #[error(
        "{needed_by} needs {name}, of which no definition is known; install the package that has it or supply its text"
    )]
    Missing {
        /// Name of the missing definition.
        name: String,
        /// Name of the definition that refers to it.
        needed_by: String,
    },
    /// A message contains itself.
    #[error("{0} contains itself")]
    Cycle(
        /// The cycle, as `a/A > a/B > a/A`.
        String,
    ),
    /// A line has a syntax error.
    #[error("{name} line {line}: {reason}")]
    Syntax {
        /// Name of the definition.
        name: String,
        /// Line number, from 1.
        line: usize,
        /// The problem.
        reason: Box<SyntaxError>,
    },
    /// A service lacks its `---` line, or an action lacks one of its two.
    #[error("{name} has {found} --- lines instead of {expected}")]
    Sections {
        /// Name of the definition.
        name: String,
        /// Required number of lines.
        expected: usize,
        /// Number of lines found.
        found: usize,
    },
    /// The definition exceeds a limit.
    #[error("{name} is too large: {reason}")]
    TooLarge {
        /// Name of the definition.
        name: String,
        /// The limit exceeded.
        reason: ExceededLimit,
    },
}
