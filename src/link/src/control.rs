//! Messages that the two ends exchange besides topic messages and calls. They are encoded as JSON because they are rare
//! and the schema will grow. Readers ignore unknown fields and use defaults for absent ones, so that a field can be
//! added without a new protocol version.
//!
//! Lists have a limit on the number of entries, because a list of many small entries takes much more memory than its
//! JSON text.

use std::collections::BTreeMap;

use ros::bus::{NodeNames, ParamValue};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::drops::TopicDropCount;
use crate::{LinkLimits, MAX_CONTROL, MAX_FRAME, bounded};

/// The first frame that the robot sends on every connection.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Hello {
    /// Version of the stub, for logs.
    pub version: String,
    /// ROS version of the robot. Earlier stubs send 0, which means ROS 1.
    pub ros: u8,
    /// Random identifier created when the stub's process started; identifies this run of the node.
    pub run: String,
    /// Number of connections that this run has attempted, so that a hello that arrives late does not displace a later
    /// connection. 0: attempts are not counted.
    pub attempt: u64,
    /// Identifier of the robot's machine and its current boot, to tell apart two robots that use the same id.
    pub machine: String,
    /// Host name of the machine, for messages.
    pub host: String,
    /// Identifier of the running ROS Master. Machines that share a Master are one robot.
    pub roscore: String,
    /// The session to resume.
    pub resume: Option<Resume>,
    /// The first record number that the robot will use on this connection.
    pub next: u64,
    /// The node to run. Only its name is used when a session is resumed.
    pub node: NodeLaunch,
    /// Service-level agreement requested by the robot's application.
    pub sla: SlaTargets,
    /// Codecs that the robot can decode; if empty, messages are sent uncompressed.
    #[serde(deserialize_with = "bounded::list::<_, _, 256>")]
    pub codecs: Vec<String>,
    /// Quality of JPEG images, 1 to 100 (default: 80).
    pub quality: Option<u8>,
    /// Leave time stamps unchanged even if the clocks differ.
    pub keep_stamps: bool,
    /// The robot answers `Lookup` requests.
    pub lends: bool,
    /// Limits on what the robot accepts from the cloud; if absent, those of all earlier releases.
    pub limits: LinkLimits,
    /// All parameters of the robot as a tree.
    #[serde(with = "crate::values::tree")]
    pub parameters: BTreeMap<String, ParamValue>,
}

impl Hello {
    /// Returns the length in bytes of its JSON text without the parameters.
    pub fn own_bytes(&mut self) -> usize {
        let parameters = std::mem::take(&mut self.parameters);
        let json = serde_json::to_vec(self);
        self.parameters = parameters;
        json.map_or(0, |json| json.len())
    }
}

/// Receive state of the robot in an earlier session.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Resume {
    /// Session id from the welcome.
    pub session: String,
    /// All record numbers up to and including this one have been received.
    pub received: u64,
    /// Received record numbers beyond that.
    #[serde(deserialize_with = "bounded::list::<_, _, 65536>")]
    pub ahead: Vec<u64>,
}

/// A node to run, described as roslaunch does.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct NodeLaunch {
    /// Absolute name of the node on the robot.
    pub name: String,
    /// ROS package.
    pub package: String,
    /// Executable below the package's libexec directory.
    pub executable: String,
    /// Arguments, remappings and private parameters. In ROS 1 there is nothing that begins with `__`. A stub that is
    /// made for a service of the other ROS spells them for the service; ROS 2's spelling is recognized by
    /// `named_by_argv` or `--ros-args`.
    #[serde(deserialize_with = "bounded::list::<_, _, 4096>")]
    pub argv: Vec<String>,
    /// Set if `argv` contains all node names that the robot assigns; then `name` is the resulting name of the first
    /// node. Otherwise all nodes of the program get `name`, as with earlier ROS 2 stubs and in ROS 1, where there is
    /// one node.
    pub named_by_argv: bool,
    /// Value of ROS_NAMESPACE.
    pub namespace: String,
    /// Share directory of the stub's package. Paths below it refer to the same files of the package in the cloud.
    pub share: String,
    /// Working directory of the node on the robot.
    pub directory: String,
    /// Revision of the service from which the stub was generated.
    pub revision: Option<u64>,
    /// Digest of the revision's image, because revision numbers of different servers differ.
    pub image: String,
}

