//! Errors of types without a twin, and of messages that cannot be carried.

use ros_message::RosVersion;
use ros_message::codec::CodecError;
use ros_message::schema::SchemaError;

/// An error of a message that cannot be carried to the other ROS; it names the field.
pub type TranslationError = CodecError;

/// A type that has no twin in the other ROS.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{name} of ROS {} cannot be carried to ROS {}: {reason}", .version.number(), other_version(*.version).number())]
pub struct NoTwin {
    /// Name of the type, as in the ROS that it belongs to.
    pub name: String,
    /// The ROS that the type belongs to.
    pub version: RosVersion,
    /// The problem.
    pub reason: NoTwinReason,
}

/// Reasons for which a type has no twin.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoTwinReason {
    /// Each of the two definitions has fields that the other one lacks, so that they cannot be told to mean the same.
    #[error(
        "{name} alone has {}, and {twin} alone has {}; pair them by a rule (fields_1_to_2)",
        .only_in_name.join(", "), .only_in_twin.join(", ")
    )]
    Fields {
        /// Name of the message.
        name: String,
        /// Name of the message in the other ROS.
        twin: String,
        /// Fields that the twin lacks.
        only_in_name: Vec<String>,
        /// Fields that the twin alone has.
        only_in_twin: Vec<String>,
    },
    /// Two fields of one name have types that are not converted into each other.
    #[error("field {field} of {name} is {found} and field {twin_field} of {twin} is {twin_found}")]
    FieldType {
        /// Name of the message.
        name: String,
        /// Path of the field.
        field: String,
        /// Type of the field.
        found: String,
        /// Name of the message in the other ROS.
        twin: String,
        /// Path of the field there.
        twin_field: String,
        /// Type of the field there.
        twin_found: String,
    },
    /// A rule names a field that does not exist, or that cannot be paired.
    #[error("{rule} names the field {path:?}, which {name} does not have")]
    NoSuchField {
        /// Place of the rule: file and number.
        rule: String,
        /// The path as written.
        path: String,
        /// Name of the message.
        name: String,
    },
    /// The definition of the twin does not follow from the type and its rule.
    #[error("{rule} pairs {path:?} of {twin}, whose definition is unknown; give it by ros1_definition or ros2_definition")]
    NoDefinition {
        /// Place of the rule: file and number.
        rule: String,
        /// The path that cannot be derived.
        path: String,
        /// Name of the twin.
        twin: String,
    },
    /// Two fields would have the same name in the other ROS.
    #[error("fields {first} and {second} of {name} would have the same name in the other ROS; pair them by a rule")]
    SameName {
        /// Name of the message.
        name: String,
        /// A field.
        first: String,
        /// Another one.
        second: String,
    },
    /// The definition of the twin is not valid.
    #[error("the other ROS cannot express it: {0}")]
    Definition(
        /// The problem.
        SchemaError,
    ),
}

/// Returns the other ROS version.
pub(crate) fn other_version(version: RosVersion) -> RosVersion {
    match version {
        RosVersion::One => RosVersion::Two,
        RosVersion::Two => RosVersion::One,
    }
}
