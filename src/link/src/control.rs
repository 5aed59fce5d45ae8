//! What the two ends tell each other beside messages and calls: JSON, since it is seldom and will grow. Fields unknown
//! to a reader are ignored, those absent have a default, so a minor addition needs no new version.
//!
//! Lists are read up to a number of entries, since one of many small ones takes much more memory than its text.

use std::collections::{BTreeMap, BTreeSet};

use ros::bus::{NodeNames, ParamValue};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::drops::Drop;
use crate::{Limits, MAX_CONTROL, MAX_FRAME, bounded};

/// The robot's first frame on every connection.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Hello {
    /// The stub's own version, for logs.
    pub version: String,
    /// Which ROS the robot's is; 0, as earlier stubs say, means 1.
    pub ros: u8,
    /// Made up when the stub's process began: names this life of the node.
    pub run: String,
    /// Counts the connections that this life has tried: one that was overtaken on its way does not displace a later
    /// one. 0: they are not counted.
    pub attempt: u64,
    /// The robot's machine since it was started, so that two robots under one id can be told apart.
    pub machine: String,
    /// The machine's host name, for messages.
    pub host: String,
    /// The id of the life of the machine's ROS Master: several machines with one Master are one robot.
    pub roscore: String,
    /// The session to go on with.
    pub resume: Option<Resume>,
    /// The first number that the robot will use on this connection.
    pub next: u64,
    /// The node to run; only its name is looked at in a resumed session.
    pub node: Node,
    /// What the robot's application promises itself.
    pub sla: Sla,
    /// Codecs that the robot decodes; none: messages come as they are.
    #[serde(deserialize_with = "bounded::list::<_, _, 256>")]
    pub codecs: Vec<String>,
    /// Quality of JPEG pictures, 1 to 100; 80 where absent.
    pub quality: Option<u8>,
    /// Stamps stay as they are, whatever the clocks say.
    pub keep_stamps: bool,
    /// The robot answers a `Lookup`.
    pub lends: bool,
    /// What the robot takes of the cloud; absent: what all earlier releases take.
    pub limits: Limits,
    /// All parameters of the robot, as a tree of values.
    #[serde(with = "crate::values::tree")]
    pub parameters: BTreeMap<String, ParamValue>,
}

impl Hello {
    /// Bytes of its texts and lists, without the parameters.
    pub fn own_bytes(&self) -> usize {
        let node = &self.node;
        let texts = [
            &self.version,
            &self.run,
            &self.machine,
            &self.host,
            &self.roscore,
            &node.name,
            &node.package,
            &node.executable,
            &node.namespace,
            &node.share,
            &node.directory,
            &node.image,
        ];
        let resume = self.resume.as_ref();
        let texts = texts.into_iter().chain(&node.argv).chain(&self.codecs);
        let texts = texts.chain(resume.map(|resume| &resume.session));
        let ahead = resume.map_or(0, |resume| size_of_val(&resume.ahead[..]));
        ahead + texts.map(String::len).sum::<usize>()
    }
}

/// What the robot has of an earlier connection.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Resume {
    /// As the welcome named it.
    pub session: String,
    /// All numbers up to this one have come.
    pub received: u64,
    /// Numbers above that which have come, too.
    #[serde(deserialize_with = "bounded::list::<_, _, 65536>")]
    pub ahead: Vec<u64>,
}

/// A node as roslaunch starts it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Node {
    /// Absolute name, as it is on the robot.
    pub name: String,
    /// The package.
    pub package: String,
    /// The executable below its libexec directory.
    pub executable: String,
    /// Arguments, remaps and private parameters; nothing that begins with `__` in ROS 1.
    #[serde(deserialize_with = "bounded::list::<_, _, 4096>")]
    pub argv: Vec<String>,
    /// All that the robot calls the program's nodes stands in `argv`; `name` is what the first of them is called then. Else all of them are called so, as
    /// by earlier stubs of ROS 2 and in ROS 1, where it is one.
    pub named_by_argv: bool,
    /// ROS_NAMESPACE.
    pub namespace: String,
    /// The stub's share directory: paths into it mean the same files of the package in the cloud.
    pub share: String,
    /// Where it was started: its working directory on the robot.
    pub directory: String,
    /// The service's revision that the stub was made of.
    pub revision: Option<u64>,
    /// The digest of the revision's image, since another server counts revisions otherwise.
    pub image: String,
}

