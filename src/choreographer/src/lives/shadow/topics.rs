//! Topics of a robot's servant and of the candidate: what the robot publishes is given to both, and what the nodes of both publish
//! is paired.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use api::shadow::Kind;
use budget::Budget;
use reach::Look;
use ros::bus::{Bus, Graph, Message, PeerId, Publisher, Qos, Subscription, WireType, reaches};
use ros::codec::{Time, header_stamp};
use ros::schema::{MessageType, Registry};
use serde_json::Value;
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

use super::mirror::{CUT, Notes, Read, differing, millis, read};
use crate::decide::shadow::{Paired, Pairing, Side, Tally, Tolerance, WINDOW};

/// The name of the node that listens beside the robot's.
pub(super) const NODE: &str = "/cloudroid_shadow";
/// Of each topic.
const QUEUE: usize = 64;
/// What was heard and not looked at.
const AHEAD: usize = 256;
/// Messages that wait for a counterpart; beyond, the oldest have none.
const WAITING: usize = 16 * WINDOW;
/// For the candidate's nodes to be connected.
const PATIENCE: Duration = Duration::from_secs(5);
/// An output may be heard before the message that it answers: by so much, at most, and as many of each topic.
const EARLY: (Duration, usize) = (Duration::from_secs(1), 2);
/// Of which an output may be the answer to any.
const REQUESTS: usize = 256;

/// Topics of both sides.
pub(super) struct Topics {
    /// None where the robot shares its servants with others: then it has no topics.
    from: Option<Look>,
    to: Arc<dyn Bus>,
    /// The node by which the robot is in the graph of its servant.
    robot: String,
    registry: Arc<Registry>,
    budget: Budget,
    told: mpsc::Sender<Heard>,
    pub(super) heard: mpsc::Receiver<Heard>,
    listened: BTreeMap<String, Listened>,
    /// By topic, and by publisher where newcomers are given each one's last message.
    publishers: HashMap<(String, Option<PeerId>), Box<dyn Publisher>>,
    present: Requests,
    candidate: Requests,
    pub(super) given: u64,
    /// Stubs send goals by the topics of actions.
    linked: bool,
}

/// A message of a topic.
pub(super) struct Heard {
    side: Side,
    topic: Arc<str>,
    at: Instant,
    message: Message,
}

/// One topic.
struct Listened {
    of: Option<Arc<MessageType>>,
    _present: AbortOnDropHandle<()>,
    /// Where nodes of the service publish it and the robot listens.
    candidate: Option<AbortOnDropHandle<()>>,
    pairing: Pairing<Item>,
    /// Outputs of the present servant from before the first request.
    early: VecDeque<(Instant, Item)>,
    tally: Tally,
    /// Requests when the last output came: of the present servant, and of the candidate.
    answered: (u64, u64),
}

/// A message that waits for its counterpart.
struct Item {
    message: bytes::Bytes,
    /// It may be of before.
    early: bool,
    read: OnceLock<Read>,
}

impl Item {
    fn read(&self, of: Option<&MessageType>) -> Option<&Value> {
        let read = || read(of, &self.message);
        self.read.get_or_init(read).as_ref()
    }

    fn equals(&self, other: &Item, of: Option<&MessageType>, tolerance: &Tolerance) -> bool {
        self.message == other.message || self.differing(other, of, tolerance).is_empty()
    }

    fn differing(
        &self,
        other: &Item,
        of: Option<&MessageType>,
        tolerance: &Tolerance,
    ) -> Vec<crate::decide::shadow::Differing> {
        let values = self.read(of).zip(other.read(of));
        differing(values, (&self.message, &other.message), tolerance)
    }
}

/// What one side was asked by topics, calls and goals.
#[derive(Default)]
struct Requests {
    count: u64,
    /// The last of them, each with its number, its stamp, and when it was asked.
    last: VecDeque<(u64, Option<Time>, Instant)>,
}

