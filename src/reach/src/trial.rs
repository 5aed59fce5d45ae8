//! A trial: a servant is given a recording or a picture, and what it answers, and when, is told. So T_desire and T_max can
//! be chosen before a robot is touched.

mod picture;

use std::sync::Arc;
use std::time::{Duration, Instant};

use api::trial::{Fed, Heard, Times, Trial};
use bytes::Bytes;
use package::interface::{Direction, Interface, Topic};
use ros::bag::Recorded;
use ros::bus::{Bus, Publisher, Qos, Subscription, WireType, reaches};
use ros::codec::{JsonOptions, Time, header_stamp, to_json};
use ros::schema::Registry;
use tokio::sync::mpsc;
use tokio::time::timeout;

pub use picture::Picture;

use crate::Error;

/// For the servant's nodes to listen, and for one answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// After a recording's message: one that answers nothing must not hold up the rest.
const ANSWER: Duration = Duration::from_secs(2);
/// A picture is shown so often. The first is not counted: much is made at the first request.
const SHOWN: usize = 21;
/// So much of a recording is used.
pub const RECORDED: usize = 300;
/// Longer messages are not shown.
const LONGEST_SHOWN: usize = 2000;
const QUEUE: usize = 16;

/// What a servant is given.
pub enum Material {
    /// The same picture again and again.
    Picture(Picture),
    /// A recording.
    Bag(Vec<Recorded>),
}

/// Gives `material` to a servant of the service `service`, which has this interface.
pub(crate) async fn attempt(
    bus: &Arc<dyn Bus>,
    service: &str,
    interface: &Interface,
    material: Material,
) -> Result<Trial, Error> {
    let registry = Registry::from_definitions(&interface.definitions)
        .map_err(|error| Error::Trial(format!("a definition of {service}: {error}")))?;
    let plan = Plan::new(interface, &registry, material)?;
    let mut ears = Ears::open(bus, interface).await?;
    let mut mouths = Vec::new();
    for (topic, wire_type) in &plan.inputs {
        let publisher = bus
            .advertise(topic, wire_type.clone(), Qos::keep_last(QUEUE))
            .await
            .map_err(failed)?;
        let listening = reaches(publisher.matched(), 1);
        if timeout(PATIENCE, listening).await.is_err() {
            return Err(Error::Trial(format!(
                "no node of {service} listens to {topic}"
            )));
        }
        mouths.push(Mouth { publisher, sent: 0 });
    }
    let mut times = Vec::new();
    let mut requests = 0;
    for (index, message) in plan.messages.iter().enumerate() {
        ears.forget();
        let asked = Instant::now();
        mouths[message.0].publisher.publish(message.1.clone());
        mouths[message.0].sent += 1;
        let warming_up = index == 0;
        let patience = if warming_up { PATIENCE } else { ANSWER };
        let awaited = message.0 == 0;
        let answered = if awaited || warming_up {
            let stamp = plan.stamp(message, &registry);
            ears.answer(patience, stamp, &registry).await
        } else {
            None
        };
        if awaited && !warming_up {
            requests += 1;
            times.extend(answered.map(|at| at.saturating_duration_since(asked)));
        }
    }
    Ok(Trial {
        service: service.to_owned(),
        inputs: plan
            .inputs
            .iter()
            .zip(&mouths)
            .map(|((topic, wire_type), mouth)| Fed {
                topic: topic.clone(),
                type_name: wire_type.name.clone(),
                sent: mouth.sent,
            })
            .collect(),
        unused: plan.unused,
        outputs: ears.heard(&registry),
        requests,
        answered: times.len(),
        rrt: summed_up(times),
    })
}

fn failed(error: ros::bus::BusError) -> Error {
    Error::Trial(format!("the trial's servant cannot be used: {error}"))
}

/// What is published where: the topics, and each message with the number of its topic. The first topic's are requests.
struct Plan {
    inputs: Vec<(String, WireType)>,
    messages: Vec<(usize, Bytes)>,
    unused: Vec<String>,
}