/// Response times and the like, in seconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Sla {
    /// T_desire.
    pub desire: Option<f64>,
    /// T_max.
    pub max: Option<f64>,
    /// Least rate of an output.
    pub frames_per_second: Option<f64>,
    /// The rate that is wished for.
    pub desired_frames_per_second: Option<f64>,
    /// Greatest age of an output.
    pub age: Option<f64>,
    /// The age that is wished for.
    pub desired_age: Option<f64>,
    /// Q_t, which has no unit.
    pub threshold: Option<f64>,
    /// Nothing is promised: the local original stands in so long after the link was lost.
    pub fallback_after: Option<f64>,
}

/// The cloud's first frame on every connection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Welcome {
    /// The session goes on, or has begun.
    Accepted {
        /// Names it.
        session: String,
        /// It goes on: what the robot has not acknowledged is sent again.
        resumed: bool,
        /// What the cloud has of the robot's numbers.
        received: u64,
        /// Numbers above that which it has, too.
        #[serde(deserialize_with = "bounded::list::<_, _, 65_536>")]
        ahead: Vec<u64>,
        /// The first number that the cloud will use on this connection.
        next: u64,
        /// Codecs that the cloud decodes.
        #[serde(default, deserialize_with = "bounded::list::<_, _, 256>")]
        codecs: Vec<String>,
        /// What the cloud takes of the robot; absent: what all earlier releases take.
        #[serde(default)]
        limits: Limits,
        /// The servant, for logs.
        servant: String,
    },
    /// There will be no session.
    Refused {
        /// The reason, and what to do.
        reason: String,
        /// Trying again may help.
        again: bool,
    },
}