impl Requests {
    fn asked(&mut self, stamp: Option<Time>, at: Instant) {
        self.count += 1;
        let stamp = stamp.filter(|stamp| *stamp != Time::default());
        self.last.push_back((self.count, stamp, at));
        if self.last.len() > REQUESTS {
            self.last.pop_front();
        }
    }

    /// How long the request took that an output answers: that with its stamp, or, where none has a stamp, the last one before it,
    /// which it is the first to answer.
    fn took(&self, stamp: Option<Time>, answered: &mut u64, at: Instant) -> Option<f64> {
        let stamped = stamp.is_some() && self.last.iter().any(|(_, stamp, _)| stamp.is_some());
        let mut latest_first = self.last.iter().rev();
        // What was heard may be looked at only after the next request.
        let (number, _, asked) = latest_first.find(|(_, of, asked)| match stamped {
            true => *of == stamp,
            false => *asked <= at,
        })?;
        let first = *answered != *number;
        *answered = *number;
        (stamped || first).then(|| millis(at.saturating_duration_since(*asked)))
    }
}

impl Topics {
    pub(super) fn new(
        from: Option<Look>,
        to: Arc<dyn Bus>,
        (robot, linked): (&str, bool),
        registry: &Arc<Registry>,
        budget: &Budget,
    ) -> Topics {
        let (told, heard) = mpsc::channel(AHEAD);
        Topics {
            from,
            to,
            robot: robot.to_owned(),
            registry: Arc::clone(registry),
            budget: budget.clone(),
            told,
            heard,
            listened: BTreeMap::new(),
            publishers: HashMap::new(),
            present: Requests::default(),
            candidate: Requests::default(),
            given: 0,
            linked,
        }
    }