/// Service-level objectives; times in seconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SlaTargets {
    /// T_desire, the desired response time.
    pub desire: Option<f64>,
    /// T_max, the maximum acceptable response time.
    pub max: Option<f64>,
    /// Minimum rate of an output, in messages per second.
    pub frames_per_second: Option<f64>,
    /// Desired rate of an output, in messages per second.
    pub desired_frames_per_second: Option<f64>,
    /// Maximum age of an output.
    pub age: Option<f64>,
    /// Desired age of an output.
    pub desired_age: Option<f64>,
    /// Satisfaction threshold Q_t (dimensionless).
    pub threshold: Option<f64>,
    /// Best effort: the local original takes over this long after the link was lost.
    pub fallback_after: Option<f64>,
}

/// The first frame that the cloud sends on every connection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Welcome {
    /// The session has started or was resumed.
    Accepted {
        /// Session id.
        session: String,
        /// The session was resumed: records that the robot has not acknowledged are sent again.
        resumed: bool,
        /// All record numbers of the robot up to and including this one have been received.
        received: u64,
        /// Received record numbers beyond that.
        #[serde(deserialize_with = "bounded::list::<_, _, 65_536>")]
        ahead: Vec<u64>,
        /// The first record number that the cloud will use on this connection.
        next: u64,
        /// Codecs that the cloud can decode.
        #[serde(default, deserialize_with = "bounded::list::<_, _, 256>")]
        codecs: Vec<String>,
        /// Limits on what the cloud accepts from the robot; if absent, those of all earlier releases.
        #[serde(default)]
        limits: LinkLimits,
        /// Id of the servant, for logs.
        servant: String,
    },
    /// The connection is refused.
    Refused {
        /// Reason and remedy.
        reason: String,
        /// Retrying may succeed.
        again: bool,
    },
}

/// Earlier stubs do not say what their subscribers request.
fn is_latching_by_default() -> bool {
    true
}

