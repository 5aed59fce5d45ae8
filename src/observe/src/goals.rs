//! What became of goals: each goal of an action that was sent to the servant, who sent it, and how it ended (actionlib; its
//! messages are `actionlib_msgs/GoalID` and `GoalStatus`).

use std::collections::VecDeque;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Message, WireType};
use ros::ros1::actions::messages::{self, Status};
use tokio::sync::watch;

use crate::follow::{Followed, Observer, Seen, follow, now};
use crate::numbered::Numbered;

/// Goals that are remembered; beyond, the oldest that have ended go first.
const MOST: usize = 200;
/// Characters of an id or of a server's words that are kept.
const LONGEST: usize = 200;

/// A goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Goal {
    /// The action.
    pub action: String,
    /// As its client has called it.
    pub id: String,
    /// Who sent it.
    pub sender: Sender,
    /// When it was heard of first, nanoseconds since 1970: of one that was not heard itself, when it ended.
    pub began: u64,
    /// How it ended, and when; none: it has not yet.
    pub ended: Option<(u64, Outcome)>,
}

/// Who sent a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Sender {
    /// This side, which does not hear itself: the goal is known by its id.
    Inside,
    /// This node.
    Node(String),
    /// The result was heard alone: the goal was sent before anybody listened, or where nobody can.
    Unheard,
}

/// How a goal ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// One in which goals end.
    pub status: Status,
    /// The server's words.
    pub text: String,
    /// The how manieth it is of those that were heard to end; from 1.
    pub number: u64,
}

/// Hears a servant's actions until it is dropped.
pub struct Goals {
    heard: Arc<Heard>,
    _followed: Followed,
}

struct Heard {
    /// The name of this side's node.
    own: String,
    all: Mutex<VecDeque<Goal>>,
    /// By number.
    topics: Mutex<Numbered<(String, Kind)>>,
    /// Grows with each goal that has ended, while all are locked.
    ended: watch::Sender<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Goal,
    Result,
}

impl Goals {
    /// Of all actions there.
    pub fn of(seen: Seen) -> Self {
        let heard = Arc::new(Heard {
            own: seen.bus.node().to_owned(),
            all: Mutex::default(),
            topics: Mutex::default(),
            ended: watch::Sender::new(0),
        });
        let observer = Arc::clone(&heard);
        Self {
            heard,
            _followed: follow(seen, observer),
        }
    }

    /// Those that are remembered, the newest first.
    pub fn all(&self) -> Vec<Goal> {
        self.heard.all.lock().iter().rev().cloned().collect()
    }

    /// Those that have ended after so many had, the first of them first; without those that are not remembered any more.
    pub fn ended_after(&self, number: u64) -> Vec<Goal> {
        self.heard.ended_after(number)
    }

    /// Grows with each goal that has ended.
    pub fn ended(&self) -> watch::Receiver<u64> {
        self.heard.ended.subscribe()
    }
}

/// The action of a topic, and what it carries.
fn part(topic: &str, named: &str) -> Option<(String, Kind)> {
    let (action, last) = topic.rsplit_once('/')?;
    let kind = match last {
        "goal" if named.ends_with("ActionGoal") => Kind::Goal,
        "result" if named.ends_with("ActionResult") => Kind::Result,
        _ => return None,
    };
    Some((action.to_owned(), kind))
}

impl Observer for Heard {
    fn wants(&self, topic: &str, named: &str) -> bool {
        part(topic, named).is_some()
    }

    fn begins(&self, topic: &str, of: WireType) -> Option<u32> {
        let part = part(topic, &of.name)?;
        let mut topics = self.topics.lock();
        let known = topics.find(|known| *known == part);
        known.or_else(|| topics.add(part))
    }

    fn hears(&self, topic: u32, message: Message) {
        let Some((action, kind)) = self.topics.lock().get(topic).cloned() else {
            return;
        };
        let client = message.publisher.node();
        match kind {
            Kind::Goal => self.sent(action, &message.bytes, client),
            Kind::Result => self.answered(&action, &message.bytes),
        };
    }

    fn ends(&self, topic: &str) {
        self.topics.lock().retain(|_, (action, kind)| {
            let last = match kind {
                Kind::Goal => "/goal",
                Kind::Result => "/result",
            };
            topic.strip_suffix(last) != Some(action)
        });
    }
}