/// What a robot tells the cloud.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FromRobot {
    /// A topic's publisher whose messages come as this channel.
    Open(Input),
    /// That publisher is gone.
    Close {
        /// The channel's number.
        channel: u32,
    },
    /// So many listen to an output now.
    Listeners {
        /// The channel's number.
        channel: u32,
        /// How many nodes of the robot, other nodes of this servant not counted.
        count: usize,
    },
    /// Parameters that changed; without a value: was deleted.
    Parameters(#[serde(with = "crate::values::changes")] Vec<(String, Option<ParamValue>)>),
    /// Send the node this signal.
    Signal {
        /// Its number.
        signal: i32,
    },
    /// How a request went, for the cloud's statistics.
    Requests(#[serde(deserialize_with = "bounded::list::<_, _, 4096>")] Vec<Request>),
    /// What it has under that name. Control as an answer, and when what was there is gone.
    Lent {
        /// The name.
        service: String,
        /// The service, unless there is none; the number of its channel is chosen by the robot, and never used again.
        of: Option<Served>,
    },
    /// All messages that were dropped on its side so far.
    Dropped(#[serde(deserialize_with = "bounded::list::<_, _, 10000>")] Vec<Drop>),
    /// Messages of this session that it has not sent, so far.
    Unsent {
        /// Messages that a newer one replaced.
        replaced: u64,
        /// Messages that had become too old.
        stale: u64,
    },
    /// What was decided about the local original, for the cloud's events, oldest first.
    Decided(#[serde(deserialize_with = "bounded::list::<_, _, 1024>")] Vec<Decision>),
    /// All ends on the robot with which no messages pass now.
    Refused(#[serde(deserialize_with = "bounded::list::<_, _, 1024>")] Vec<Refused>),
}

/// What the cloud tells a robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FromCloud {
    /// Parameters that changed; without a value: was deleted.
    Parameters(#[serde(with = "crate::values::changes")] Vec<(String, Option<ParamValue>)>),
    /// A type that later names refer to.
    Type {
        /// `package/Type`.
        name: String,
        /// Its hash.
        md5: String,
        /// With all it contains.
        definition: String,
    },
    /// All that the node has registered now.
    Graph(Graph),
    /// The node has ended.
    Exited(Exit),
    /// Something that belongs into the robot's log.
    Notice {
        /// It needs attention.
        warning: bool,
        /// In words.
        text: String,
    },
    /// A line that the node printed.
    Line {
        /// On standard error.
        error: bool,
        /// Without its end.
        text: String,
    },
    /// A node looks for a service that nobody in the servant serves.
    Lookup {
        /// Its name.
        service: String,
    },
}

/// What the sessions of both ends tell each other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Between {
    /// A frame of a channel was lost that later ones refer to.
    Keyframe {
        /// The channel's number.
        channel: u32,
    },
}

/// A control record.
#[derive(Debug, PartialEq)]
pub(crate) enum Control<O> {
    /// For whoever uses the session.
    Order(O),
    /// For the session itself.
    Between(Between),
}

/// Bytes of a control record, at most: of parameters, which may be long texts, and of anything else.
pub(crate) fn longest(json: &[u8]) -> usize {
    if json.starts_with(b"{\"parameters\"") {
        return MAX_FRAME;
    }
    MAX_CONTROL
}

impl<O: DeserializeOwned> Control<O> {
    /// Reads a control record of an end that gives orders `O`.
    pub(crate) fn read(json: &[u8]) -> serde_json::Result<Self> {
        // What is told begins with its name, so an order is known for none of these at once.
        match serde_json::from_slice(json) {
            Ok(between) => Ok(Self::Between(between)),
            Err(_) => serde_json::from_slice(json).map(Self::Order),
        }
    }
}

/// The end of a link that a session is of: which orders it gives.
pub trait Order: Serialize + DeserializeOwned + Send + Sync + 'static {
    /// Those that the other end gives.
    type OfPeer: Order;

    /// Whether it may be left out where the link does not carry all.
    fn is_line(&self) -> bool {
        false
    }
}

impl Order for FromRobot {
    type OfPeer = FromCloud;
}

impl Order for FromCloud {
    type OfPeer = FromRobot;

    fn is_line(&self) -> bool {
        matches!(self, Self::Line { .. })
    }
}

/// A decision about the local original.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Decision {
    /// What kind of event it is, such as `local-takes-over`.
    pub kind: String,
    /// It needs attention.
    pub warning: bool,
    /// In words.
    pub text: String,
    /// So many seconds before it was told: while the link is down it waits.
    pub ago: f64,
}

/// An end of a topic on the robot with which no messages pass, since one of both asks for what the other does not offer.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(default)]
pub struct Refused {
    /// The topic.
    pub topic: String,
    /// Whose end it is.
    pub node: String,
    /// In what both differ, and what both say.
    pub why: String,
}

impl Refused {
    /// Told at most.
    pub const MOST: usize = 64;
}

/// How the node ended.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Exit {
    /// Exit code, when it exited.
    pub code: Option<i32>,
    /// Signal number, when it was killed.
    pub signal: Option<i32>,
    /// In words.
    pub text: String,
}

/// A publisher of the robot that the node listens to.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Input {
    /// Number of the channel, chosen by the robot.
    pub channel: u32,
    /// The topic.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its hash.
    pub md5: String,
    /// With all it contains.
    pub definition: String,
    /// Newcomers get the last message.
    pub latching: bool,
    /// What the publisher offers beside that; none where nobody says it (ROS 1).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// Quality of service of an end of a topic, as far as ends must agree on it. Times in seconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Qos {
    /// Messages may be lost on the way.
    pub best_effort: bool,
    /// Newcomers get the last messages.
    pub transient_local: bool,
    /// Messages kept; 0: as it is usual.
    pub depth: usize,
    /// The longest time between two messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// After so long a message is of no use.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lifespan: Option<f64>,
    /// The publisher itself says that it is alive, not only its node.
    pub manual_liveliness: bool,
    /// Within which time that is said.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease: Option<f64>,
}