/// Control messages from the robot to the cloud.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FromRobot {
    /// A publisher on the robot whose messages will be sent on this channel.
    Open(InputChannel),
    /// The publisher is gone.
    Close {
        /// Channel number.
        channel: u32,
    },
    /// Number of subscribers of an output changed.
    Listeners {
        /// Channel number.
        channel: u32,
        /// Number of subscribing nodes on the robot, not counting other nodes of this servant.
        count: usize,
        /// True if a subscriber requests what was published before it came.
        #[serde(default = "is_latching_by_default")]
        latching: bool,
    },
    /// Changed parameters; those without a value were deleted.
    Parameters(#[serde(with = "crate::values::changes")] Vec<(String, Option<ParamValue>)>),
    /// Sends a signal to the node.
    Signal {
        /// Signal number.
        signal: i32,
    },
    /// Timing of requests, for the cloud's statistics.
    Requests(#[serde(deserialize_with = "bounded::list::<_, _, 4096>")] Vec<RequestTiming>),
    /// State of a service on the robot. Sent as the reply to a lookup, and when the service is gone.
    Lent {
        /// Name of the service.
        service: String,
        /// The service, or `None` if there is none. The robot chooses the channel number and never reuses it.
        of: Option<ServiceChannel>,
    },
    /// All messages dropped on the robot's side so far.
    Dropped(#[serde(deserialize_with = "bounded::list::<_, _, 10000>")] Vec<TopicDropCount>),
    /// Messages of this session that the robot has not sent so far.
    Unsent {
        /// Number of messages replaced by a newer one.
        replaced: u64,
        /// Number of messages that had become too old.
        stale: u64,
    },
    /// Decisions about the local original for the cloud's event log, oldest first.
    Decided(#[serde(deserialize_with = "bounded::list::<_, _, 1024>")] Vec<Decision>),
    /// All endpoints on the robot that are currently incompatible.
    Refused(#[serde(deserialize_with = "bounded::list::<_, _, 1024>")] Vec<IncompatibleEndpoint>),
}

/// Control messages from the cloud to the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FromCloud {
    /// Changed parameters; those without a value were deleted.
    Parameters(#[serde(with = "crate::values::changes")] Vec<(String, Option<ParamValue>)>),
    /// Definition of a type that later messages refer to by name.
    Type {
        /// Type name, `package/Type`.
        name: String,
        /// Hash of the type.
        md5: String,
        /// Definition including all nested types.
        definition: String,
    },
    /// Complete current ROS graph of the node.
    Graph(Graph),
    /// The node has exited.
    Exited(Exit),
    /// A message for the robot's log.
    Notice {
        /// The message needs attention and is logged as a warning.
        warning: bool,
        /// Text of the message.
        text: String,
    },
    /// A line printed by the node.
    Line {
        /// The line was printed on standard error.
        error: bool,
        /// The line without its line break.
        text: String,
    },
    /// A node is looking for a service that has no server in the servant.
    Lookup {
        /// Name of the service.
        service: String,
    },
    /// Number of messages of a transient-local output that the node gives to late subscribers (ROS 2). Until it is told
    /// it is one.
    Kept {
        /// Channel number.
        channel: u32,
        /// Number of messages.
        messages: usize,
    },
}

/// Control messages between the sessions of both ends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum SessionMessage {
    /// Requests a key frame because a frame that later frames depend on was lost.
    Keyframe {
        /// Channel number.
        channel: u32,
    },
}

/// Returns the maximum size in bytes of a control record. Parameters may contain long texts, so their limit is higher.
pub(crate) fn max_control_length(json: &[u8]) -> usize {
    if json.starts_with(b"{\"parameters\"") {
        return MAX_FRAME;
    }
    MAX_CONTROL
}

/// The control messages that one end of a session sends.
pub trait ControlMessage: Serialize + DeserializeOwned + Send + Sync + 'static {
    /// The control messages that the other end sends.
    type FromPeer: ControlMessage;

    /// Returns whether the message may be omitted when the link is congested.
    fn is_line(&self) -> bool {
        false
    }
}

impl ControlMessage for FromRobot {
    type FromPeer = FromCloud;
}

impl ControlMessage for FromCloud {
    type FromPeer = FromRobot;

    fn is_line(&self) -> bool {
        matches!(self, Self::Line { .. })
    }
}

/// A decision about the local original.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Decision {
    /// Kind of event, such as `local-takes-over`.
    pub kind: String,
    /// The decision needs attention and is reported as a warning.
    pub warning: bool,
    /// Description of the decision.
    pub text: String,
    /// Age of the decision in seconds when it was sent; decisions wait while the link is down.
    pub ago: f64,
}

/// An endpoint on the robot that exchanges no messages with ours because its QoS is incompatible: one of them requests
/// what the other does not offer.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(default)]
pub struct IncompatibleEndpoint {
    /// Name of the topic.
    pub topic: String,
    /// Node of the endpoint.
    pub node: String,
    /// The incompatible policies, with both values.
    pub why: String,
}

impl IncompatibleEndpoint {
    /// Maximum number of endpoints reported.
    pub const MAX_ENDPOINTS: usize = 64;
}

/// Exit status of the node.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Exit {
    /// Exit code, if the node exited.
    pub code: Option<i32>,
    /// Signal number, if the node was killed.
    pub signal: Option<i32>,
    /// Description of how the node ended.
    pub text: String,
}

/// A publisher on the robot to which the node subscribes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct InputChannel {
    /// Channel number, chosen by the robot.
    pub channel: u32,
    /// Name of the topic.
    pub topic: String,
    /// Type name, `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Hash of the type.
    pub md5: String,
    /// Definition including all nested types.
    pub definition: String,
    /// New subscribers receive the last message.
    pub latching: bool,
    /// QoS offered by the publisher; `None` in ROS 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qos: Option<WireQos>,
}

/// The QoS policies of an endpoint on which publisher and subscriber must agree. Times in seconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct WireQos {
    /// Best-effort reliability: messages may be lost.
    pub best_effort: bool,
    /// Transient-local durability: new subscribers receive the last messages.
    pub transient_local: bool,
    /// History depth; 0: default.
    pub depth: usize,
    /// Maximum time between two messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// Time after which a message is stale.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lifespan: Option<f64>,
    /// Liveliness is asserted by the publisher itself, not only by its node.
    pub manual_liveliness: bool,
    /// Liveliness lease duration.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease: Option<f64>,
}

/// The topics and services that a node has registered.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Graph {
    /// Topics that the node publishes.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub outputs: Vec<OutputChannel>,
    /// Topics that the node subscribes to.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub inputs: Vec<RequestedInput>,
    /// Services that the node provides.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub services: Vec<ServiceChannel>,
    /// Other nodes of the same servant. What they publish on the robot is not sent to the cloud again.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub siblings: Vec<String>,
    /// Ownership of the above by node name, if the program consists of several nodes (ROS 2). Stubs that do not know
    /// this field attribute everything to their own node.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub nodes: BTreeMap<String, NodeNames>,
}

