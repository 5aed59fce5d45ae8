//! Plan of a replay: the messages of a recording, or images, and the inputs to which they are published.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;
use package::interface::{Direction, Interface, Topic};
use ros::bag::BagMessage;
use ros::bus::{QosProfile, RosVersion, WireType};
use ros::codec::{Time, header_stamp};
use ros::schema::Registry;

use super::{Material, Picture, QUEUE, picture};
use crate::Error;

/// Maximum pause; longer ones of a recording are shortened to it.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// The inputs, and the messages in order.
pub(super) struct ReplayPlan<'a> {
    pub(super) inputs: Vec<PlannedInput>,
    /// Index of the input whose messages are requests.
    pub(super) request: usize,
    pub(super) items: Vec<PlannedMessage<'a>>,
    /// Time from the first message to the first of the next round, at the recorded rate; one second per image.
    pub(super) length: Duration,
    pub(super) unused: Vec<String>,
    /// Recorded topics with names other than that of the input to which they are published, with the index of the
    /// input.
    pub(super) renamed: BTreeSet<(usize, String)>,
}

/// An input to which messages are published.
pub(super) struct PlannedInput {
    pub(super) topic: String,
    pub(super) wire_type: WireType,
    /// QoS requested by its nodes, as far as known.
    pub(super) qos: QosProfile,
}

impl PlannedInput {
    fn new(topic: &Topic, registry: &Registry) -> Result<PlannedInput, Error> {
        let plain = QosProfile::keep_last(QUEUE);
        Ok(PlannedInput {
            topic: topic.name.clone(),
            wire_type: wire_type(registry, topic)?,
            qos: topic.qos.map_or(plain, |qos| QosProfile {
                // No message may be lost.
                reliability: plain.reliability,
                ..package::interface::qos::to_bus(&qos, QUEUE)
            }),
        })
    }
}

/// One message.
pub(super) struct PlannedMessage<'a> {
    /// Index of its input.
    pub(super) input: usize,
    pub(super) content: PlannedContent<'a>,
    /// Time since the first message.
    pub(super) at: Duration,
}

pub(super) enum PlannedContent<'a> {
    Recorded(Bytes),
    Picture(&'a Picture),
}

impl PlannedContent<'_> {
    /// Returns the message; an image gets the current time as its stamp.
    pub(super) fn message(&self, sequence: usize, ros: RosVersion) -> Bytes {
        match self {
            PlannedContent::Recorded(bytes) => bytes.clone(),
            PlannedContent::Picture(picture) => picture.message(sequence, ros),
        }
    }
}