/// What a node has registered.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Graph {
    /// What it publishes.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub outputs: Vec<Output>,
    /// What it subscribes to.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub inputs: Vec<Wanted>,
    /// What it serves.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub services: Vec<Served>,
    /// Other nodes of the same servant: what they publish on the robot is not sent up again.
    #[serde(deserialize_with = "bounded::list::<_, _, 10000>")]
    pub siblings: Vec<String>,
    /// Which of all this is whose, by the nodes' names, where the program is several nodes (ROS 2). Stubs that do not know it have it all for their
    /// own node.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub nodes: BTreeMap<String, Has>,
}

/// What one of several nodes has, by name.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Has {
    /// What it publishes.
    pub outputs: BTreeSet<String>,
    /// What it subscribes to.
    pub inputs: BTreeSet<String>,
    /// What it serves.
    pub services: BTreeSet<String>,
}

impl From<NodeNames> for Has {
    fn from(names: NodeNames) -> Self {
        Self {
            outputs: names.publishes,
            inputs: names.subscribes,
            services: names.serves,
        }
    }
}

impl From<Has> for NodeNames {
    fn from(has: Has) -> Self {
        Self {
            publishes: has.outputs,
            subscribes: has.inputs,
            serves: has.services,
        }
    }
}

/// An output.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Output {
    /// Number of its channel, chosen by the cloud.
    pub channel: u32,
    /// The topic.
    pub topic: String,
    /// `package/Type`, as a `Type` before said.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its hash.
    pub md5: String,
    /// What the node offers; none where nobody says it (ROS 1).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// An input.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Wanted {
    /// The topic.
    pub topic: String,
    /// `package/Type`, or `*`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its hash, or `*`.
    pub md5: String,
    /// This robot's node is the one that sends it; else another node of the servant does.
    pub feed: bool,
    /// What the node asks for; none where nobody says it (ROS 1).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// A service.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Served {
    /// Number of its channel, chosen by the end that tells of it.
    pub channel: u32,
    /// The service.
    pub name: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its hash.
    pub md5: String,
    /// The hashes of its requests and responses, where ends tell those of each other (ROS 2); else empty.
    #[serde(
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "bounded::list::<_, _, 16>"
    )]
    pub halves: Vec<String>,
}

