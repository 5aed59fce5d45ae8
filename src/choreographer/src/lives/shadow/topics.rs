//! Topics of a robot's servant and of the candidate: messages of the robot are sent to both, and the messages that the
//! nodes of both publish are paired.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use api::shadow::Kind;
use budget::Budget;
use reach::ObservedBus;
use ros::bus::{
    Bus, BusError, Graph, PeerId, Publisher, QosProfile, SerializedMessage, Subscription, WireType, wait_for_connected,
};
use ros::codec::{Time, header_stamp};
use ros::schema::{MessageType, Registry};
use serde_json::Value;
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

use super::mirror::{CUT, ComparisonNotes, JsonMessage, message_differences, millis, read_json};
use crate::decide::shadow::{Pairing, PairingResult, ShadowSide, Tally, Tolerance, WINDOW};

/// Name of the node that listens beside the robot's.
pub(super) const NODE: &str = "/cloudroid_shadow";
/// Queue length of each topic.
const QUEUE: usize = 64;
/// Maximum number of received messages that are not handled yet.
const AHEAD: usize = 256;
/// Maximum number of messages waiting for a counterpart; beyond it, the oldest have none.
const WAITING: usize = 16 * WINDOW;
/// Timeout for the candidate's nodes to be connected.
const PATIENCE: Duration = Duration::from_secs(5);
/// Maximum time by which an output may be received before the message that it answers, and number of such outputs per
/// topic.
const EARLY: (Duration, usize) = (Duration::from_secs(1), 2);
/// Maximum number of requests that an output may answer.
const REQUESTS: usize = 256;

/// Topics of both sides.
pub(super) struct MirroredTopics {
    /// `None` for a shared service: then the robot has no topics.
    from: Option<ObservedBus>,
    to: Arc<dyn Bus>,
    /// The robot's node in the graph of its servant.
    robot: String,
    registry: Arc<Registry>,
    budget: Budget,
    told: mpsc::Sender<HeardMessage>,
    pub(super) heard: mpsc::Receiver<HeardMessage>,
    listened: BTreeMap<String, ListenedTopic>,
    /// Publishers by topic; also by original publisher if latched, so that newcomers get each one's last message.
    publishers: HashMap<(String, Option<PeerId>), Box<dyn Publisher>>,
    present: RequestHistory,
    candidate: RequestHistory,
    pub(super) given: u64,
    /// Stubs send goals by the topics of actions.
    linked: bool,
}

/// Reason why a topic is not compared as a whole.
#[derive(Debug, thiserror::Error)]
enum ListenError {
    #[error(transparent)]
    Bus(#[from] BusError),
    #[error("no node of the candidate subscribed to it within {PATIENCE:?}")]
    NoSubscriber,
}

/// A received message.
pub(super) struct HeardMessage {
    side: ShadowSide,
    topic: Arc<str>,
    at: Instant,
    message: SerializedMessage,
}

/// A topic under comparison.
struct ListenedTopic {
    of: Option<Arc<MessageType>>,
    _present: AbortOnDropHandle<()>,
    /// Set if nodes of the service publish it and the robot listens.
    candidate: Option<AbortOnDropHandle<()>>,
    pairing: Pairing<UnpairedMessage>,
    /// Outputs of the present servant from before the first request.
    early: VecDeque<(Instant, UnpairedMessage)>,
    tally: Tally,
    /// Number of requests at the last output: of the present servant, and of the candidate.
    answered: (u64, u64),
}

/// A message that waits for its counterpart.
struct UnpairedMessage {
    message: bytes::Bytes,
    /// It may stem from before the first request.
    early: bool,
    read: OnceLock<JsonMessage>,
}

impl UnpairedMessage {
    fn json(&self, of: Option<&MessageType>) -> Option<&Value> {
        let read = || read_json(of, &self.message);
        self.read.get_or_init(read).as_ref()
    }

    fn equals(&self, other: &UnpairedMessage, of: Option<&MessageType>, tolerance: &Tolerance) -> bool {
        self.message == other.message || self.differences(other, of, tolerance).is_empty()
    }