impl<'a> ReplayPlan<'a> {
    /// Plans the replay of `material`. Messages of the topic `request` are the requests; by default those of the first
    /// topic for which the service has an input.
    pub(super) fn new(
        interface: &Interface,
        registry: &Registry,
        material: &'a Material,
        request: Option<&str>,
    ) -> Result<ReplayPlan<'a>, Error> {
        let inputs: Vec<&Topic> = interface.topics.iter().filter(|topic| topic.direction == Direction::Input).collect();
        let nothing = |what: &str| {
            let known: Vec<String> =
                inputs.iter().map(|topic| format!("{} ({})", topic.name, topic.type_name)).collect();
            Error::Trial(format!(
                "{what}; its inputs are: {}",
                if known.is_empty() { "none".to_owned() } else { known.join(", ") }
            ))
        };
        let mut plan = ReplayPlan {
            inputs: Vec::new(),
            request: 0,
            items: Vec::new(),
            length: Duration::ZERO,
            unused: Vec::new(),
            renamed: BTreeSet::new(),
        };
        match material {
            Material::Pictures(pictures) => {
                let eyes = inputs.iter().filter(|topic| picture::TYPES.contains(&topic.type_name.as_str()));
                for topic in eyes {
                    plan.inputs.push(PlannedInput::new(topic, registry)?);
                }
                if plan.inputs.is_empty() {
                    return Err(nothing("the service has no input of type sensor_msgs/Image"));
                }
                plan.choose_request(request).ok_or_else(|| unfed_error(request, &nothing))?;
                let eyes = plan.inputs.len();
                for (number, picture) in pictures.iter().enumerate() {
                    // With several inputs, the one of the requests is last, because its response is awaited.
                    let others = (0..eyes).filter(|eye| *eye != plan.request);
                    plan.items.extend(others.chain([plan.request]).map(|input| PlannedMessage {
                        input,
                        content: PlannedContent::Picture(picture),
                        at: Duration::from_secs(number as u64),
                    }));
                }
                plan.length = Duration::from_secs(pictures.len() as u64);
            }
            Material::Bag(recorded) => {
                let mut before = None;
                for message in recorded {
                    match plan.find_input(&inputs, registry, message)? {
                        Some(input) => {
                            if plan.inputs[input].topic != *message.topic {
                                plan.renamed.insert((input, message.topic.to_string()));
                            }
                            let pause = message.time.saturating_sub(before.unwrap_or(message.time));
                            plan.length += Duration::from_nanos(pause).min(LONGEST_PAUSE);
                            before = Some(message.time.max(before.unwrap_or(0)));
                            plan.items.push(PlannedMessage {
                                input,
                                content: PlannedContent::Recorded(message.bytes.clone()),
                                at: plan.length,
                            });
                        }
                        None if plan.unused.iter().all(|topic| **topic != *message.topic) => {
                            plan.unused.push(message.topic.to_string());
                        }
                        None => {}
                    }
                }
                if plan.items.is_empty() {
                    return Err(nothing(&if plan.unused.is_empty() {
                        "the recording holds no message".to_owned()
                    } else {
                        format!(
                            "no topic of the recording is an input of the service (it has {}){}",
                            plan.unused.join(", "),
                            describe_other_types(&inputs, recorded)
                        )
                    }));
                }
                plan.choose_request(request).ok_or_else(|| unfed_error(request, &nothing))?;
                // The next round begins after one more pause of average length.
                if let Some(pauses) = u32::try_from(plan.items.len() - 1).ok().filter(|n| *n > 0) {
                    plan.length += plan.length / pauses;
                }
            }
        }
        Ok(plan)
    }

    /// Returns the messages in order, round after round if `again` is set.
    pub(super) fn items(&self, again: bool) -> impl Iterator<Item = &PlannedMessage<'a>> {
        let rounds = if again { usize::MAX } else { 1 };
        let length = self.items.len();
        (0..rounds.saturating_mul(length)).map(move |turn| &self.items[turn % length])
    }

    /// Returns the number of requests in a round.
    pub(super) fn requests(&self) -> usize {
        let requests = self.items.iter().filter(|item| item.input == self.request);
        requests.count()
    }

    /// Returns the recorded topics with other names that are published to an input.
    pub(super) fn source_topics(&self, input: usize) -> Vec<String> {
        let renamed = self.renamed.iter().filter(|(to, _)| *to == input);
        renamed.map(|(_, topic)| topic.clone()).collect()
    }

    /// Returns the stamp of a message of an input.
    pub(super) fn stamp(&self, input: usize, bytes: &[u8], registry: &Registry) -> Option<Time> {
        stamp(&self.inputs[input].wire_type.name, bytes, registry)
    }

    fn choose_request(&mut self, request: Option<&str>) -> Option<()> {
        if let Some(named) = request {
            let mut inputs = self.inputs.iter();
            self.request = inputs.position(|input| input.topic == named)?;
        }
        Some(())
    }

    /// Finds the input for a recorded topic: the one with its name, otherwise the only one of its type.
    fn find_input(
        &mut self,
        inputs: &[&Topic],
        registry: &Registry,
        message: &BagMessage,
    ) -> Result<Option<usize>, Error> {
        let of_type = || inputs.iter().filter(|topic| topic.type_name == message.wire_type.name);
        let named = of_type().find(|topic| *topic.name == *message.topic);
        let alone = || of_type().next().filter(|_| of_type().count() == 1);
        let Some(input) = named.or_else(alone) else {
            return Ok(None);
        };
        if let Some(known) = self.inputs.iter().position(|known| known.topic == input.name) {
            return Ok(Some(known));
        }
        let found = PlannedInput::new(input, registry)?;
        let wire_type = &found.wire_type;
        if !wire_type.is_compatible_with(&message.wire_type) {
            return Err(Error::Trial(format!(
                "{} was recorded with another definition of {} ({}) than the service has ({})",
                message.topic, wire_type.name, message.wire_type.digest, wire_type.digest
            )));
        }
        self.inputs.push(found);
        Ok(Some(self.inputs.len() - 1))
    }
}