    /// Listens to what the graph of the robot's servant shows: topics to which its nodes listen, and those to which the robot does.
    /// No others: a node may publish something only while somebody listens.
    pub(super) async fn follow(&mut self, graph: &Graph, notes: &mut Notes) {
        let Some(look) = &self.from else {
            return;
        };
        let from = Arc::clone(&look.bus);
        let own = |node: &String| *node != self.robot && node != NODE;
        let of_actions: Vec<&String> = graph
            .actions
            .values()
            .flat_map(|action| &action.topics)
            .filter(|topic| !(self.linked && is_of_goals(topic)))
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
            if let Err(why) = outcome {
                notes.add(&name, &why);
            }
        }
    }

    async fn listen(
        &mut self,
        from: &Arc<dyn Bus>,
        name: &str,
        type_name: &str,
        (input, output): (bool, bool),
    ) -> Result<(), String> {
        let of = self.registry.message(type_name).ok();
        let known = self.listened.get(name);
        let heard_there = known.is_some_and(|known| known.candidate.is_some());
        let mut candidate = None;
        if output && !heard_there {
            candidate = Some(self.hear(Side::Candidate, &self.to, name, true).await?);
        }
        let key = (name.to_owned(), None);
        if let Some(of) = of.as_ref().filter(|_| input)
            && !self.publishers.contains_key(&key)
        {
            let advertised = self
                .to
                .advertise(name, WireType::of(of), Qos::keep_last(QUEUE))
                .await;
            let publisher = advertised.map_err(|error| error.to_string())?;
            let listens = tokio::time::timeout(PATIENCE, reaches(publisher.matched(), 1)).await;
            self.publishers.insert(key, publisher);
            if listens.is_err() {
                // Later ones are given to it all the same.
                return Err(format!(
                    "no node of the candidate listens to it, after {PATIENCE:?}"
                ));
            }
        }
        match self.listened.get_mut(name) {
            Some(known) => {
                if candidate.is_some() {
                    known.candidate = candidate;
                }
            }
            None => {
                let present = self.hear(Side::Present, from, name, output).await?;
                let listened = Listened {
                    of,
                    _present: present,
                    candidate,
                    pairing: Pairing::default(),
                    early: VecDeque::new(),
                    tally: Tally::of(Kind::Topic, name),
                    answered: (0, 0),
                };
                self.listened.insert(name.to_owned(), listened);
            }
        }
        Ok(())
    }

    /// Passes on what is published; from the first message on where a publisher is there.
    async fn hear(
        &self,
        side: Side,
        bus: &Arc<dyn Bus>,
        name: &str,
        published: bool,
    ) -> Result<AbortOnDropHandle<()>, String> {
        let subscribed = bus.subscribe(name, WireType::any(), Qos::keep_last(QUEUE));
        let subscription = subscribed.await.map_err(|error| error.to_string())?;
        let connected = reaches(subscription.matched.clone(), usize::from(published));
        // One that publishes later is heard later.
        let _ = tokio::time::timeout(PATIENCE, connected).await;
        let (topic, told) = (Arc::from(name), self.told.clone());
        Ok(AbortOnDropHandle::new(tokio::spawn(pass_on(
            side,
            topic,
            subscription,
            told,
        ))))
    }

    /// A call or a goal was given to both: outputs may answer it.
    pub(super) fn asked(&mut self, at: Instant) {
        self.begins(at);
        self.present.asked(None, at);
        self.candidate.asked(None, Instant::now());
    }

    /// Before the first request: what was heard just before it may answer it.
    fn begins(&mut self, at: Instant) {
        if self.present.count > 0 {
            return;
        }
        for listened in self.listened.values_mut() {
            for (heard, item) in listened.early.drain(..) {
                if heard + EARLY.0 >= at {
                    listened.pairing.push(Side::Present, item);
                }
            }
        }
    }

    /// Whether it is the robot's.
    pub(super) fn is_request(&self, heard: &Heard) -> bool {
        heard.side == Side::Present && heard.message.publisher.node() == self.robot
    }

    /// Whose output it is.
    pub(super) fn is_present(heard: &Heard) -> bool {
        heard.side == Side::Present
    }

    /// Gives a message of the robot to the candidate.
    pub(super) async fn give(&mut self, heard: Heard, notes: &mut Notes) {
        let Heard {
            topic, at, message, ..
        } = heard;
        let Some(listened) = self.listened.get(&*topic) else {
            return;
        };
        let of = listened.of.as_deref();
        let stamp = of.and_then(|of| header_stamp(of, &message.bytes));
        let whose = message.latching.then(|| message.publisher.clone());
        let key = (topic.to_string(), whose);
        if !self.publishers.contains_key(&key) {
            let wire_type = WireType::clone(&message.wire_type);
            let advertised = self.to.advertise(
                &topic,
                wire_type,
                Qos::keep_last(QUEUE).latching(message.latching),
            );
            match advertised.await {
                Ok(publisher) => drop(self.publishers.insert(key.clone(), publisher)),
                Err(error) => return notes.add(&topic, &error.to_string()),
            }
        }
        self.begins(at);
        self.present.asked(stamp, at);
        self.candidate.asked(stamp, Instant::now());
        self.publishers[&key].publish(message.bytes);
        self.given += 1;
    }

    /// An output of a side has come.
    pub(super) fn answered(&mut self, heard: Heard, tolerance: &Tolerance, notes: &mut Notes) {
        let Heard {
            side,
            topic,
            at,
            message,
        } = heard;
        let Some(listened) = self.listened.get_mut(&*topic) else {
            return;
        };
        if listened.of.is_none() {
            listened.of = message.wire_type.schema().ok();
        }
        let early = self.present.count == 0 && !message.latching;
        // A topic that nobody compared yet, or what the candidate says unasked.
        if listened.candidate.is_none() || (early && side == Side::Candidate) {
            return;
        }
        let of = listened.of.as_deref();
        let stamp = of.and_then(|of| header_stamp(of, &message.bytes));
        let (requests, answered) = match side {
            Side::Present => (&self.present, &mut listened.answered.0),
            Side::Candidate => (&self.candidate, &mut listened.answered.1),
        };
        if let Some(took) = requests
            .took(stamp, answered, at)
            .filter(|_| !message.latching)
        {
            listened.tally.time(side, took);
        }
        let Ok(permit) = self.budget.take(message.bytes.len()) else {
            return notes.add(&topic, "more may not be held in memory");
        };
        let item = Item {
            message: permit.around(message.bytes),
            early,
            read: OnceLock::new(),
        };
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

    /// Whether each side has published as much as the other.
    pub(super) fn is_even(&self) -> bool {
        self.listened.values().all(|it| it.pairing.is_even())
    }

    /// It is over: what waits has no counterpart.
    pub(super) fn end(&mut self, cut: bool, tolerance: &Tolerance, notes: &mut Notes) {
        for (topic, listened) in &mut self.listened {
            listened.settle((true, cut), tolerance, notes, topic);
        }
    }

    /// Of those topics that were compared.
    pub(super) fn into_tallies(self) -> impl Iterator<Item = Tally> {
        let compared = self.listened.into_values();
        compared
            .filter(|listened| listened.candidate.is_some())
            .map(|listened| listened.tally)
    }
}

