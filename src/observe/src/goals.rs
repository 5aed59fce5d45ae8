//! Outcomes of action goals: every goal sent to the servant, who sent it, and how it ended (actionlib, with the
//! messages `actionlib_msgs/GoalID` and `GoalStatus`).

use std::collections::VecDeque;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{SerializedMessage, WireType};
use ros::ros1::actions::messages::{self, ActionlibStatus};
use tokio::sync::watch;

use crate::follow::{ObservedServant, Observer, ObserverTask, now, spawn_observer};
use crate::id_map::IdMap;

/// Limit on the goals remembered; beyond it, the oldest ended goal is dropped first.
const MAX_GOALS: usize = 200;
/// Maximum length of an id or a result text in characters.
const LONGEST: usize = 200;

/// An action goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObservedGoal {
    /// Name of the action.
    pub action: String,
    /// Goal id chosen by the client.
    pub id: String,
    /// Sender of the goal.
    pub sender: GoalSender,
    /// Time when the goal was first seen, in nanoseconds since 1970; if only its result was seen, the time when it
    /// ended.
    pub began: u64,
    /// Time and outcome of the end; `None` while the goal is active.
    pub ended: Option<(u64, ObservedOutcome)>,
}

/// Sender of a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GoalSender {
    /// This node itself, which does not receive its own messages: recognised by the goal id.
    Inside,
    /// Another node.
    Node(String),
    /// Unknown: only the result was seen, because the goal was sent earlier or cannot be observed.
    Unheard,
}

/// Outcome of a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObservedOutcome {
    /// Terminal status.
    pub status: ActionlibStatus,
    /// Text from the action server.
    pub text: String,
    /// Sequence number among the ended goals, from 1.
    pub number: u64,
}

/// Observes the goals of a servant's actions until dropped.
pub struct GoalMonitor {
    heard: Arc<GoalLog>,
    _followed: ObserverTask,
}

struct GoalLog {
    /// Name of this node.
    own: String,
    all: Mutex<VecDeque<ObservedGoal>>,
    /// Action and kind of each observed topic, by id.
    topics: Mutex<IdMap<(String, Kind)>>,
    /// Number of ended goals; changed only while `all` is locked.
    ended: watch::Sender<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Goal,
    Result,
}

impl GoalMonitor {
    /// Starts observing all actions of the servant.
    pub fn start(seen: ObservedServant) -> Self {
        let heard = Arc::new(GoalLog {
            own: seen.bus.node().to_owned(),
            all: Mutex::default(),
            topics: Mutex::default(),
            ended: watch::Sender::new(0),
        });
        let observer = Arc::clone(&heard);
        Self { heard, _followed: spawn_observer(seen, observer) }
    }

    /// Returns the remembered goals, newest first.
    pub fn recent(&self) -> Vec<ObservedGoal> {
        self.heard.all.lock().iter().rev().cloned().collect()
    }

    /// Returns the remembered goals that ended after goal number `number`, in the order in which they ended.
    pub fn ended_after(&self, number: u64) -> Vec<ObservedGoal> {
        self.heard.ended_after(number)
    }

    /// Returns a receiver of the number of ended goals.
    pub fn subscribe_ended(&self) -> watch::Receiver<u64> {
        self.heard.ended.subscribe()
    }
}

/// Returns the action of a topic and what the topic carries.
fn parse_action_topic(topic: &str, named: &str) -> Option<(String, Kind)> {
    let (action, last) = topic.rsplit_once('/')?;
    let kind = match last {
        "goal" if named.ends_with("ActionGoal") => Kind::Goal,
        "result" if named.ends_with("ActionResult") => Kind::Result,
        _ => return None,
    };
    Some((action.to_owned(), kind))
}

impl Observer for GoalLog {
    fn wants_topic(&self, topic: &str, named: &str) -> bool {
        parse_action_topic(topic, named).is_some()
    }

    fn on_topic_started(&self, topic: &str, of: WireType) -> Option<u32> {
        let part = parse_action_topic(topic, &of.name)?;
        let mut topics = self.topics.lock();
        let known = topics.find(|known| *known == part);
        known.or_else(|| topics.add(part))
    }

    fn on_message(&self, topic: u32, message: SerializedMessage) {
        let Some((action, kind)) = self.topics.lock().get(topic).cloned() else {
            return;
        };
        let client = message.publisher.node();
        match kind {
            Kind::Goal => self.record_goal(action, &message.bytes, client),
            Kind::Result => self.record_result(&action, &message.bytes),
        };
    }