impl Heard {
    fn ended_after(&self, number: u64) -> Vec<Goal> {
        let number_of = |goal: &Goal| goal.ended.as_ref().map_or(0, |(_, outcome)| outcome.number);
        let all = self.all.lock();
        let mut ended: Vec<Goal> = all
            .iter()
            .filter(|goal| number_of(goal) > number)
            .cloned()
            .collect();
        drop(all);
        ended.sort_by_key(number_of);
        ended
    }

    fn sent(&self, action: String, bytes: &Bytes, client: &str) -> Option<()> {
        let (goal, _) = messages::read_goal(bytes)?;
        let id = short(&goal.id);
        let sender = match client == self.own {
            true => Sender::Inside,
            false => Sender::Node(client.to_owned()),
        };
        let mut all = self.all.lock();
        // Its result may have been heard first: they come over two connections.
        let known = all
            .iter_mut()
            .rev()
            .find(|goal| goal.id == id && goal.action == action);
        match known {
            // Who was heard to send it first; what an id says counts where nobody was.
            Some(goal) if matches!(goal.sender, Sender::Node(_)) => {}
            Some(goal) => goal.sender = sender,
            None => remember(
                &mut all,
                Goal {
                    action,
                    id,
                    sender,
                    began: now(),
                    ended: None,
                },
            ),
        }
        Some(())
    }

    fn answered(&self, action: &str, bytes: &Bytes) -> Option<()> {
        let (state, _) = messages::read_state(bytes)?;
        let id = short(&state.goal.id);
        let mut all = self.all.lock();
        let time = now();
        let number = *self.ended.borrow() + 1;
        let outcome = Outcome {
            status: state.status,
            text: short(&state.text),
            number,
        };
        let ended = Some((time, outcome));
        let open = all
            .iter_mut()
            .rev()
            .find(|goal| goal.id == id && goal.action == action);
        match open {
            // A result that is latched comes again with each connection.
            Some(goal) if goal.ended.is_some() => return None,
            Some(goal) => goal.ended = ended,
            None => {
                let sender = match is_of(&state.goal.id, &self.own) {
                    true => Sender::Inside,
                    false => Sender::Unheard,
                };
                remember(
                    &mut all,
                    Goal {
                        action: action.to_owned(),
                        id,
                        sender,
                        began: time,
                        ended,
                    },
                );
            }
        }
        self.ended.send_replace(number);
        Some(())
    }
}

/// Whether a goal's id is one that actionlib's clients make, and this node has: NODE-NUMBER-SECONDS.NANOSECONDS.
fn is_of(id: &str, node: &str) -> bool {
    let rest = id
        .strip_prefix(node)
        .and_then(|rest| rest.strip_prefix('-'));
    let parts = rest.and_then(|rest| {
        let (number, time) = rest.split_once('-')?;
        let (seconds, nanoseconds) = time.split_once('.')?;
        Some([number, seconds, nanoseconds])
    });
    let is_number = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    !node.is_empty() && parts.is_some_and(|parts| parts.into_iter().all(is_number))
}

fn short(text: &str) -> String {
    text.chars().take(LONGEST).collect()
}