    fn differences(
        &self,
        other: &UnpairedMessage,
        of: Option<&MessageType>,
        tolerance: &Tolerance,
    ) -> Vec<crate::decide::shadow::DifferingField> {
        let values = self.json(of).zip(other.json(of));
        message_differences(values, (&self.message, &other.message), tolerance)
    }
}

/// Requests of one side by topics, calls and goals.
#[derive(Default)]
struct RequestHistory {
    count: u64,
    /// The last requests, with number, stamp, and time.
    last: VecDeque<(u64, Option<Time>, Instant)>,
}

impl RequestHistory {
    fn record(&mut self, stamp: Option<Time>, at: Instant) {
        self.count += 1;
        let stamp = stamp.filter(|stamp| *stamp != Time::default());
        self.last.push_back((self.count, stamp, at));
        if self.last.len() > REQUESTS {
            self.last.pop_front();
        }
    }

    /// Returns the response time of the request that an output answers: the one with its stamp, or, without stamps, the
    /// last one before it, if this is its first answer.
    fn response_time(&self, stamp: Option<Time>, answered: &mut u64, at: Instant) -> Option<f64> {
        let stamped = stamp.is_some() && self.last.iter().any(|(_, stamp, _)| stamp.is_some());
        let mut latest_first = self.last.iter().rev();
        // An output may be handled only after the next request.
        let (number, _, asked) =
            latest_first.find(|(_, of, asked)| if stamped { *of == stamp } else { *asked <= at })?;
        let first = *answered != *number;
        *answered = *number;
        (stamped || first).then(|| millis(at.saturating_duration_since(*asked)))
    }
}

impl MirroredTopics {
    pub(super) fn new(
        from: Option<ObservedBus>,
        to: Arc<dyn Bus>,
        (robot, linked): (&str, bool),
        registry: &Arc<Registry>,
        budget: &Budget,
    ) -> MirroredTopics {
        let (told, heard) = mpsc::channel(AHEAD);
        MirroredTopics {
            from,
            to,
            robot: robot.to_owned(),
            registry: Arc::clone(registry),
            budget: budget.clone(),
            told,
            heard,
            listened: BTreeMap::new(),
            publishers: HashMap::new(),
            present: RequestHistory::default(),
            candidate: RequestHistory::default(),
            given: 0,
            linked,
        }
    }

    /// Subscribes to the topics in the graph of the robot's servant to which its nodes, or the robot, listen. Not to
    /// others: a node may publish something only while it has a subscriber.
    pub(super) async fn follow(&mut self, graph: &Graph, notes: &mut ComparisonNotes) {
        let Some(look) = &self.from else {
            return;
        };
        let from = Arc::clone(&look.bus);
        let own = |node: &String| *node != self.robot && node != NODE;
        let of_actions: Vec<&String> = graph
            .actions
            .values()
            .flat_map(|action| &action.topics)
            .filter(|topic| !(self.linked && is_goal_topic(topic)))
            .collect();
        let mut wanted = Vec::new();
        for (name, ends) in &graph.topics {
            let of_ros = name.starts_with("/rosout") || name == "/parameter_events";
            if of_ros || of_actions.contains(&name) {
                continue;
            }
            let made_there = ends.publishers.iter().any(own);
            let by_robot = ends.publishers.contains(&self.robot);
            let input = ends.subscribers.iter().any(own) && (by_robot || !made_there);
            let output = made_there && ends.subscribers.contains(&self.robot);
            if input || output {
                wanted.push((name.clone(), ends.type_name.clone(), input, output));
            }
        }
        for (name, type_name, input, output) in wanted {
            let outcome = self.listen(&from, &name, &type_name, (input, output)).await;
            if let Err(error) = outcome {
                notes.add(&name, &error.to_string());
            }
        }
    }

    async fn listen(
        &mut self,
        from: &Arc<dyn Bus>,
        name: &str,
        type_name: &str,
        (input, output): (bool, bool),
    ) -> Result<(), ListenError> {
        let of = self.registry.message(type_name).ok();
        let known = self.listened.get(name);
        let heard_there = known.is_some_and(|known| known.candidate.is_some());
        let mut candidate = None;
        if output && !heard_there {
            candidate = Some(self.subscribe(ShadowSide::Candidate, &self.to, name, true).await?);
        }
        let key = (name.to_owned(), None);
        if let Some(of) = of.as_ref().filter(|_| input)
            && !self.publishers.contains_key(&key)
        {
            let publisher = self.to.advertise(name, WireType::from_message(of), QosProfile::keep_last(QUEUE)).await?;
            let listens = tokio::time::timeout(PATIENCE, wait_for_connected(publisher.matched_subscribers(), 1)).await;
            self.publishers.insert(key, publisher);
            if listens.is_err() {
                // Later messages are sent to it nevertheless.
                return Err(ListenError::NoSubscriber);
            }
        }
        match self.listened.get_mut(name) {
            Some(known) => {
                if candidate.is_some() {
                    known.candidate = candidate;
                }
            }
            None => {
                let present = self.subscribe(ShadowSide::Present, from, name, output).await?;
                let listened = ListenedTopic {
                    of,
                    _present: present,
                    candidate,
                    pairing: Pairing::default(),
                    early: VecDeque::new(),
                    tally: Tally::new(Kind::Topic, name),
                    answered: (0, 0),
                };
                self.listened.insert(name.to_owned(), listened);
            }
        }
        Ok(())
    }

