//! XML-RPC values and their conversion to ROS values.

use std::collections::BTreeMap;

use ros_bus::ParamValue;

/// One value.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `<int>` or `<i4>`.
    Int(i32),
    /// `<boolean>`.
    Bool(bool),
    /// `<string>`, or text without any element.
    String(String),
    /// `<double>`.
    Double(f64),
    /// `<base64>`, decoded.
    Base64(Vec<u8>),
    /// `<dateTime.iso8601>`, as written.
    DateTime(String),
    /// `<array>`.
    Array(Vec<Value>),
    /// `<struct>`.
    Struct(BTreeMap<String, Value>),
    /// `<nil/>`: accepted, never sent by ROS.
    Nil,
}

impl Value {
    /// Returns the text of a string.
    pub fn as_str(&self) -> Option<&str> {
        match self {
            Value::String(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the number of an int.
    pub fn as_int(&self) -> Option<i32> {
        match self {
            Value::Int(number) => Some(*number),
            _ => None,
        }
    }

    /// Returns the elements of an array.
    pub fn as_array(&self) -> Option<&[Value]> {
        match self {
            Value::Array(elements) => Some(elements),
            _ => None,
        }
    }

    /// Returns the members of a struct.
    pub fn as_struct(&self) -> Option<&BTreeMap<String, Value>> {
        match self {
            Value::Struct(members) => Some(members),
            _ => None,
        }
    }

    /// Returns one member of a struct.
    pub fn get(&self, member: &str) -> Option<&Value> {
        self.as_struct()?.get(member)
    }

    /// Creates an array of strings.
    pub fn strings<I: IntoIterator<Item: Into<String>>>(texts: I) -> Value {
        Value::Array(texts.into_iter().map(|text| Value::String(text.into())).collect())
    }

    /// Returns the strings in an array; elements of other types are skipped.
    pub fn to_strings(&self) -> Vec<String> {
        self.as_array().unwrap_or_default().iter().filter_map(|value| value.as_str().map(str::to_owned)).collect()
    }

    /// Returns the name of the type for error messages.
    pub fn type_name(&self) -> &'static str {
        match self {
            Value::Int(_) => "an int",
            Value::Bool(_) => "a boolean",
            Value::String(_) => "a string",
            Value::Double(_) => "a double",
            Value::Base64(_) => "base64",
            Value::DateTime(_) => "a dateTime",
            Value::Array(_) => "an array",
            Value::Struct(_) => "a struct",
            Value::Nil => "nil",
        }
    }

    /// Returns the nesting depth of arrays and structs.
    pub fn depth(&self) -> usize {
        match self {
            Value::Array(elements) => 1 + elements.iter().map(Value::depth).max().unwrap_or(0),
            Value::Struct(members) => 1 + members.values().map(Value::depth).max().unwrap_or(0),
            _ => 0,
        }
    }

    /// Returns the approximate memory size of the value in bytes.
    pub fn size(&self) -> usize {
        size_of::<Value>()
            + match self {
                Value::String(text) | Value::DateTime(text) => text.len(),
                Value::Base64(bytes) => bytes.len(),
                Value::Array(elements) => elements.iter().map(Value::size).sum(),
                Value::Struct(members) => {
                    members.iter().map(|(name, value)| size_of::<String>() + name.len() + value.size()).sum()
                }
                Value::Int(_) | Value::Bool(_) | Value::Double(_) | Value::Nil => 0,
            }
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Value::String(text.to_owned())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Value::String(text)
    }
}

impl From<i32> for Value {
    fn from(number: i32) -> Self {
        Value::Int(number)
    }
}

impl From<bool> for Value {
    fn from(truth: bool) -> Self {
        Value::Bool(truth)
    }
}

impl From<Vec<Value>> for Value {
    fn from(elements: Vec<Value>) -> Self {
        Value::Array(elements)
    }
}

/// Converts to a bus value; a date becomes its text.
impl From<Value> for ParamValue {
    fn from(value: Value) -> Self {
        match value {
            Value::Int(number) => ParamValue::Int(number.into()),
            Value::Bool(truth) => ParamValue::Bool(truth),
            Value::String(text) | Value::DateTime(text) => ParamValue::String(text),
            Value::Double(number) => ParamValue::Double(number),
            Value::Base64(bytes) => ParamValue::Binary(bytes),
            Value::Array(elements) => ParamValue::List(elements.into_iter().map(ParamValue::from).collect()),
            Value::Struct(members) => {
                ParamValue::Map(members.into_iter().map(|(name, value)| (name, value.into())).collect())
            }
            Value::Nil => ParamValue::Nil,
        }
    }
}

/// The reason why ROS 1 cannot send a value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UnsendableValue {
    /// An integer has more than XML-RPC's 32 bits.
    #[error("{0} does not fit XML-RPC's 32-bit integer")]
    WideInteger(i64),
    /// ROS 1 has no null.
    #[error("ROS has no null value")]
    Nil,
    /// A member of a dictionary cannot be sent.
    #[error("{name}: {reason}")]
    InMember {
        /// Name of the member.
        name: String,
        /// The reason.
        reason: Box<UnsendableValue>,
    },
}

/// Fails on `Nil` and on integers wider than XML-RPC's 32 bits.
impl TryFrom<ParamValue> for Value {
    type Error = UnsendableValue;

    fn try_from(value: ParamValue) -> Result<Self, UnsendableValue> {
        Ok(match value {
            ParamValue::Bool(truth) => Value::Bool(truth),
            ParamValue::Int(number) => {
                Value::Int(i32::try_from(number).map_err(|_| UnsendableValue::WideInteger(number))?)
            }
            ParamValue::Double(number) => Value::Double(number),
            ParamValue::String(text) => Value::String(text),
            ParamValue::Binary(bytes) => Value::Base64(bytes),
            ParamValue::Nil => return Err(UnsendableValue::Nil),
            ParamValue::List(elements) => {
                Value::Array(elements.into_iter().map(Value::try_from).collect::<Result<_, _>>()?)
            }
            ParamValue::Map(members) => Value::Struct(
                members
                    .into_iter()
                    .map(|(name, value)| match Value::try_from(value) {
                        Ok(value) => Ok((name, value)),
                        Err(reason) => {
                            let reason = Box::new(reason);
                            Err(UnsendableValue::InMember { name, reason })
                        }
                    })
                    .collect::<Result<_, _>>()?,
            ),
        })
    }
}
