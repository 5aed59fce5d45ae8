//! Definitions of messages, services and actions: `.msg`, `.srv` and `.action` texts in, [`MessageType`]s with
//! resolved fields, digest and a compiled codec plan out.
//!
//! A [`Registry`] is of one version of ROS. ROS 1's grammar, MD5 and full text are those of genmsg
//! (<http://wiki.ros.org/msg>), ROS 2's grammar and type hash those of rosidl (REP 2016): both ends of a connection
//! compare the digest, so it must agree to the bit. What differs is one module each: the grammar (`parse` and
//! `parse::ros2`), the messages that services and actions bring (`action` and `derived`), the digest (`resolve` and
//! `description`). Names are `package/Type` in ROS 1 and `package/msg/Type` in ROS 2; either is understood.

mod action;
mod derived;
mod description;
pub(crate) mod initial;
mod interface_files;
mod limits;
mod parse;
pub(crate) mod plan;
mod registry;
mod resolve;
mod text;
mod types;

#[cfg(test)]
mod tests;

pub use interface_files::InterfaceFile;
pub use limits::{MAX_DEPTH, MAX_FIELDS, MAX_MESSAGE_BYTES, MAX_TEXT_BYTES};
pub use registry::Registry;
pub use types::{
    ActionDef, ActionServices, Arity, Base, Bounds, Constant, Field, MessageType, Primitive,
    ServiceDef,
};

/// Why a definition cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// Not of the form `package/Type`.
    #[error("{0:?} is not a type name, write package/Type")]
    BadName(String),
    /// Nobody has given this definition.
    #[error("no definition of {0} is known, install the package that has it or supply its text")]
    Unknown(String),
    /// A dependency is missing.
    #[error(
        "{needed_by} needs {name}, of which no definition is known; install the package that has it or supply its text"
    )]
    Missing {
        /// What is missing.
        name: String,
        /// Which definition mentions it.
        needed_by: String,
    },
    /// A message contains itself.
    #[error("{0} contains itself")]
    Cycle(
        /// The way round, `a/A > a/B > a/A`.
        String,
    ),
    /// A line that is not in the language.
    #[error("{name} line {line}: {reason}")]
    Syntax {
        /// Which definition.
        name: String,
        /// From 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A service without its `---` line, an action without its two.
    #[error("{name} has {found} --- lines instead of {expected}")]
    Sections {
        /// Which definition.
        name: String,
        /// How many there must be.
        expected: usize,
        /// The number found.
        found: usize,
    },
    /// Larger than any honest definition.
    #[error("{name} is too large: {reason}")]
    TooLarge {
        /// Which definition.
        name: String,
        /// Which limit it breaks.
        reason: String,
    },
}
