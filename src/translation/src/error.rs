//! Errors of types without a twin, and of messages that cannot be carried.

use ros_message::RosVersion;
use ros_message::codec::CodecError;
use ros_message::schema::SchemaError;

/// An error of a message that cannot be carried to the other ROS; it names the field.
pub type TranslationError = CodecError;

/// Maximum difference between the smallest messages of two twins, in bytes.
pub(crate) const MAX_DIFFERENCE: usize = 1 << 20;

/// A type that has no twin in the other ROS.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{name} of ROS {} has no counterpart in ROS {}: {reason}", .version.number(), .version.other().number())]
pub struct NoTwin {
    /// Name of the type, as in the ROS that it belongs to.
    pub name: String,
    /// The ROS that the type belongs to.
    pub version: RosVersion,
    /// The problem.
    pub reason: Box<NoTwinReason>,
}

/// Reasons for which a type has no twin. `one` names a message of ROS 1, `two` the message of ROS 2 that belongs to it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoTwinReason {
    /// Each of the two definitions has fields that the other one lacks: they may mean the same or not.
    #[error(
        "{one} of ROS 1 alone has {}, {two} of ROS 2 alone has {}; pair their fields by a rule (fields_1_to_2)",
        .only_in_one.join(", "), .only_in_two.join(", ")
    )]
    Fields {
        /// Name of the message in ROS 1.
        one: String,
        /// Name of the message in ROS 2.
        two: String,
        /// Fields that ROS 1 alone has.
        only_in_one: Vec<String>,
        /// Fields that ROS 2 alone has.
        only_in_two: Vec<String>,
    },
    /// The types of two fields are not converted into each other.
    #[error("{0}")]
    FieldType(
        /// The fields.
        Box<UnlikeFields>,
    ),
    /// A rule names a field that does not exist.
    #[error("{rule} names field {path:?}, which {name} does not have; correct the rule")]
    NoSuchField {
        /// Place of the rule.
        rule: String,
        /// The path as written.
        path: String,
        /// Name of the message.
        name: String,
    },
    /// A rule names a field twice, or a field and a part of it.
    #[error("{rule} names field {path:?} of {name} twice, as a whole or in part; name it once")]
    Overlap {
        /// Place of the rule.
        rule: String,
        /// The path as written.
        path: String,
        /// Name of the message.
        name: String,
    },
    /// The definition of the twin is unknown and does not follow from the rule.
    #[error(
        "{rule} pairs field {path:?} of {name}, whose definition is unknown; \
         add it to the rule (ros1_definition or ros2_definition)"
    )]
    NoDefinition {
        /// Place of the rule.
        rule: String,
        /// The path as written.
        path: String,
        /// Name of the message.
        name: String,
    },
    /// Two fields would have the same name in ROS 2, which knows no capital letters in them.
    #[error("fields {first} and {second} of {name} would have one name in ROS 2; name them by a rule (fields_1_to_2)")]
    SameName {
        /// Name of the message.
        name: String,
        /// A field.
        first: String,
        /// Another one.
        second: String,
    },
    /// A message with nothing in it takes far more bytes on one side: whoever sends a few bytes would have as many
    /// written for each.
    #[error(
        "an empty {one} has {one_bytes} bytes in ROS 1, an empty {two} {two_bytes} bytes in ROS 2, and they may differ \
         by {MAX_DIFFERENCE}; shorten the arrays of fixed length in it"
    )]
    EmptySize {
        /// Name of the message in ROS 1.
        one: String,
        /// Size of the smallest message in ROS 1.
        one_bytes: usize,
        /// Name of the message in ROS 2.
        two: String,
        /// Size of the smallest message in ROS 2.
        two_bytes: usize,
    },
    /// The definition of the twin is not valid.
    #[error("{0}")]
    Definition(
        /// The problem.
        SchemaError,
    ),
}

/// Two fields that belong together and whose types are not converted into each other.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{one_field} of {one} is {one_type} in ROS 1, {two_field} of {two} is {two_type} in ROS 2; change one of them")]
pub struct UnlikeFields {
    /// Name of the message in ROS 1.
    pub one: String,
    /// Path of the field there.
    pub one_field: String,
    /// Type of the field there.
    pub one_type: String,
    /// Name of the message in ROS 2.
    pub two: String,
    /// Path of the field there.
    pub two_field: String,
    /// Type of the field there.
    pub two_type: String,
}