impl Plan {
    fn new(interface: &Interface, registry: &Registry, material: Material) -> Result<Plan, Error> {
        let inputs: Vec<&Topic> = interface
            .topics
            .iter()
            .filter(|topic| topic.direction == Direction::Input)
            .collect();
        let nothing = |what: &str| {
            let known: Vec<String> = inputs
                .iter()
                .map(|topic| format!("{} ({})", topic.name, topic.type_name))
                .collect();
            Error::Trial(format!(
                "{what}; its inputs are: {}",
                if known.is_empty() {
                    "none".to_owned()
                } else {
                    known.join(", ")
                }
            ))
        };
        let mut plan = Plan {
            inputs: Vec::new(),
            messages: Vec::new(),
            unused: Vec::new(),
        };
        match material {
            Material::Picture(picture) => {
                let eyes = inputs
                    .iter()
                    .filter(|topic| topic.type_name == picture::TYPE);
                for topic in eyes {
                    plan.inputs
                        .push((topic.name.clone(), wire_type(registry, topic)?));
                }
                if plan.inputs.is_empty() {
                    return Err(nothing("the service takes no sensor_msgs/Image"));
                }
                let eyes = plan.inputs.len();
                for number in 0..SHOWN {
                    let message = picture.message(number);
                    // Of several the first comes last: its answer is what is waited for.
                    plan.messages
                        .extend((0..eyes).rev().map(|eye| (eye, message.clone())));
                }
            }
            Material::Bag(recorded) => {
                for message in recorded {
                    match plan.place(&inputs, registry, &message)? {
                        Some(place) => plan.messages.push((place, message.bytes)),
                        None if plan.unused.iter().all(|topic| **topic != *message.topic) => {
                            plan.unused.push(message.topic.to_string());
                        }
                        None => {}
                    }
                }
                if plan.messages.is_empty() {
                    return Err(nothing(
                        "no topic of the recording is an input of the service",
                    ));
                }
            }
        }
        Ok(plan)
    }

    fn stamp(&self, (input, bytes): &(usize, Bytes), registry: &Registry) -> Option<Time> {
        stamp(&self.inputs[*input].1.name, bytes, registry)
    }

    /// The input that a recorded topic goes to: of the same name, else the only one of its type.
    fn place(
        &mut self,
        inputs: &[&Topic],
        registry: &Registry,
        message: &Recorded,
    ) -> Result<Option<usize>, Error> {
        let of_type = || {
            inputs
                .iter()
                .filter(|topic| topic.type_name == message.wire_type.name)
        };
        let named = of_type().find(|topic| *topic.name == *message.topic);
        let alone = || of_type().next().filter(|_| of_type().count() == 1);
        let Some(input) = named.or_else(alone) else {
            return Ok(None);
        };
        if let Some(known) = self
            .inputs
            .iter()
            .position(|(topic, _)| *topic == input.name)
        {
            return Ok(Some(known));
        }
        let wire_type = wire_type(registry, input)?;
        if wire_type.digest != message.wire_type.digest {
            return Err(Error::Trial(format!(
                "{} was recorded with another definition of {} ({}) than the service has ({})",
                message.topic, wire_type.name, message.wire_type.digest, wire_type.digest
            )));
        }
        self.inputs.push((input.name.clone(), wire_type));
        Ok(Some(self.inputs.len() - 1))
    }
}

/// The stamp of a message whose type begins with a header.
fn stamp(type_name: &str, bytes: &[u8], registry: &Registry) -> Option<Time> {
    header_stamp(&*registry.message(type_name).ok()?, bytes)
}

fn wire_type(registry: &Registry, topic: &Topic) -> Result<WireType, Error> {
    let known = registry.message(&topic.type_name).map_err(|error| {
        Error::Trial(format!("the type of {} is not known: {error}", topic.name))
    })?;
    Ok(WireType::of(&known))
}

struct Mouth {
    publisher: Box<dyn Publisher>,
    sent: usize,
}

/// All outputs, each heard by a task.
struct Ears {
    topics: Vec<(Topic, usize, Bytes)>,
    said: mpsc::UnboundedReceiver<(usize, Instant, Bytes)>,
    /// The output whose messages answer requests that have no stamp.
    answering: Option<usize>,
    tasks: Vec<tokio::task::AbortHandle>,
}

impl Ears {
    async fn open(bus: &Arc<dyn Bus>, interface: &Interface) -> Result<Ears, Error> {
        let (sender, said) = mpsc::unbounded_channel();
        let mut ears = Ears {
            topics: Vec::new(),
            said,
            answering: None,
            tasks: Vec::new(),
        };
        // Latched outputs tell a state; they answer nothing.
        let outputs = interface
            .topics
            .iter()
            .filter(|topic| topic.direction == Direction::Output && !topic.latched);
        for (number, topic) in outputs.enumerate() {
            let subscription = bus
                .subscribe(&topic.name, WireType::any(), Qos::keep_last(QUEUE))
                .await
                .map_err(failed)?;
            let task = tokio::spawn(listen(number, subscription, sender.clone()));
            ears.tasks.push(task.abort_handle());
            ears.topics.push((topic.clone(), 0, Bytes::new()));
        }
        Ok(ears)
    }

    fn note(&mut self, (number, at, bytes): (usize, Instant, Bytes)) -> Instant {
        let (_, received, last) = &mut self.topics[number];
        *received += 1;
        *last = bytes;
        at
    }

    /// What came by now answers nothing that is asked from now on.
    fn forget(&mut self) {
        while let Ok(said) = self.said.try_recv() {
            self.note(said);
        }
    }

