//! Parameters that belong to individual nodes.

use async_trait::async_trait;

use super::{BusError, FailureReason, ParamChange, ParamValue};

/// Access to the parameters of each node (ROS 2). In ROS 1 all nodes share their parameters.
#[async_trait]
pub trait NodeParameters: Send + Sync {
    /// Returns the values of parameters, in the order requested; `None` for a parameter that is missing or not set.
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError>;
    /// Sets parameters, or deletes those without a value, one after the other. Returns for each whether the node
    /// accepted the change, or its reason. A value is converted to the type of the node's parameter where that is
    /// lossless (`1` becomes `1.0`).
    async fn set(&self, node: &str, changes: Vec<ParamChange>) -> Result<Vec<Result<(), FailureReason>>, BusError>;
    /// Sets parameters like [`set`](Self::set), but all or none; the error carries the node's reason.
    async fn set_atomically(&self, node: &str, changes: Vec<ParamChange>) -> Result<(), BusError>;
    /// Lists the parameters of a node: those below the prefixes (all if there are none), with names of at most `depth`
    /// levels beyond the prefix (0 for any number).
    async fn list(&self, node: &str, prefixes: &[String], depth: u64) -> Result<ParameterNames, BusError>;
    /// Returns the node's descriptions of its parameters, in the order requested; `None` for a missing parameter.
    async fn describe(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParameterDescription>>, BusError>;
    /// Watches changes from the time this returns: those of one node, which must exist, or of all nodes.
    async fn watch(&self, node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError>;
}

/// A stream of parameter changes published by nodes; dropping it ends the subscription.
#[async_trait]
pub trait ParameterEvents: Send {
    /// Returns the next event, or `None` when the connection to the ROS system has ended. Cancel-safe.
    async fn next(&mut self) -> Option<ParameterEvent>;
    /// Returns the number of events dropped because too many were queued.
    fn dropped_count(&self) -> u64;
}

/// Parameter changes that a node made at once.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterEvent {
    /// Absolute name of the node.
    pub node: String,
    /// New parameters.
    pub new: Vec<(String, ParamValue)>,
    /// Parameters with a changed value.
    pub changed: Vec<(String, ParamValue)>,
    /// Deleted parameters.
    pub deleted: Vec<String>,
}

/// Parameter names of a node.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ParameterNames {
    /// Full names.
    pub names: Vec<String>,
    /// The distinct prefixes of the names, up to the last dot.
    pub prefixes: Vec<String>,
}

/// Type of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ParameterKind {
    /// The parameter is not set.
    #[default]
    NotSet,
    /// `true` or `false`.
    Bool,
    /// Signed 64-bit integer.
    Integer,
    /// Double.
    Double,
    /// Text.
    String,
    /// Bytes: [`ParamValue::Binary`].
    Bytes,
    /// List of [`Bool`](Self::Bool) values.
    Bools,
    /// List of [`Integer`](Self::Integer) values.
    Integers,
    /// List of [`Double`](Self::Double) values.
    Doubles,
    /// List of [`String`](Self::String) values.
    Strings,
}

/// Description of a parameter, as given by its node.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterDescription {
    /// Full name.
    pub name: String,
    /// Type of the value.
    pub kind: ParameterKind,
    /// Human-readable description; may be empty.
    pub description: String,
    /// Human-readable constraints on the value; may be empty.
    pub constraints: String,
    /// True if the value cannot be changed after declaration.
    pub read_only: bool,
    /// True if the type may change.
    pub dynamic_typing: bool,
    /// Range of allowed doubles.
    pub double_range: Option<DoubleRange>,
    /// Range of allowed integers.
    pub integer_range: Option<IntegerRange>,
}

/// Allowed doubles of a parameter; both limits are inclusive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DoubleRange {
    /// Smallest allowed value.
    pub from: f64,
    /// Largest allowed value.
    pub to: f64,
    /// Distance between allowed values, counted from the smallest; 0 allows all values in the range.
    pub step: f64,
}

/// Allowed integers of a parameter; both limits are inclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IntegerRange {
    /// Smallest allowed value.
    pub from: i64,
    /// Largest allowed value.
    pub to: i64,
    /// Distance between allowed values, counted from the smallest; 0 allows all values in the range.
    pub step: u64,
}