    fn on_topic_ended(&self, topic: &str) {
        self.topics.lock().retain(|_, (action, kind)| {
            let last = match kind {
                Kind::Goal => "/goal",
                Kind::Result => "/result",
            };
            topic.strip_suffix(last) != Some(action)
        });
    }
}

impl GoalLog {
    fn ended_after(&self, number: u64) -> Vec<ObservedGoal> {
        let number_of = |goal: &ObservedGoal| goal.ended.as_ref().map_or(0, |(_, outcome)| outcome.number);
        let all = self.all.lock();
        let mut ended: Vec<ObservedGoal> = all.iter().filter(|goal| number_of(goal) > number).cloned().collect();
        drop(all);
        ended.sort_by_key(number_of);
        ended
    }

    fn record_goal(&self, action: String, bytes: &Bytes, client: &str) -> Option<()> {
        let (goal, _) = messages::read_goal(bytes)?;
        let id = truncate(&goal.id);
        let sender = if client == self.own { GoalSender::Inside } else { GoalSender::Node(client.to_owned()) };
        let mut all = self.all.lock();
        // The result may arrive first, because both come over separate connections.
        let known = all.iter_mut().rev().find(|goal| goal.id == id && goal.action == action);
        match known {
            // The first observed sender counts; the id decides only if none was observed.
            Some(goal) if matches!(goal.sender, GoalSender::Node(_)) => {}
            Some(goal) => goal.sender = sender,
            None => remember(&mut all, ObservedGoal { action, id, sender, began: now(), ended: None }),
        }
        Some(())
    }

    fn record_result(&self, action: &str, bytes: &Bytes) -> Option<()> {
        let (state, _) = messages::read_state(bytes)?;
        let id = truncate(&state.goal.id);
        let mut all = self.all.lock();
        let time = now();
        let number = *self.ended.borrow() + 1;
        let outcome = ObservedOutcome { status: state.status, text: truncate(&state.text), number };
        let ended = Some((time, outcome));
        let open = all.iter_mut().rev().find(|goal| goal.id == id && goal.action == action);
        match open {
            // A latched result arrives again with each connection.
            Some(goal) if goal.ended.is_some() => return None,
            Some(goal) => goal.ended = ended,
            None => {
                let sender =
                    if is_id_of_node(&state.goal.id, &self.own) { GoalSender::Inside } else { GoalSender::Unheard };
                remember(&mut all, ObservedGoal { action: action.to_owned(), id, sender, began: time, ended });
            }
        }
        self.ended.send_replace(number);
        Some(())
    }
}

/// Returns true if the goal id has the form that actionlib clients of this node generate:
/// NODE-NUMBER-SECONDS.NANOSECONDS.
fn is_id_of_node(id: &str, node: &str) -> bool {
    let rest = id.strip_prefix(node).and_then(|rest| rest.strip_prefix('-'));
    let parts = rest.and_then(|rest| {
        let (number, time) = rest.split_once('-')?;
        let (seconds, nanoseconds) = time.split_once('.')?;
        Some([number, seconds, nanoseconds])
    });
    let is_number = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    !node.is_empty() && parts.is_some_and(|parts| parts.into_iter().all(is_number))
}

fn truncate(text: &str) -> String {
    text.chars().take(LONGEST).collect()
}

fn remember(all: &mut VecDeque<ObservedGoal>, goal: ObservedGoal) {
    if all.len() >= MAX_GOALS {
        let over = all.iter().position(|goal| goal.ended.is_some());
        all.remove(over.unwrap_or(0));
    }
    all.push_back(goal);
}

#[cfg(test)]
mod tests {
    use ros::codec::Time;
    use ros::ros1::actions::messages::{GoalId, GoalState};

    use super::*;

    fn id(name: &str) -> GoalId {
        GoalId { id: name.to_owned(), ..GoalId::default() }
    }

    fn goal(name: &str) -> Bytes {
        messages::write_goal(Time::default(), &id(name), b"its own")
    }

    fn result(name: &str, status: ActionlibStatus, text: &str) -> Bytes {
        let state = GoalState { goal: id(name), status, text: text.to_owned() };
        messages::write_state(Time::default(), &state, b"its own")
    }

    fn goal_log() -> GoalLog {
        GoalLog {
            own: "/inside".to_owned(),
            all: Mutex::default(),
            topics: Mutex::default(),
            ended: watch::Sender::new(0),
        }
    }

