//! What a robot sees of a service: names and types. (The definitions' texts are served apart, at
//! `/api/v1/services/NAME/interface`.)

use std::fmt;

use serde::{Deserialize, Serialize};

/// Topics, services, actions and parameters.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Interface {
    /// Topics, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub topics: Vec<Topic>,
    /// ROS services, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub services: Vec<Service>,
    /// Actions, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub actions: Vec<Action>,
    /// Parameters, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub parameters: Vec<Parameter>,
    /// ROS services, and actions of ROS 2, that the package uses and does not serve, by name.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub needs: Vec<Need>,
    /// Nodes that have a lifecycle (ROS 2), by name; the services of it are not among `services`.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub lifecycle: Vec<String>,
    /// Inputs that are answered by outputs, as stubs are told.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub requests: Vec<Request>,
}

/// An input, and the outputs by whose messages it is answered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Request {
    /// The node; empty where it is not known.
    pub node: String,
    /// Absolute name of the input.
    pub input: String,
    /// Absolute names of the outputs; the time of the first one counts.
    pub outputs: Vec<String>,
    /// By what an answer is recognised: `stamp`, or `arrival` where the next message is the answer.
    pub by: String,
    /// Why it is these: `stated`, `watched` (at the push), `alone` (the node has no others) or `guessed`.
    pub reason: String,
}

/// A ROS service, or an action of ROS 2, that a robot should serve.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Need {
    /// Absolute name.
    pub name: String,
    /// Nodes of the package that look for it.
    pub nodes: Vec<String>,
}

/// From the package's point of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The package subscribes: a robot publishes.
    Input,
    /// The package publishes: a robot subscribes.
    Output,
}

/// One end of a topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Topic {
    /// Absolute name, such as `/image`.
    pub name: String,
    /// `package/Type`, of ROS 2 `package/msg/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of the type, of ROS 2 its type hash.
    pub md5: String,
    /// Which end the package holds.
    pub direction: Direction,
    /// Newcomers get the last message.
    pub latched: bool,
    /// Registered only while an output is subscribed to.
    pub lazy: bool,
    /// What the package's nodes offer, or ask for, where ends tell it (ROS 2).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// Quality of service of a topic. Times are seconds; none where that is not said.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Qos {
    /// Whether messages may be lost on the way.
    pub reliability: Reliability,
    /// What newcomers among the subscribers are given.
    pub durability: Durability,
    /// The longest time between two messages.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// After so long a message is of no use.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lifespan: Option<f64>,
    /// Who says that a publisher is alive.
    pub liveliness: Liveliness,
    /// Within which time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lease: Option<f64>,
}

/// Whether messages may be lost on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// Sent once.
    BestEffort,
    /// Sent again until they have come.
    #[default]
    Reliable,
}

/// What newcomers are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// What is published from then on.
    #[default]
    Volatile,
    /// Also what was published last.
    TransientLocal,
}

/// Who says that a publisher is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Liveliness {
    /// ROS, for as long as its node is there.
    #[default]
    Automatic,
    /// What it publishes.
    ManualByTopic,
}

/// In the words of ROS 2's tools; of liveliness and times what is unusual.
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
        let times = [
            ("deadline", self.deadline),
            ("lifespan", self.lifespan),
            ("liveliness lease", self.lease),
        ];
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
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The serving node.
    pub node: String,
}

/// An action.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Action {
    /// Absolute name.
    pub name: String,
    /// `package/Name`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The serving node.
    pub node: String,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Parameter {
    /// Absolute name; of a node's own parameter the node's name, a slash, and what the node calls it.
    pub name: String,
    /// The node whose own it is (ROS 2); none where nodes share their parameters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// Its value when the interface was found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<serde_json::Value>,
    /// What its node says of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<Descriptor>,
}

/// What a node says of one of its parameters.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Descriptor {
    /// What it holds: `bool`, `integer`, `double`, `string` or a list of those, such as `double_array`; empty: nothing yet.
    #[serde(rename = "type")]
    pub kind: String,
    /// For people; may be empty.
    pub description: String,
    /// What else its value must be, for people; may be empty.
    pub constraints: String,
    /// It keeps the value that it was started with.
    pub read_only: bool,
    /// It may come to hold what is of another type.
    pub dynamic_typing: bool,
    /// Between which numbers its value is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<Range>,
}

/// The numbers that a parameter may hold, the ends included.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Range {
    /// The smallest; none where there is no bound.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<f64>,
    /// The largest; none where there is no bound.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to: Option<f64>,
    /// The distance of one to the next, counted from the smallest; none where all between the ends will do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<f64>,
}

/// For people: `double, 0 to 2.5, read only: m/s`.
impl fmt::Display for Descriptor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut words = vec![self.kind.clone()];
        words.extend(self.range.map(|range| range.to_string()));
        words.extend(self.read_only.then(|| "read only".to_owned()));
        words.extend(self.dynamic_typing.then(|| "of any type".to_owned()));
        words.push(self.constraints.clone());
        words.retain(|word| !word.is_empty());
        f.write_str(&words.join(", "))?;
        match self.description.is_empty() {
            true => Ok(()),
            false if words.is_empty() => f.write_str(&self.description),
            false => write!(f, ": {}", self.description),
        }
    }
}

/// For people; empty where there is no bound.
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
        let range = Range {
            from: Some(0.0),
            to: Some(2.5),
            step: Some(0.5),
        };
        let descriptor = Descriptor {
            kind: "double".into(),
            description: "m/s".into(),
            read_only: true,
            range: Some(range),
            ..Descriptor::default()
        };
        assert_eq!(
            descriptor.to_string(),
            "double, 0 to 2.5 in steps of 0.5, read only: m/s"
        );
        assert_eq!(Descriptor::default().to_string(), "");
        let qos = Qos {
            durability: Durability::TransientLocal,
            deadline: Some(0.1),
            ..Qos::default()
        };
        assert_eq!(qos.to_string(), "reliable, transient_local, deadline 0.1 s");
        let json = serde_json::to_string(&qos).expect("JSON");
        assert_eq!(serde_json::from_str::<Qos>(&json).expect("the same"), qos);
    }
}