    /// Forwards published messages; from the first one on if a publisher exists.
    async fn subscribe(
        &self,
        side: ShadowSide,
        bus: &Arc<dyn Bus>,
        name: &str,
        published: bool,
    ) -> Result<AbortOnDropHandle<()>, BusError> {
        let subscribed = bus.subscribe(name, WireType::any(), QosProfile::keep_last(QUEUE));
        let subscription = subscribed.await?;
        let connected = wait_for_connected(subscription.matched.clone(), usize::from(published));
        // A later publisher is received later.
        let _ = tokio::time::timeout(PATIENCE, connected).await;
        let (topic, told) = (Arc::from(name), self.told.clone());
        Ok(AbortOnDropHandle::new(tokio::spawn(forward(side, topic, subscription, told))))
    }

    /// Records a call or a goal that was sent to both: outputs may answer it.
    pub(super) fn on_request(&mut self, at: Instant) {
        self.release_early(at);
        self.present.record(None, at);
        self.candidate.record(None, Instant::now());
    }

    /// Releases early outputs at the first request: those received just before may answer it.
    fn release_early(&mut self, at: Instant) {
        if self.present.count > 0 {
            return;
        }
        for listened in self.listened.values_mut() {
            for (heard, item) in listened.early.drain(..) {
                if heard + EARLY.0 >= at {
                    listened.pairing.push(ShadowSide::Present, item);
                }
            }
        }
    }

    /// Returns true if the message is the robot's.
    pub(super) fn is_request(&self, heard: &HeardMessage) -> bool {
        heard.side == ShadowSide::Present && heard.message.publisher.node() == self.robot
    }

    /// Returns true if the message is from the present servant's side.
    pub(super) fn is_present(heard: &HeardMessage) -> bool {
        heard.side == ShadowSide::Present
    }

    /// Sends a message of the robot to the candidate.
    pub(super) async fn give(&mut self, heard: HeardMessage, notes: &mut ComparisonNotes) {
        let HeardMessage { topic, at, message, .. } = heard;
        let Some(listened) = self.listened.get(&*topic) else {
            return;
        };
        let of = listened.of.as_deref();
        let stamp = of.and_then(|of| header_stamp(of, &message.bytes));
        let whose = message.latching.then(|| message.publisher.clone());
        let key = (topic.to_string(), whose);
        if !self.publishers.contains_key(&key) {
            let wire_type = WireType::clone(&message.wire_type);
            let advertised =
                self.to.advertise(&topic, wire_type, QosProfile::keep_last(QUEUE).latching(message.latching));
            match advertised.await {
                Ok(publisher) => drop(self.publishers.insert(key.clone(), publisher)),
                Err(error) => return notes.add(&topic, &error.to_string()),
            }
        }
        self.release_early(at);
        self.present.record(stamp, at);
        self.candidate.record(stamp, Instant::now());
        self.publishers[&key].publish(message.bytes);
        self.given += 1;
    }

    /// Handles an output of one side.
    pub(super) fn on_output(&mut self, heard: HeardMessage, tolerance: &Tolerance, notes: &mut ComparisonNotes) {
        let HeardMessage { side, topic, at, message } = heard;
        let Some(listened) = self.listened.get_mut(&*topic) else {
            return;
        };
        if listened.of.is_none() {
            listened.of = message.wire_type.schema().ok();
        }
        let early = self.present.count == 0 && !message.latching;
        // A topic that is not compared yet, or an output of the candidate without a request.
        if listened.candidate.is_none() || (early && side == ShadowSide::Candidate) {
            return;
        }
        let of = listened.of.as_deref();
        let stamp = of.and_then(|of| header_stamp(of, &message.bytes));
        let (requests, answered) = match side {
            ShadowSide::Present => (&self.present, &mut listened.answered.0),
            ShadowSide::Candidate => (&self.candidate, &mut listened.answered.1),
        };
        if let Some(took) = requests.response_time(stamp, answered, at).filter(|_| !message.latching) {
            listened.tally.record_time(side, took);
        }
        let Ok(permit) = self.budget.take(message.bytes.len()) else {
            return notes.add(&topic, "the memory limit is reached");
        };
        let item = UnpairedMessage { message: permit.wrap_bytes(message.bytes), early, read: OnceLock::new() };
        if early {
            if listened.early.len() >= EARLY.1 {
                listened.early.pop_front();
            }
            listened.early.push_back((at, item));
            return;
        }
        listened.pairing.push(side, item);
        let full = listened.pairing.waiting() > WAITING;
        listened.settle((full, false), tolerance, notes, &topic);
    }