/// A topic that the node publishes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct OutputChannel {
    /// Channel number, chosen by the cloud.
    pub channel: u32,
    /// Name of the topic.
    pub topic: String,
    /// Type name, `package/Type`; a preceding `Type` message contains the definition.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Hash of the type.
    pub md5: String,
    /// QoS offered by the node; `None` in ROS 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qos: Option<WireQos>,
}

/// A topic that the node subscribes to.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RequestedInput {
    /// Name of the topic.
    pub topic: String,
    /// Type name, `package/Type`, or `*` for any type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Hash of the type, or `*`.
    pub md5: String,
    /// Set if this node's link sends the messages; otherwise the link of another node of the servant does.
    pub feed: bool,
    /// QoS requested by the node; `None` in ROS 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qos: Option<WireQos>,
}

/// A service.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ServiceChannel {
    /// Channel number, chosen by the end that announces the service.
    pub channel: u32,
    /// Name of the service.
    pub name: String,
    /// Type name, `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Hash of the type.
    pub md5: String,
    /// Hashes of the request and response types where ROS exposes them (ROS 2), otherwise empty.
    #[serde(skip_serializing_if = "Vec::is_empty", deserialize_with = "bounded::list::<_, _, 16>")]
    pub halves: Vec<String>,
}

/// Timing of one request; times in milliseconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RequestTiming {
    /// Sequence number of the robot's request. An entry with the same number updates the earlier one.
    pub id: u64,
    /// Name of the input topic, service or action.
    pub name: String,
    /// Time from request to response; `None` if the cloud did not answer.
    pub total: Option<f64>,
    /// Encoding time.
    pub serialise: f64,
    /// Uplink time.
    pub up: f64,
    /// Queueing time on both sides, including the time until the node had finished its earlier inputs.
    pub queue: f64,
    /// Computing time in the node.
    pub compute: f64,
    /// Downlink time.
    pub down: f64,
    /// The answer of the local original was used.
    pub local: bool,
    /// Satisfaction after this request.
    pub satisfaction: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Messages as sent by deployed stubs. If this test fails, see [`SUBPROTOCOL`](crate::SUBPROTOCOL).
    #[test]
    fn messages_of_earlier_stubs_are_parsed() {
        assert_eq!(crate::SUBPROTOCOL, "cloudroid-link.v2");
        let hello = r#"{"version":"0.1.0","run":"r","machine":"m","resume":{"session":"s","received":4,"ahead":[6]},
            "next":5,"node":{"name":"/n","package":"p","executable":"e","argv":["a:=b"],"namespace":"/","share":"/s",
            "directory":"/d","revision":3,"image":"sha256:0","calls":[]},"sla":{"desire":0.1,"max":0.3,
            "frames_per_second":null,"age":null},"codecs":["image"],"keep_stamps":false,"parameters":{"a":{"b":1}}}"#;
        let hello: Hello = serde_json::from_str(hello).unwrap();
        assert_eq!((hello.run.as_str(), hello.machine.as_str()), ("r", "m"));
        assert_eq!((hello.next, hello.attempt), (5, 0));
        let earlier =
            LinkLimits { record: 256 << 20, under_way: 256, under_way_bytes: 320 << 20, ahead: 65_536, told: 64 << 20 };
        assert_eq!(hello.limits, earlier, "what earlier releases take");
        assert_eq!(hello.resume.unwrap().ahead, [6]);
        assert_eq!((hello.node.name.as_str(), hello.sla.max), ("/n", Some(0.3)));
        assert!(!hello.node.named_by_argv);
        let welcome = r#"{"accepted":{"session":"s","resumed":true,"received":1,"ahead":[],"next":2,"servant":"v"}}"#;
        let welcome: Welcome = serde_json::from_str(welcome).unwrap();
        let Welcome::Accepted { next: 2, limits, .. } = welcome else {
            panic!("{welcome:?}");
        };
        assert_eq!(limits, earlier);
        let refused = r#"{"refused":{"reason":"why","again":true}}"#;
        let refused: Welcome = serde_json::from_str(refused).unwrap();
        assert!(matches!(refused, Welcome::Refused { again: true, .. }));
        for told in [
            r#"{"open":{"channel":1,"topic":"/t","type":"p/T","md5":"0","definition":"d","latching":false}}"#,
            r#"{"close":{"channel":1}}"#,
            r#"{"listeners":{"channel":1,"count":2}}"#,
            r#"{"parameters":[["/a",1],["/b",null]]}"#,
            r#"{"signal":{"signal":2}}"#,
            r#"{"requests":[{"id":1,"name":"/s","total":null,"serialise":0,"up":1,"queue":2,"compute":3,"down":4,
                "local":true,"satisfaction":2.5}]}"#,
            r#"{"dropped":[{"topic":"/t","cause":"cut_off","count":3}]}"#,
        ] {
            assert_round_trips::<FromRobot>(told);
        }
        for told in [
            r#"{"parameters":[["/a",1],["/b",null]]}"#,
            r#"{"type":{"name":"p/T","md5":"0","definition":"d"}}"#,
            r#"{"graph":{"outputs":[{"channel":1,"topic":"/t","type":"p/T","md5":"0"}],
                "inputs":[{"topic":"/t","type":"*","md5":"*","feed":true}],
                "services":[{"channel":2,"name":"/s","type":"p/S","md5":"0"}],"siblings":["/m"]}}"#,
            r#"{"graph":{"nodes":{"/n":{"outputs":["/t"]}}}}"#,
            r#"{"exited":{"code":0,"signal":null,"text":"t"}}"#,
            r#"{"notice":{"warning":true,"text":"t"}}"#,
            r#"{"line":{"error":false,"text":"t"}}"#,
            r#"{"kept":{"channel":1,"messages":3}}"#,
        ] {
            assert_round_trips::<FromCloud>(told);
        }
        assert_round_trips::<SessionMessage>(r#"{"keyframe":{"channel":1}}"#);
    }

    /// Asserts that parsing and serializing a message preserves every field.
    fn assert_round_trips<O: Serialize + DeserializeOwned>(told: &str) {
        let order: O = serde_json::from_str(told).expect(told);
        let again = serde_json::to_value(&order).unwrap();
        let told: serde_json::Value = serde_json::from_str(told).unwrap();
        assert_eq!(find_missing(&again, &told), None, "{again} {told}");
    }

    #[test]
    fn a_control_message_of_the_other_direction_is_rejected() {
        let order = serde_json::to_string(&FromRobot::Signal { signal: 9 }).unwrap();
        assert!(serde_json::from_str::<FromCloud>(&order).is_err());
        let order = r#"{"line":{"error":false,"text":"t"}}"#;
        assert!(serde_json::from_str::<FromRobot>(order).is_err());
    }

    #[test]
    fn session_messages_are_distinguished_from_control_messages() {
        // Whitespace does not matter.
        for asked in [r#"{"keyframe":{"channel":7}}"#, " { \"keyframe\" : { \"channel\" : 7 } }"] {
            let message: SessionMessage = serde_json::from_str(asked).unwrap();
            assert_eq!(message, SessionMessage::Keyframe { channel: 7 });
            assert!(serde_json::from_str::<FromRobot>(asked).is_err());
            assert!(serde_json::from_str::<FromCloud>(asked).is_err());
        }
        let order = r#"{"signal":{"signal":9}}"#;
        assert_eq!(serde_json::from_str::<FromRobot>(order).unwrap(), FromRobot::Signal { signal: 9 });
        for unknown in [order, r#"{"keyframe":{}}"#, r#"{"later":{}}"#, "{", ""] {
            assert!(serde_json::from_str::<SessionMessage>(unknown).is_err(), "{unknown}");
        }
        for unknown in [r#"{"keyframe":{}}"#, r#"{"later":{}}"#, "{", ""] {
            assert!(serde_json::from_str::<FromRobot>(unknown).is_err(), "{unknown}");
        }
    }

    /// Returns the first place where `whole` lacks something that `part` contains.
    fn find_missing(whole: &serde_json::Value, part: &serde_json::Value) -> Option<String> {
        use serde_json::Value;
        match (whole, part) {
            (Value::Object(whole), Value::Object(part)) => part.iter().find_map(|(key, value)| {
                let Some(found) = whole.get(key) else {
                    return Some(key.clone());
                };
                find_missing(found, value)
            }),
            (Value::Array(whole), Value::Array(part)) if whole.len() == part.len() => {
                let pairs = whole.iter().zip(part);
                pairs.into_iter().find_map(|(whole, part)| find_missing(whole, part))
            }
            (Value::Number(whole), Value::Number(part)) => (whole.as_f64() != part.as_f64()).then(|| part.to_string()),
            (whole, part) => (whole != part).then(|| part.to_string()),
        }
    }
}