/// One request's way, times in milliseconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Request {
    /// Counts the robot's requests; told again, it is the same one.
    pub id: u64,
    /// The input, service or action.
    pub name: String,
    /// From asked to answered; none when the cloud did not answer.
    pub total: Option<f64>,
    /// Encoding.
    pub serialise: f64,
    /// On the way up.
    pub up: f64,
    /// Waiting: on both sides, and for the node to be done with what came before.
    pub queue: f64,
    /// In the node.
    pub compute: f64,
    /// On the way down.
    pub down: f64,
    /// The local original's answer was taken.
    pub local: bool,
    /// The satisfaction after it.
    pub satisfaction: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What stubs in the field send. If this fails, see [`SUBPROTOCOL`](crate::SUBPROTOCOL).
    #[test]
    fn what_earlier_stubs_say_is_understood() {
        assert_eq!(crate::SUBPROTOCOL, "cloudroid-link.v2");
        let hello = r#"{"version":"0.1.0","run":"r","machine":"m","resume":{"session":"s","received":4,"ahead":[6]},
            "next":5,"node":{"name":"/n","package":"p","executable":"e","argv":["a:=b"],"namespace":"/","share":"/s",
            "directory":"/d","revision":3,"image":"sha256:0","calls":[]},"sla":{"desire":0.1,"max":0.3,
            "frames_per_second":null,"age":null},"codecs":["image"],"keep_stamps":false,"parameters":{"a":{"b":1}}}"#;
        let hello: Hello = serde_json::from_str(hello).unwrap();
        assert_eq!((hello.run.as_str(), hello.machine.as_str()), ("r", "m"));
        assert_eq!((hello.next, hello.attempt), (5, 0));
        let earlier = Limits {
            record: 256 << 20,
            under_way: 256,
            under_way_bytes: 320 << 20,
            ahead: 65_536,
        };
        assert_eq!(hello.limits, earlier, "what earlier releases take");
        assert_eq!(hello.resume.unwrap().ahead, [6]);
        assert_eq!((hello.node.name.as_str(), hello.sla.max), ("/n", Some(0.3)));
        assert!(!hello.node.named_by_argv);
        let welcome = r#"{"accepted":{"session":"s","resumed":true,"received":1,"ahead":[],"next":2,"servant":"v"}}"#;
        let welcome: Welcome = serde_json::from_str(welcome).unwrap();
        let Welcome::Accepted {
            next: 2, limits, ..
        } = welcome
        else {
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
            says_the_same::<FromRobot>(told);
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
        ] {
            says_the_same::<FromCloud>(told);
        }
        says_the_same::<Between>(r#"{"keyframe":{"channel":1}}"#);
    }

    /// An order that is read and written again says the same: nothing was left out for want of understanding.
    fn says_the_same<O: Serialize + DeserializeOwned>(told: &str) {
        let order: O = serde_json::from_str(told).expect(told);
        let again = serde_json::to_value(&order).unwrap();
        let told: serde_json::Value = serde_json::from_str(told).unwrap();
        assert_eq!(covers(&again, &told), None, "{again} {told}");
    }

    #[test]
    fn an_order_of_the_wrong_way_is_none() {
        let order = serde_json::to_string(&FromRobot::Signal { signal: 9 }).unwrap();
        assert!(serde_json::from_str::<FromCloud>(&order).is_err());
        let order = r#"{"line":{"error":false,"text":"t"}}"#;
        assert!(serde_json::from_str::<FromRobot>(order).is_err());
    }

    #[test]
    fn what_is_meant_for_the_session_is_told_from_orders() {
        let asked = Control::<FromRobot>::read(br#"{"keyframe":{"channel":7}}"#).unwrap();
        assert_eq!(asked, Control::Between(Between::Keyframe { channel: 7 }));
        // However it is written.
        let asked = Control::<FromCloud>::read(b" { \"keyframe\" : { \"channel\" : 7 } }").unwrap();
        assert_eq!(asked, Control::Between(Between::Keyframe { channel: 7 }));
        let order = Control::read(br#"{"signal":{"signal":9}}"#).unwrap();
        assert_eq!(order, Control::Order(FromRobot::Signal { signal: 9 }));
        for unknown in [r#"{"keyframe":{}}"#, r#"{"later":{}}"#, "{", ""] {
            assert!(
                Control::<FromRobot>::read(unknown.as_bytes()).is_err(),
                "{unknown}"
            );
        }
    }

    /// Where `whole` lacks something of `part`.
    fn covers(whole: &serde_json::Value, part: &serde_json::Value) -> Option<String> {
        use serde_json::Value;
        match (whole, part) {
            (Value::Object(whole), Value::Object(part)) => part.iter().find_map(|(key, value)| {
                let Some(found) = whole.get(key) else {
                    return Some(key.clone());
                };
                covers(found, value)
            }),
            (Value::Array(whole), Value::Array(part)) if whole.len() == part.len() => {
                let pairs = whole.iter().zip(part);
                pairs
                    .into_iter()
                    .find_map(|(whole, part)| covers(whole, part))
            }
            (Value::Number(whole), Value::Number(part)) => {
                (whole.as_f64() != part.as_f64()).then(|| part.to_string())
            }
            (whole, part) => (whole != part).then(|| part.to_string()),
        }
    }
}
