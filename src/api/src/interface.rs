//! Interface of a service as seen by a robot: names and types. (The texts of the definitions are served separately, at
//! `/api/v1/services/NAME/interface`.)

use std::fmt;

use serde::{Deserialize, Serialize};

/// Topics, services, actions and parameters of a service.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Interface {
    /// Topics, sorted by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub topics: Vec<Topic>,
    /// ROS services, sorted by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub services: Vec<Service>,
    /// Actions, sorted by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub actions: Vec<Action>,
    /// Parameters, sorted by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub parameters: Vec<Parameter>,
    /// ROS services, and actions of ROS 2, that the package uses and does not provide, sorted by name.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub needs: Vec<Need>,
    /// Lifecycle nodes (ROS 2), sorted by name; their lifecycle services are not listed in `services`.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub lifecycle: Vec<String>,
    /// Request pairs: inputs and the outputs that answer them, as configured in stubs.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub requests: Vec<Request>,
}

/// An input and the outputs whose messages answer it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Request {
    /// Name of the node; empty if unknown.
    pub node: String,
    /// Absolute name of the input topic.
    pub input: String,
    /// Absolute names of the output topics; the response time is that of the first one.
    pub outputs: Vec<String>,
    /// Rule that matches answers to requests: `stamp`, or `arrival` if the next message is the answer.
    pub by: String,
    /// How the pair was determined: `stated`, `watched` (observed at the push), `alone` (the node has no other topics)
    /// or `guessed`.
    pub reason: String,
}

/// A ROS service, or an action of ROS 2, that the robot must provide.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Need {
    /// Absolute name.
    pub name: String,
    /// Nodes of the package that use it.
    pub nodes: Vec<String>,
}

/// Direction from the package's point of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The package subscribes; a robot publishes.
    Input,
    /// The package publishes; a robot subscribes.
    Output,
}

/// A topic of the package.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Topic {
    /// Absolute name, such as `/image`.
    pub name: String,
    /// Type: `package/Type` (ROS 1) or `package/msg/Type` (ROS 2).
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of the type (ROS 1) or its type hash (ROS 2).
    pub md5: String,
    /// Direction from the package's point of view.
    pub direction: Direction,
    /// True if new subscribers get the last message.
    pub latched: bool,
    /// True if the package registers the topic only while one of its outputs has subscribers.
    pub lazy: bool,
    /// QoS offered or requested by the package's nodes, if known (ROS 2).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// QoS offered by the publishers of a topic or requested by its subscribers. The history depth is not announced to
/// others. Times are in seconds; absent if unspecified.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Qos {
    /// Reliability policy.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub reliability: Reliability,
    /// Durability policy.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub durability: Durability,
    /// Maximum time between two messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// Time after which a message expires.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lifespan: Option<f64>,
    /// Liveliness policy.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub liveliness: Liveliness,
    /// Liveliness lease duration.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease: Option<f64>,
}

/// Reliability policy, in ascending order of strictness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// Messages may be lost.
    BestEffort,
    /// Lost messages are retransmitted.
    #[default]
    Reliable,
}

/// Durability policy, in ascending order of strictness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// New subscribers get only messages published after they subscribe.
    #[default]
    Volatile,
    /// New subscribers also get the latest messages published earlier.
    TransientLocal,
}

/// Liveliness policy, in ascending order of strictness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Liveliness {
    /// The publisher is alive as long as its node is.
    #[default]
    Automatic,
    /// The publisher is alive as long as it publishes.
    ManualByTopic,
}

impl Qos {
    /// Returns the QoS that both offer: a subscriber that requests it receives from either of them.
    pub fn common_offer(self, other: Self) -> Self {
        Self {
            reliability: self.reliability.min(other.reliability),
            durability: self.durability.min(other.durability),
            deadline: longest(self.deadline, other.deadline),
            lifespan: shortest(self.lifespan, other.lifespan),
            liveliness: self.liveliness.min(other.liveliness),
            lease: longest(self.lease, other.lease),
        }
    }

    /// Returns the QoS that satisfies both requests: a publisher that offers it is received by either of them.
    pub fn common_request(self, other: Self) -> Self {
        Self {
            reliability: self.reliability.max(other.reliability),
            durability: self.durability.max(other.durability),
            deadline: shortest(self.deadline, other.deadline),
            lifespan: longest(self.lifespan, other.lifespan),
            liveliness: self.liveliness.max(other.liveliness),
            lease: shortest(self.lease, other.lease),
        }
    }
}

/// Returns the longer time; `None` means infinite.
fn longest(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    Some(one?.max(other?))
}

fn shortest(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}