fn unfed_error(request: Option<&str>, nothing: &dyn Fn(&str) -> Error) -> Error {
    let request = request.unwrap_or_default();
    nothing(&format!("nothing that was given goes to an input {request}"))
}

/// Returns the stamp of a message whose type begins with a header.
pub(super) fn stamp(type_name: &str, bytes: &[u8], registry: &Registry) -> Option<Time> {
    header_stamp(&*registry.message(type_name).ok()?, bytes)
}

fn wire_type(registry: &Registry, topic: &Topic) -> Result<WireType, Error> {
    let known = registry
        .message(&topic.type_name)
        .map_err(|error| Error::Trial(format!("the type of {} is not known: {error}", topic.name)))?;
    Ok(WireType::from_message(&known))
}

/// Describes recorded topics that have the name of an input but another type.
fn describe_other_types(inputs: &[&Topic], recorded: &[BagMessage]) -> String {
    let there = inputs.iter().filter_map(|input| {
        let mut recorded = recorded.iter();
        let of_name = recorded.find(|message| *message.topic == *input.name)?;
        Some(format!("; {} is {} there", input.name, of_name.wire_type.name))
    });
    there.collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    fn interface() -> Interface {
        let topic = |name: &str, of_type: &str, direction| Topic {
            name: name.into(),
            type_name: of_type.into(),
            md5: String::new(),
            direction,
            nodes: vec![],
            latched: false,
            lazy: false,
            qos: None,
        };
        Interface {
            topics: vec![
                topic("/name", "std_msgs/String", Direction::Input),
                topic("/count", "std_msgs/Int32", Direction::Input),
                topic("/greeting", "std_msgs/String", Direction::Output),
            ],
            definitions: [
                ("std_msgs/msg/String".to_owned(), "string data\n".to_owned()),
                ("std_msgs/msg/Int32".to_owned(), "int32 data\n".to_owned()),
            ]
            .into(),
            ..Interface::default()
        }
    }

    fn recorded_message(topic: &str, of_type: &str, md5: &str) -> BagMessage {
        BagMessage {
            topic: topic.into(),
            wire_type: Arc::new(WireType::new(of_type, md5, "")),
            time: 0,
            bytes: Bytes::from_static(b"\0\0\0\0"),
        }
    }

    const STRING: &str = "992ce8a1687cec8c8bd883ec73ca41d1";

    fn plan<'a>(material: &'a Material, request: Option<&str>) -> Result<ReplayPlan<'a>, Error> {
        let interface = interface();
        let registry = Registry::from_definitions(&interface.definitions).expect("valid");
        ReplayPlan::new(&interface, &registry, material, request)
    }

    #[test]
    fn recorded_topics_go_to_inputs_of_their_name_or_type() {
        let material = Material::Bag(vec![
            recorded_message("/chatter", "std_msgs/String", STRING),
            recorded_message("/tf", "tf2_msgs/TFMessage", "x"),
            recorded_message("/tf", "tf2_msgs/TFMessage", "x"),
            recorded_message("/name", "std_msgs/String", STRING),
        ]);
        let plan = plan(&material, None).expect("a plan");
        assert_eq!(plan.inputs.len(), 1);
        assert_eq!((plan.inputs[0].topic.as_str(), plan.items.len()), ("/name", 2));
        assert_eq!(plan.unused, ["/tf"]);
        assert_eq!(plan.source_topics(0), ["/chatter"]);
    }

    #[test]
    fn unmatched_topics_are_reported_with_the_inputs() {
        let refused = |recorded, request| {
            let material = Material::Bag(vec![recorded]);
            let error = plan(&material, request).err();
            error.map(|error| error.to_string()).unwrap_or_default()
        };
        let text = refused(recorded_message("/tf", "tf2_msgs/TFMessage", "x"), None);
        assert!(text.contains("it has /tf); its inputs are: /name (std_msgs/String)"), "{text}");
        let text = refused(recorded_message("/name", "std_msgs/Int8", "x"), None);
        assert!(text.contains("(it has /name); /name is std_msgs/Int8 there; its inputs are: /name"), "{text}");
        let text = refused(recorded_message("/name", "std_msgs/String", "other"), None);
        assert!(text.contains("recorded with another definition"), "{text}");
        let text = refused(recorded_message("/name", "std_msgs/String", STRING), Some("/count"));
        assert!(text.contains("goes to an input /count"), "{text}");
    }

    #[test]
    fn an_input_of_ros_2_is_given_what_it_asks_for() {
        let qos = package::interface::Qos {
            durability: package::interface::Durability::TransientLocal,
            ..Default::default()
        };
        let mut interface = interface();
        interface.topics.truncate(1);
        interface.topics[0].type_name = "std_msgs/msg/String".into();
        interface.topics[0].qos = Some(qos);
        let registry = Registry::with_definitions(RosVersion::Two, &interface.definitions);
        let registry = registry.expect("valid");
        let of = WireType::from_message(&registry.message("std_msgs/msg/String").expect("defined"));
        let material = Material::Bag(vec![BagMessage { wire_type: Arc::new(of), ..recorded_message("/name", "", "") }]);
        let plan = ReplayPlan::new(&interface, &registry, &material, None).expect("a plan");
        assert!(plan.inputs[0].qos.is_latching());
        // Of the other ROS version.
        let material = Material::Bag(vec![recorded_message("/name", "std_msgs/String", STRING)]);
        let refused = ReplayPlan::new(&interface, &registry, &material, None).err();
        let words = refused.map(|error| error.to_string()).unwrap_or_default();
        assert!(words.contains("/name is std_msgs/String there"), "{words}");
    }

    #[test]
    fn a_recordings_pace_is_kept_but_for_long_pauses() {
        let at = |millis: u64, topic: &str, of_type: &str, md5: &str| BagMessage {
            time: millis * 1_000_000,
            ..recorded_message(topic, of_type, md5)
        };
        const INT: &str = "da5909fbe378aeaf85e547e830cc1bb7";
        let material = Material::Bag(vec![
            at(5000, "/name", "std_msgs/String", STRING),
            at(5100, "/count", "std_msgs/Int32", INT),
            // Out of order, and after a minute without messages.
            at(5050, "/name", "std_msgs/String", STRING),
            at(65_100, "/count", "std_msgs/Int32", INT),
        ]);
        let plan = plan(&material, Some("/count")).expect("a plan");
        let millis = |time: Duration| time.as_millis();
        let times: Vec<u128> = plan.items.iter().map(|item| millis(item.at)).collect();
        assert_eq!(times, [0, 100, 100, 1100]);
        assert_eq!(millis(plan.length), 1100 + 1100 / 3);
        assert_eq!((plan.request, plan.requests()), (1, 2));
        assert_eq!(plan.items(false).count(), 4);
        let inputs: Vec<usize> = plan.items(true).skip(3).take(3).map(|item| item.input).collect();
        assert_eq!(inputs, [1, 0, 1]);
    }
}