    /// Returns true if both sides have published equally many messages.
    pub(super) fn is_even(&self) -> bool {
        self.listened.values().all(|it| it.pairing.is_even())
    }

    /// Ends the comparison: waiting messages have no counterpart.
    pub(super) fn end(&mut self, cut: bool, tolerance: &Tolerance, notes: &mut ComparisonNotes) {
        for (topic, listened) in &mut self.listened {
            listened.settle((true, cut), tolerance, notes, topic);
        }
    }

    /// Returns the tallies of the compared topics.
    pub(super) fn into_tallies(self) -> impl Iterator<Item = Tally> {
        let compared = self.listened.into_values();
        compared.filter(|listened| listened.candidate.is_some()).map(|listened| listened.tally)
    }
}

impl ListenedTopic {
    fn settle(&mut self, (last, cut): (bool, bool), tolerance: &Tolerance, notes: &mut ComparisonNotes, topic: &str) {
        let of = self.of.as_deref();
        let equal = |one: &UnpairedMessage, other: &UnpairedMessage| one.equals(other, of, tolerance);
        for paired in self.pairing.settle(last, equal) {
            match paired {
                PairingResult::Both(_, _, true) => self.tally.record_pair(Vec::new()),
                PairingResult::Both(one, other, false) => {
                    self.tally.record_pair(one.differences(&other, of, tolerance));
                }
                PairingResult::Missing(one) if one.early => {}
                PairingResult::Missing(_) if cut => notes.add(topic, CUT),
                PairingResult::Missing(_) => self.tally.record_missing(),
                PairingResult::Surplus(_) => self.tally.record_surplus(),
                PairingResult::Edge => notes.add(topic, "its counterpart had not arrived when the comparison ended"),
            }
        }
    }
}

/// Returns true for the topics of an action that carry requests and results; the others report progress.
fn is_goal_topic(topic: &str) -> bool {
    ["/goal", "/cancel", "/result"].iter().any(|end| topic.ends_with(end))
}

async fn forward(side: ShadowSide, topic: Arc<str>, mut subscription: Subscription, told: mpsc::Sender<HeardMessage>) {
    while let Some(message) = subscription.messages.recv().await {
        let heard = HeardMessage { side, topic: Arc::clone(&topic), at: Instant::now(), message };
        if told.send(heard).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_output_answers_the_request_of_its_stamp_or_the_last_one_once() {
        let began = Instant::now();
        let at = |millis| began + Duration::from_millis(millis);
        let stamp = |secs| Some(Time { secs, nsecs: 0 });
        let mut requests = RequestHistory::default();
        let mut answered = 0;
        assert_eq!(requests.response_time(None, &mut answered, at(0)), None);
        requests.record(None, at(10));
        assert_eq!(requests.response_time(None, &mut answered, at(30)), Some(20.0));
        // An output without a request answers nothing.
        assert_eq!(requests.response_time(None, &mut answered, at(90)), None);
        requests.record(stamp(1), at(100));
        requests.record(stamp(2), at(110));
        assert_eq!(requests.response_time(stamp(1), &mut answered, at(150)), Some(50.0));
        assert_eq!(requests.response_time(stamp(2), &mut answered, at(150)), Some(40.0));
        assert_eq!(requests.response_time(stamp(9), &mut answered, at(150)), None);
        for secs in 0..1000 {
            requests.record(stamp(secs), at(200));
        }
        assert_eq!(requests.last.len(), REQUESTS);
        // It was received before the last request was made.
        let mut requests = RequestHistory::default();
        requests.record(None, at(10));
        requests.record(None, at(40));
        assert_eq!(requests.response_time(None, &mut 0, at(30)), Some(20.0));
    }
}