/// Writes the policies as ROS 2's tools do; liveliness and times only if they are not the default.
impl fmt::Display for Qos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.reliability {
            Reliability::Reliable => "reliable",
            Reliability::BestEffort => "best_effort",
        })?;
        f.write_str(match self.durability {
            Durability::Volatile => ", volatile",
            Durability::TransientLocal => ", transient_local",
        })?;
        if self.liveliness == Liveliness::ManualByTopic {
            f.write_str(", liveliness manual_by_topic")?;
        }
        let times = [("deadline", self.deadline), ("lifespan", self.lifespan), ("liveliness lease", self.lease)];
        for (what, seconds) in times {
            if let Some(seconds) = seconds {
                write!(f, ", {what} {seconds} s")?;
            }
        }
        Ok(())
    }
}

/// A ROS service.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema), schema(as = RosService))]
pub struct Service {
    /// Absolute name.
    pub name: String,
    /// Type: `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Node that provides the service.
    pub node: String,
}

/// A ROS action.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Action {
    /// Absolute name.
    pub name: String,
    /// Type: `package/Name`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Node that provides the action.
    pub node: String,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Parameter {
    /// Absolute name. For a node's own parameter: the node's name, a slash, and the parameter's name in the node.
    pub name: String,
    /// Node that owns the parameter (ROS 2); absent if nodes share their parameters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// Value when the interface was recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<serde_json::Value>,
    /// Descriptor given by the node.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<Descriptor>,
}

/// Descriptor of a node's parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Descriptor {
    /// Type: `bool`, `integer`, `double`, `string` or an array of these, such as `double_array`; empty if not set.
    #[serde(rename = "type")]
    pub kind: String,
    /// Human-readable description; may be empty.
    pub description: String,
    /// Human-readable additional constraints; may be empty.
    pub constraints: String,
    /// True if the parameter cannot be changed after the node has started.
    pub read_only: bool,
    /// True if the parameter may change its type.
    pub dynamic_typing: bool,
    /// Range of allowed values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<Range>,
}

/// Range of allowed values, bounds included.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Range {
    /// Minimum; absent if unbounded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<f64>,
    /// Maximum; absent if unbounded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to: Option<f64>,
    /// Step between allowed values, counted from the minimum; absent if all values in the range are allowed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<f64>,
}

/// Writes a human-readable form, such as `double, 0 to 2.5, read only: m/s`.
impl fmt::Display for Descriptor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut words = vec![self.kind.clone()];
        words.extend(self.range.map(|range| range.to_string()));
        words.extend(self.read_only.then(|| "read only".to_owned()));
        words.extend(self.dynamic_typing.then(|| "of any type".to_owned()));
        words.push(self.constraints.clone());
        words.retain(|word| !word.is_empty());
        f.write_str(&words.join(", "))?;
        if self.description.is_empty() {
            Ok(())
        } else if words.is_empty() {
            f.write_str(&self.description)
        } else {
            write!(f, ": {}", self.description)
        }
    }
}

/// Writes a human-readable form; empty if unbounded.
impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.from, self.to) {
            (Some(from), Some(to)) => write!(f, "{from} to {to}"),
            (Some(from), None) => write!(f, "{from} or more"),
            (None, Some(to)) => write!(f, "{to} or less"),
            (None, None) => Ok(()),
        }?;
        match self.step {
            Some(step) => write!(f, " in steps of {step}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_ros_2_tells_is_put_into_words() {
        let range = Range { from: Some(0.0), to: Some(2.5), step: Some(0.5) };
        let descriptor = Descriptor {
            kind: "double".into(),
            description: "m/s".into(),
            read_only: true,
            range: Some(range),
            ..Descriptor::default()
        };
        assert_eq!(descriptor.to_string(), "double, 0 to 2.5 in steps of 0.5, read only: m/s");
        assert_eq!(Descriptor::default().to_string(), "");
        let qos = Qos { durability: Durability::TransientLocal, deadline: Some(0.1), ..Qos::default() };
        assert_eq!(qos.to_string(), "reliable, transient_local, deadline 0.1 s");
        let json = serde_json::to_string(&qos).expect("JSON");
        assert_eq!(serde_json::from_str::<Qos>(&json).expect("the same"), qos);
        let unusual = Qos {
            reliability: Reliability::BestEffort,
            liveliness: Liveliness::ManualByTopic,
            lifespan: Some(3.0),
            lease: Some(1.25),
            ..Qos::default()
        };
        assert_eq!(
            unusual.to_string(),
            "best_effort, volatile, liveliness manual_by_topic, lifespan 3 s, liveliness lease 1.25 s"
        );
    }

    #[test]
    fn ends_of_one_topic_have_in_common_what_suits_all_of_them() {
        let strict = Qos { durability: Durability::TransientLocal, deadline: Some(0.1), ..Qos::default() };
        let loose = Qos { reliability: Reliability::BestEffort, lease: Some(2.0), ..Qos::default() };
        assert_eq!(strict.common_offer(loose), Qos { reliability: Reliability::BestEffort, ..Qos::default() });
        assert_eq!(strict.common_request(loose), Qos { lease: Some(2.0), ..strict });
    }
}
