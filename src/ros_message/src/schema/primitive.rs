//! Built-in types.

use crate::RosVersion;

/// Built-in types. `char` is [`Primitive::Uint8`]; `byte` is [`Primitive::Int8`] in ROS 1 and [`Primitive::Uint8`] in
/// ROS 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Primitive {
    /// One byte; any value but 0 is true.
    Bool,
    /// Also written `byte`.
    Int8,
    /// Also written `char`.
    Uint8,
    /// Two bytes; little endian in ROS 1, like all that follow.
    Int16,
    /// Two bytes.
    Uint16,
    /// Four bytes.
    Int32,
    /// Four bytes.
    Uint32,
    /// Eight bytes.
    Int64,
    /// Eight bytes.
    Uint64,
    /// IEEE 754 single.
    Float32,
    /// IEEE 754 double.
    Float64,
    /// A four-byte length and that many bytes, UTF-8 by convention.
    String,
    /// `uint32 secs, uint32 nsecs`; ROS 1 only.
    Time,
    /// `int32 secs, int32 nsecs`; ROS 1 only.
    Duration,
    /// A four-byte length and that many UTF-16 units; ROS 2 only.
    Wstring,
}

impl Primitive {
    /// Returns the primitive of this name in a ROS version, including aliases.
    pub fn from_versioned_name(version: RosVersion, name: &str) -> Option<Primitive> {
        match (version, name) {
            (RosVersion::One, _) => Self::from_name(name),
            (RosVersion::Two, "byte") => Some(Primitive::Uint8),
            (RosVersion::Two, "wstring") => Some(Primitive::Wstring),
            (RosVersion::Two, "time" | "duration") => None,
            (RosVersion::Two, _) => Self::from_name(name),
        }
    }

    /// Returns the primitive of this name in ROS 1, including aliases.
    pub fn from_name(name: &str) -> Option<Primitive> {
        Some(match name {
            "bool" => Primitive::Bool,
            "int8" | "byte" => Primitive::Int8,
            "uint8" | "char" => Primitive::Uint8,
            "int16" => Primitive::Int16,
            "uint16" => Primitive::Uint16,
            "int32" => Primitive::Int32,
            "uint32" => Primitive::Uint32,
            "int64" => Primitive::Int64,
            "uint64" => Primitive::Uint64,
            "float32" => Primitive::Float32,
            "float64" => Primitive::Float64,
            "string" => Primitive::String,
            "time" => Primitive::Time,
            "duration" => Primitive::Duration,
            _ => return None,
        })
    }

    /// Returns the ROS name.
    pub fn name(self) -> &'static str {
        match self {
            Primitive::Bool => "bool",
            Primitive::Int8 => "int8",
            Primitive::Uint8 => "uint8",
            Primitive::Int16 => "int16",
            Primitive::Uint16 => "uint16",
            Primitive::Int32 => "int32",
            Primitive::Uint32 => "uint32",
            Primitive::Int64 => "int64",
            Primitive::Uint64 => "uint64",
            Primitive::Float32 => "float32",
            Primitive::Float64 => "float64",
            Primitive::String => "string",
            Primitive::Time => "time",
            Primitive::Duration => "duration",
            Primitive::Wstring => "wstring",
        }
    }

    /// Returns the serialized size in bytes; for strings, the size of the length.
    pub fn size(self) -> usize {
        match self {
            Primitive::Bool | Primitive::Int8 | Primitive::Uint8 => 1,
            Primitive::Int16 | Primitive::Uint16 => 2,
            Primitive::Int32 | Primitive::Uint32 | Primitive::Float32 | Primitive::String | Primitive::Wstring => 4,
            Primitive::Int64 | Primitive::Uint64 | Primitive::Float64 | Primitive::Time | Primitive::Duration => 8,
        }
    }
}
