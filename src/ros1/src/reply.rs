//! The convention of all ROS 1 XML-RPC APIs: positional arguments, answers of the form `[code, message, value]`.

use super::names::PeerUri;
use super::xmlrpc::Value;

/// The answer of a method.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ApiReply {
    /// 1: success, 0: failure, -1: error of the caller.
    pub(crate) code: i32,
    pub(crate) message: String,
    pub(crate) value: Value,
}

impl ApiReply {
    pub(crate) fn success(message: impl Into<String>, value: impl Into<Value>) -> Self {
        Self { code: 1, message: message.into(), value: value.into() }
    }

    pub(crate) fn failure(message: impl Into<String>, value: impl Into<Value>) -> Self {
        Self { code: 0, message: message.into(), value: value.into() }
    }

    pub(crate) fn error(message: impl Into<String>, value: impl Into<Value>) -> Self {
        Self { code: -1, message: message.into(), value: value.into() }
    }

    pub(crate) fn into_value(self) -> Value {
        Value::Array(vec![self.code.into(), self.message.into(), self.value])
    }

    /// Reads an answer; `None` if it has another form.
    pub(crate) fn from_value(value: Value) -> Option<Self> {
        let Value::Array(elements) = value else {
            return None;
        };
        let [code, message, value] = <[Value; 3]>::try_from(elements).ok()?;
        Some(Self {
            code: code.as_int()?,
            message: match message {
                Value::String(text) => text,
                _ => String::new(),
            },
            value,
        })
    }
}

/// A call's arguments, taken one by one; a missing or wrong one is reported as the caller's error.
pub(crate) struct Args {
    values: std::vec::IntoIter<Value>,
}

impl Args {
    pub(crate) fn new(values: Vec<Value>) -> Self {
        Self { values: values.into_iter() }
    }

    /// Takes the next argument, of any type.
    pub(crate) fn value(&mut self, what: &str) -> Result<Value, ApiReply> {
        self.values.next().ok_or_else(|| argument_error(format!("argument {what} is missing")))
    }

    /// Takes the next argument, which must be a non-empty string.
    pub(crate) fn text(&mut self, what: &str) -> Result<String, ApiReply> {
        match self.value(what)? {
            Value::String(text) if text.is_empty() => Err(argument_error(format!("{what} is empty"))),
            Value::String(text) if text.len() > 4096 => {
                Err(argument_error(format!("{what} is longer than 4096 bytes")))
            }
            Value::String(text) => Ok(text),
            other => Err(argument_error(format!("{what} must be a string, not {}", other.type_name()))),
        }
    }

    /// Takes the next argument, which must be an address of the given scheme.
    pub(crate) fn uri(&mut self, what: &str, scheme: &str) -> Result<String, ApiReply> {
        let text = self.text(what)?;
        match PeerUri::parse(&text, scheme) {
            Some(_) => Ok(text),
            None => Err(argument_error(format!("{what} is not a {scheme}:// address: {text}"))),
        }
    }

    /// Checks that no argument is left.
    pub(crate) fn finish(&mut self) -> Result<(), ApiReply> {
        match self.values.next() {
            None => Ok(()),
            Some(_) => Err(argument_error("bad call arity: too many arguments".to_owned())),
        }
    }
}

fn argument_error(message: String) -> ApiReply {
    ApiReply::error(format!("ERROR: {message}"), 0)
}
