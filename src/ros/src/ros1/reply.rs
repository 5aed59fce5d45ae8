//! The convention of all ROS 1 XML-RPC APIs: arguments by position, answers `[code, message, value]`.

use super::names::PeerUri;
use super::xmlrpc::Value;

/// What every method answers.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Reply {
    /// 1 done, 0 not done, -1 the caller's mistake.
    pub(crate) code: i32,
    pub(crate) message: String,
    pub(crate) value: Value,
}

impl Reply {
    pub(crate) fn done(message: impl Into<String>, value: impl Into<Value>) -> Self {
        Self {
            code: 1,
            message: message.into(),
            value: value.into(),
        }
    }

    pub(crate) fn not_done(message: impl Into<String>, value: impl Into<Value>) -> Self {
        Self {
            code: 0,
            message: message.into(),
            value: value.into(),
        }
    }

    pub(crate) fn mistake(message: impl Into<String>, value: impl Into<Value>) -> Self {
        Self {
            code: -1,
            message: message.into(),
            value: value.into(),
        }
    }

    pub(crate) fn into_value(self) -> Value {
        Value::Array(vec![self.code.into(), self.message.into(), self.value])
    }

    /// Reads an answer; `None` if it is not of this shape.
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

/// A call's arguments, taken one by one; what is missing or wrong becomes the caller's mistake.
pub(crate) struct Args {
    values: std::vec::IntoIter<Value>,
}

impl Args {
    pub(crate) fn new(values: Vec<Value>) -> Self {
        Self {
            values: values.into_iter(),
        }
    }

    /// The next argument, whatever it is.
    pub(crate) fn any(&mut self, what: &str) -> Result<Value, Reply> {
        self.values
            .next()
            .ok_or_else(|| mistake(format!("argument {what} is missing")))
    }

    /// The next argument, a string that is not empty.
    pub(crate) fn text(&mut self, what: &str) -> Result<String, Reply> {
        match self.any(what)? {
            Value::String(text) if text.is_empty() => Err(mistake(format!("{what} is empty"))),
            Value::String(text) if text.len() > 4096 => {
                Err(mistake(format!("{what} is longer than 4096 bytes")))
            }
            Value::String(text) => Ok(text),
            other => Err(mistake(format!(
                "{what} must be a string, not {}",
                other.type_name()
            ))),
        }
    }

    /// The next argument, an address of the given scheme.
    pub(crate) fn uri(&mut self, what: &str, scheme: &str) -> Result<String, Reply> {
        let text = self.text(what)?;
        match PeerUri::parse(&text, scheme) {
            Some(_) => Ok(text),
            None => Err(mistake(format!("{what} is no {scheme}:// address: {text}"))),
        }
    }

    /// No argument may be left.
    pub(crate) fn end(&mut self) -> Result<(), Reply> {
        match self.values.next() {
            None => Ok(()),
            Some(_) => Err(mistake("bad call arity: too many arguments".to_owned())),
        }
    }
}

fn mistake(message: String) -> Reply {
    Reply::mistake(format!("ERROR: {message}"), 0)
}