    #[test]
    fn a_goal_is_known_by_who_sent_it_and_by_its_end() {
        let heard = goal_log();
        heard.record_goal("/dock".into(), &goal("a-1"), "/rover");
        heard.record_result("/dock", &result("a-1", ActionlibStatus::Succeeded, "there"));
        // The same result again, as if latched.
        heard.record_result("/dock", &result("a-1", ActionlibStatus::Aborted, "not there"));
        heard.record_goal("/dock".into(), &goal("a-2"), "/rover");
        let all = heard.all.lock();
        let (_, outcome) = all[0].ended.clone().expect("it has ended");
        assert_eq!(outcome, ObservedOutcome { status: ActionlibStatus::Succeeded, text: "there".into(), number: 1 });
        assert_eq!(all[0].sender, GoalSender::Node("/rover".into()));
        assert_eq!((all.len(), &all[1].ended), (2, &None));
        assert_eq!(*heard.ended.borrow(), 1);
    }

    #[test]
    fn a_result_may_come_before_its_goal_and_without_one() {
        let heard = goal_log();
        heard.record_result("/dock", &result("a-1", ActionlibStatus::Succeeded, ""));
        heard.record_goal("/dock".into(), &goal("a-1"), "/rover");
        heard.record_result("/dock", &result("own", ActionlibStatus::Succeeded, ""));
        let all = heard.all.lock();
        let senders: Vec<_> = all.iter().map(|goal| goal.sender.clone()).collect();
        assert_eq!(senders, [GoalSender::Node("/rover".into()), GoalSender::Unheard]);
        assert_eq!(all[1].ended.as_ref().map(|(time, _)| *time), Some(all[1].began));
    }

    #[test]
    fn this_sides_goals_are_known_by_their_ids_and_others_are_not_taken_for_them() {
        let heard = goal_log();
        for (id, sender) in [
            ("/inside-3-17.000000005", GoalSender::Inside),
            ("/inside", GoalSender::Unheard),
            ("/inside-", GoalSender::Unheard),
            ("/inside-3-17", GoalSender::Unheard),
            ("/inside_too-3-17.5", GoalSender::Unheard),
            ("/inside-too-3-17.5", GoalSender::Unheard),
            ("/rover-3-17.5", GoalSender::Unheard),
            ("", GoalSender::Unheard),
        ] {
            heard.record_result("/dock", &result(id, ActionlibStatus::Succeeded, ""));
            let all = heard.all.lock();
            assert_eq!(all.back().map(|goal| &goal.sender), Some(&sender), "{id}");
        }
        // An observed sender outweighs the id it chose.
        heard.record_goal("/dock".into(), &goal("/inside-3-17.000000005"), "/rover");
        let first = heard.all.lock()[0].sender.clone();
        assert_eq!(first, GoalSender::Node("/rover".into()));
    }

    #[test]
    fn ended_goals_are_listed_in_order() {
        let heard = goal_log();
        for id in ["a", "b", "c"] {
            heard.record_goal("/dock".into(), &goal(id), "/rover");
        }
        for id in ["b", "a"] {
            heard.record_result("/dock", &result(id, ActionlibStatus::Succeeded, ""));
        }
        let ids = |number| -> Vec<String> {
            let ended = heard.ended_after(number).into_iter();
            ended.map(|goal| goal.id).collect()
        };
        assert_eq!(ids(0), ["b", "a"]);
        assert_eq!(ids(1), ["a"]);
        heard.record_result("/dock", &result("c", ActionlibStatus::Aborted, ""));
        assert_eq!((ids(2), *heard.ended.borrow()), (vec!["c".to_owned()], 3));
    }

    #[test]
    fn truncated_goals_are_ignored_and_the_log_is_bounded() {
        let heard = goal_log();
        let whole = goal("a-1");
        for end in 0..whole.len() - b"its own".len() {
            assert_eq!(heard.record_goal("/dock".into(), &whole.slice(..end), "/rover"), None);
        }
        for number in 0..=MAX_GOALS {
            let id = format!("a-{number}");
            heard.record_goal("/dock".into(), &goal(&id), "/rover");
            if number == 1 {
                heard.record_result("/dock", &result(&id, ActionlibStatus::Succeeded, ""));
            }
        }
        let all = heard.all.lock();
        assert_eq!((all.len(), all[1].id.as_str()), (MAX_GOALS, "a-2"));
    }

    #[test]
    fn topics_of_actions_are_told_by_their_types() {
        let dock = |kind| Some(("/dock".to_owned(), kind));
        assert_eq!(parse_action_topic("/dock/goal", "nav/DockActionGoal"), dock(Kind::Goal));
        assert_eq!(parse_action_topic("/dock/result", "nav/DockActionResult"), dock(Kind::Result));
        assert_eq!(parse_action_topic("/dock/goal", "geometry_msgs/Pose"), None);
        assert_eq!(parse_action_topic("/dock/status", "actionlib_msgs/GoalStatusArray"), None);
    }
}
