//! Parameters that belong to nodes, where a ROS has them.

use async_trait::async_trait;

use super::{BusError, ParamChange, ParamValue};

/// The parameters of each node. ROS 2 has them; ROS 1's are shared by all nodes.
#[async_trait]
pub trait NodeParameters: Send + Sync {
    /// Values by name, in the order asked for; none of one that the node does not have, or that holds nothing.
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError>;
    /// Sets parameters, or removes those without a value, one after the other: for each, whether the node has done so, or
    /// why not. A value takes the type that the node's parameter has where nothing is lost by it (`1` becomes `1.0`).
    async fn set(
        &self,
        node: &str,
        changes: Vec<ParamChange>,
    ) -> Result<Vec<Result<(), String>>, BusError>;
    /// The same, but all or none; the error tells the node's reason.
    async fn set_together(&self, node: &str, changes: Vec<ParamChange>) -> Result<(), BusError>;
    /// Which parameters a node has: those below the prefixes (all if there are none), of at most `depth` parts of a name
    /// beyond the prefix (of any number if 0).
    async fn list(
        &self,
        node: &str,
        prefixes: &[String],
        depth: u64,
    ) -> Result<ParameterNames, BusError>;
    /// What the node says of its parameters, in the order asked for; none of one that the node does not have.
    async fn describe(
        &self,
        node: &str,
        names: &[String],
    ) -> Result<Vec<Option<ParameterDescription>>, BusError>;
    /// Changes from when this returns: those of one node, which must be there, or of all.
    async fn watch(&self, node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError>;
}

/// Changes of parameters as nodes tell of them; dropping it ends that.
#[async_trait]
pub trait ParameterEvents: Send {
    /// The next one; none when the connection to the ROS system has ended. Safe to cancel.
    async fn next(&mut self) -> Option<ParameterEvent>;
    /// Events that were not told because too many waited.
    fn dropped(&self) -> u64;
}

/// What a node has changed at once.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterEvent {
    /// Its absolute name.
    pub node: String,
    /// Parameters that it did not have before.
    pub new: Vec<(String, ParamValue)>,
    /// Those that have another value now.
    pub changed: Vec<(String, ParamValue)>,
    /// Those that it does not have any more.
    pub deleted: Vec<String>,
}

/// Parameters of a node.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ParameterNames {
    /// Their full names.
    pub names: Vec<String>,
    /// What stands before the last dot of names, each once.
    pub prefixes: Vec<String>,
}

/// What a parameter holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ParameterKind {
    /// Nothing yet.
    #[default]
    NotSet,
    /// `true` or `false`.
    Bool,
    /// 64 bits, signed.
    Integer,
    /// A double.
    Double,
    /// Text.
    String,
    /// Bytes: [`ParamValue::Binary`].
    Bytes,
    /// A list of what [`Bool`](Self::Bool) holds.
    Bools,
    /// A list of what [`Integer`](Self::Integer) holds.
    Integers,
    /// A list of what [`Double`](Self::Double) holds.
    Doubles,
    /// A list of what [`String`](Self::String) holds.
    Strings,
}

/// What a node says of one of its parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterDescription {
    /// Its full name.
    pub name: String,
    /// What it holds.
    pub kind: ParameterKind,
    /// For people; may be empty.
    pub description: String,
    /// What else its value must be, for people; may be empty.
    pub constraints: String,
    /// It keeps the value that it was declared with.
    pub read_only: bool,
    /// It may come to hold what is of another kind.
    pub dynamic_typing: bool,
    /// Between which doubles its value is.
    pub double_range: Option<DoubleRange>,
    /// Between which integers its value is.
    pub integer_range: Option<IntegerRange>,
}

/// The doubles that a parameter may hold, the ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DoubleRange {
    /// The smallest.
    pub from: f64,
    /// The largest.
    pub to: f64,
    /// The distance of one to the next, counted from the smallest; 0 where all between the ends will do.
    pub step: f64,
}

/// The integers that a parameter may hold, the ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IntegerRange {
    /// The smallest.
    pub from: i64,
    /// The largest.
    pub to: i64,
    /// The distance of one to the next, counted from the smallest; 0 where all between the ends will do.
    pub step: u64,
}