impl Listened {
    fn settle(
        &mut self,
        (last, cut): (bool, bool),
        tolerance: &Tolerance,
        notes: &mut Notes,
        topic: &str,
    ) {
        let of = self.of.as_deref();
        let equal = |one: &Item, other: &Item| one.equals(other, of, tolerance);
        for paired in self.pairing.settle(last, equal) {
            match paired {
                Paired::Both(_, _, true) => self.tally.pair(Vec::new()),
                Paired::Both(one, other, false) => {
                    self.tally.pair(one.differing(&other, of, tolerance));
                }
                Paired::Missing(one) if one.early => {}
                Paired::Missing(_) if cut => notes.add(topic, CUT),
                Paired::Missing(_) => self.tally.missing(),
                Paired::Surplus(_) => self.tally.surplus(),
                Paired::Edge => notes.add(topic, "its counterpart had not come when it ended"),
            }
        }
    }
}

/// Of the topics of an action those that say what is asked and what came of it; the others say how it gets on.
fn is_of_goals(topic: &str) -> bool {
    ["/goal", "/cancel", "/result"]
        .iter()
        .any(|end| topic.ends_with(end))
}

async fn pass_on(
    side: Side,
    topic: Arc<str>,
    mut subscription: Subscription,
    told: mpsc::Sender<Heard>,
) {
    while let Some(message) = subscription.messages.recv().await {
        let heard = Heard {
            side,
            topic: Arc::clone(&topic),
            at: Instant::now(),
            message,
        };
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
        let mut requests = Requests::default();
        let mut answered = 0;
        assert_eq!(requests.took(None, &mut answered, at(0)), None);
        requests.asked(None, at(10));
        assert_eq!(requests.took(None, &mut answered, at(30)), Some(20.0));
        // What comes by itself answers nothing.
        assert_eq!(requests.took(None, &mut answered, at(90)), None);
        requests.asked(stamp(1), at(100));
        requests.asked(stamp(2), at(110));
        assert_eq!(requests.took(stamp(1), &mut answered, at(150)), Some(50.0));
        assert_eq!(requests.took(stamp(2), &mut answered, at(150)), Some(40.0));
        assert_eq!(requests.took(stamp(9), &mut answered, at(150)), None);
        for secs in 0..1000 {
            requests.asked(stamp(secs), at(200));
        }
        assert_eq!(requests.last.len(), REQUESTS);
        // It was heard before the last request was made.
        let mut requests = Requests::default();
        requests.asked(None, at(10));
        requests.asked(None, at(40));
        assert_eq!(requests.took(None, &mut 0, at(30)), Some(20.0));
    }
}
