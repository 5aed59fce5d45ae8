//! Parameters shared by all nodes of a ROS system.

mod changes;
mod reading;

use std::collections::BTreeMap;
use std::hash::{Hash, Hasher};

use async_trait::async_trait;

use super::BusError;
pub use changes::{ParamChangeReceiver, ParamChangeSender, param_change_channel};

/// One changed parameter: its key and its value, or `None` if it was deleted.
pub type ParamChange = (String, Option<ParamValue>);

/// Access to the parameters of a whole ROS system (ROS 1). In ROS 2 parameters belong to nodes.
#[async_trait]
pub trait GlobalParameters: Send + Sync {
    /// Returns a parameter or a whole namespace (`/` for all).
    async fn get(&self, key: &str) -> Result<ParamValue, BusError>;
    /// Sets a parameter; a map replaces the namespace below `key`.
    async fn set(&self, key: &str, value: ParamValue) -> Result<(), BusError>;
    /// Deletes a parameter.
    async fn delete(&self, key: &str) -> Result<(), BusError>;
    /// Returns true if the parameter is set.
    async fn has(&self, key: &str) -> Result<bool, BusError>;
    /// Searches upwards from `namespace`, as ROS does.
    async fn search(&self, namespace: &str, key: &str) -> Result<Option<String>, BusError>;
    /// Returns the keys of all parameters that are set.
    async fn names(&self) -> Result<Vec<String>, BusError>;
    /// Watches every change of any parameter from now on, including changes made by this bus. Where the parameters are
    /// those of nodes of ROS 2, an earlier watch ends.
    async fn watch(&self) -> Result<ParamChangeReceiver, BusError>;
}

/// A ROS parameter value. NaN equals NaN; otherwise comparing for changes would report a NaN forever.
///
/// Deserialization is bounded by [`MAX_DEPTH`](Self::MAX_DEPTH) and [`MAX_VALUES`](Self::MAX_VALUES).
#[derive(Debug, Clone, serde::Serialize)]
#[serde(untagged)]
pub enum ParamValue {
    /// `true` or `false`.
    Bool(bool),
    /// Integer; 32-bit on the XML-RPC wire, which refuses wider values.
    Int(i64),
    /// A double.
    Double(f64),
    /// UTF-8 text.
    String(String),
    /// Bytes: XML-RPC's base64. Serialized to JSON as base64 text, and deserialized as text.
    #[serde(serialize_with = "as_base64")]
    Binary(Vec<u8>),
    /// No value: a Master may hold it, but ROS does not define it. Never sent.
    Nil,
    /// A list.
    List(Vec<ParamValue>),
    /// A dictionary.
    Map(BTreeMap<String, ParamValue>),
}

fn as_base64<S: serde::Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&base64_simd::STANDARD.encode_to_string(bytes))
}

impl PartialEq for ParamValue {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Bool(a), Self::Bool(b)) => a == b,
            (Self::Int(a), Self::Int(b)) => a == b,
            (Self::Double(a), Self::Double(b)) => a == b || (a.is_nan() && b.is_nan()),
            (Self::String(a), Self::String(b)) => a == b,
            (Self::Binary(a), Self::Binary(b)) => a == b,
            (Self::Nil, Self::Nil) => true,
            (Self::List(a), Self::List(b)) => a == b,
            (Self::Map(a), Self::Map(b)) => a == b,
            _ => false,
        }
    }
}

/// Equal values have equal hashes: all zeros and all NaNs hash alike, whatever their sign and bits.
impl Hash for ParamValue {
    fn hash<H: Hasher>(&self, state: &mut H) {
        std::mem::discriminant(self).hash(state);
        match self {
            Self::Bool(truth) => truth.hash(state),
            Self::Int(number) => number.hash(state),
            Self::Double(number) if number.is_nan() => f64::NAN.to_bits().hash(state),
            Self::Double(number) => (number + 0.0).to_bits().hash(state),
            Self::String(text) => text.hash(state),
            Self::Binary(bytes) => bytes.hash(state),
            Self::Nil => {}
            Self::List(items) => items.hash(state),
            Self::Map(members) => members.hash(state),
        }
    }
}