    /// When the answer came: the first output with the request's stamp, or, where either has none, the next on the
    /// topic that answered the first request.
    async fn answer(
        &mut self,
        patience: Duration,
        asked: Option<Time>,
        registry: &Registry,
    ) -> Option<Instant> {
        let deadline = tokio::time::Instant::now() + patience;
        loop {
            let said = tokio::time::timeout_at(deadline, self.said.recv()).await;
            let (number, at, bytes) = said.ok()??;
            let stamp = stamp(&self.topics[number].0.type_name, &bytes, registry);
            self.note((number, at, bytes));
            let answers = match (asked, stamp) {
                (Some(asked), Some(stamp)) => asked == stamp,
                _ => *self.answering.get_or_insert(number) == number,
            };
            if answers {
                return Some(at);
            }
        }
    }

    fn heard(&mut self, registry: &Registry) -> Vec<Heard> {
        self.forget();
        let shown = |topic: &Topic, last: &Bytes| {
            let of_type = registry.message(&topic.type_name).ok()?;
            let mut json = Vec::new();
            let options = JsonOptions {
                max_bytes: LONGEST_SHOWN,
                ..JsonOptions::default()
            };
            to_json(&of_type, last, &mut json, &options).ok()?;
            serde_json::from_slice(&json).ok()
        };
        self.topics
            .iter()
            .map(|(topic, received, last)| Heard {
                topic: topic.name.clone(),
                type_name: topic.type_name.clone(),
                received: *received,
                bytes: last.len(),
                last: (*received > 0).then(|| shown(topic, last)).flatten(),
            })
            .collect()
    }
}

impl Drop for Ears {
    fn drop(&mut self) {
        self.tasks.iter().for_each(|task| task.abort());
    }
}

async fn listen(
    number: usize,
    mut subscription: Subscription,
    said: mpsc::UnboundedSender<(usize, Instant, Bytes)>,
) {
    while let Some(message) = subscription.messages.recv().await {
        if said.send((number, Instant::now(), message.bytes)).is_err() {
            return;
        }
    }
}

/// Quantiles (nearest rank), and what to begin with.
fn summed_up(mut times: Vec<Duration>) -> Option<Times> {
    times.sort();
    let rank = |percent: usize| {
        let rank = (times.len() * percent).div_ceil(100).max(1);
        Some(times.get(rank - 1)?.as_secs_f64() * 1000.0)
    };
    let (p50, p90, max) = (rank(50)?, rank(90)?, rank(100)?);
    let desire = p50 * 1.5;
    Some(Times {
        p50,
        p90,
        max,
        desire,
        acceptable: (p90 * 2.0).max(desire * 2.0),
    })
}

#[cfg(test)]
mod tests {
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

    fn recorded(topic: &str, of_type: &str, md5: &str) -> Recorded {
        Recorded {
            topic: topic.into(),
            wire_type: Arc::new(WireType::new(of_type, md5, "")),
            time: 0,
            bytes: Bytes::from_static(b"\0\0\0\0"),
        }
    }

    const STRING: &str = "992ce8a1687cec8c8bd883ec73ca41d1";

    fn planned(recorded: Vec<Recorded>) -> Result<Plan, Error> {
        let interface = interface();
        let registry = Registry::from_definitions(&interface.definitions).expect("valid");
        Plan::new(&interface, &registry, Material::Bag(recorded))
    }

    #[test]
    fn recorded_topics_go_to_inputs_of_their_name_or_type() {
        let plan = planned(vec![
            recorded("/chatter", "std_msgs/String", STRING),
            recorded("/tf", "tf2_msgs/TFMessage", "x"),
            recorded("/tf", "tf2_msgs/TFMessage", "x"),
            recorded("/name", "std_msgs/String", STRING),
        ])
        .expect("a plan");
        assert_eq!(plan.inputs.len(), 1);
        assert_eq!(
            (plan.inputs[0].0.as_str(), plan.messages.len()),
            ("/name", 2)
        );
        assert_eq!(plan.unused, ["/tf"]);
    }

    #[test]
    fn what_does_not_fit_is_told_with_what_does() {
        let error = planned(vec![recorded("/tf", "tf2_msgs/TFMessage", "x")]).err();
        let text = error.map(|error| error.to_string()).unwrap_or_default();
        assert!(text.contains("/name (std_msgs/String)"), "{text}");
        let error = planned(vec![recorded("/name", "std_msgs/String", "other")]).err();
        let text = error.map(|error| error.to_string()).unwrap_or_default();
        assert!(text.contains("recorded with another definition"), "{text}");
    }

    #[test]
    fn suggestions_leave_room() {
        let times = (1..=10).map(|n| Duration::from_millis(n * 10)).collect();
        let times = summed_up(times).expect("times");
        assert_eq!((times.p50, times.p90, times.max), (50.0, 90.0, 100.0));
        assert_eq!((times.desire, times.acceptable), (75.0, 180.0));
        assert_eq!(summed_up(Vec::new()), None);
    }
}