fn remember(all: &mut VecDeque<Goal>, goal: Goal) {
    if all.len() >= MOST {
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
        GoalId {
            id: name.to_owned(),
            ..GoalId::default()
        }
    }

    fn goal(name: &str) -> Bytes {
        messages::write_goal(Time::default(), &id(name), b"its own")
    }

    fn result(name: &str, status: Status, text: &str) -> Bytes {
        let state = GoalState {
            goal: id(name),
            status,
            text: text.to_owned(),
        };
        messages::write_state(Time::default(), &state, b"its own")
    }

    fn heard() -> Heard {
        Heard {
            own: "/inside".to_owned(),
            all: Mutex::default(),
            topics: Mutex::default(),
            ended: watch::Sender::new(0),
        }
    }

    #[test]
    fn a_goal_is_known_by_who_sent_it_and_by_its_end() {
        let heard = heard();
        heard.sent("/dock".into(), &goal("a-1"), "/rover");
        heard.answered("/dock", &result("a-1", Status::Succeeded, "there"));
        // Again, as a latched one.
        heard.answered("/dock", &result("a-1", Status::Aborted, "not there"));
        heard.sent("/dock".into(), &goal("a-2"), "/rover");
        let all = heard.all.lock();
        let (_, outcome) = all[0].ended.clone().expect("it has ended");
        assert_eq!(
            outcome,
            Outcome {
                status: Status::Succeeded,
                text: "there".into(),
                number: 1
            }
        );
        assert_eq!(all[0].sender, Sender::Node("/rover".into()));
        assert_eq!((all.len(), &all[1].ended), (2, &None));
        assert_eq!(*heard.ended.borrow(), 1);
    }

    #[test]
    fn a_result_may_come_before_its_goal_and_without_one() {
        let heard = heard();
        heard.answered("/dock", &result("a-1", Status::Succeeded, ""));
        heard.sent("/dock".into(), &goal("a-1"), "/rover");
        heard.answered("/dock", &result("own", Status::Succeeded, ""));
        let all = heard.all.lock();
        let senders: Vec<_> = all.iter().map(|goal| goal.sender.clone()).collect();
        assert_eq!(senders, [Sender::Node("/rover".into()), Sender::Unheard]);
        assert_eq!(
            all[1].ended.as_ref().map(|(time, _)| *time),
            Some(all[1].began)
        );
    }

    #[test]
    fn this_sides_goals_are_known_by_their_ids_and_others_are_not_taken_for_them() {
        let heard = heard();
        for (id, sender) in [
            ("/inside-3-17.000000005", Sender::Inside),
            ("/inside", Sender::Unheard),
            ("/inside-", Sender::Unheard),
            ("/inside-3-17", Sender::Unheard),
            ("/inside_too-3-17.5", Sender::Unheard),
            ("/inside-too-3-17.5", Sender::Unheard),
            ("/rover-3-17.5", Sender::Unheard),
            ("", Sender::Unheard),
        ] {
            heard.answered("/dock", &result(id, Status::Succeeded, ""));
            let all = heard.all.lock();
            assert_eq!(all.back().map(|goal| &goal.sender), Some(&sender), "{id}");
        }
        // Who says so and is heard is not believed.
        heard.sent("/dock".into(), &goal("/inside-3-17.000000005"), "/rover");
        let first = heard.all.lock()[0].sender.clone();
        assert_eq!(first, Sender::Node("/rover".into()));
    }

    #[test]
    fn each_that_has_ended_is_told_in_turn() {
        let heard = heard();
        for id in ["a", "b", "c"] {
            heard.sent("/dock".into(), &goal(id), "/rover");
        }
        for id in ["b", "a"] {
            heard.answered("/dock", &result(id, Status::Succeeded, ""));
        }
        let ids = |number| -> Vec<String> {
            let ended = heard.ended_after(number).into_iter();
            ended.map(|goal| goal.id).collect()
        };
        assert_eq!(ids(0), ["b", "a"]);
        assert_eq!(ids(1), ["a"]);
        heard.answered("/dock", &result("c", Status::Aborted, ""));
        assert_eq!((ids(2), *heard.ended.borrow()), (vec!["c".to_owned()], 3));
    }

    #[test]
    fn what_is_cut_off_is_no_goal_and_no_more_are_kept_than_allowed() {
        let heard = heard();
        let whole = goal("a-1");
        for end in 0..whole.len() - b"its own".len() {
            assert_eq!(
                heard.sent("/dock".into(), &whole.slice(..end), "/rover"),
                None
            );
        }
        for number in 0..=MOST {
            let id = format!("a-{number}");
            heard.sent("/dock".into(), &goal(&id), "/rover");
            if number == 1 {
                heard.answered("/dock", &result(&id, Status::Succeeded, ""));
            }
        }
        let all = heard.all.lock();
        assert_eq!((all.len(), all[1].id.as_str()), (MOST, "a-2"));
    }

    #[test]
    fn topics_of_actions_are_told_by_their_types() {
        let dock = |kind| Some(("/dock".to_owned(), kind));
        assert_eq!(part("/dock/goal", "nav/DockActionGoal"), dock(Kind::Goal));
        assert_eq!(
            part("/dock/result", "nav/DockActionResult"),
            dock(Kind::Result)
        );
        assert_eq!(part("/dock/goal", "geometry_msgs/Pose"), None);
        assert_eq!(part("/dock/status", "actionlib_msgs/GoalStatusArray"), None);
    }
}
