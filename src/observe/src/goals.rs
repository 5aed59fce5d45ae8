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
    /// The node that sent it; none where it was sent by this side.
    pub client: Option<String>,
    /// When it was heard of first, nanoseconds since 1970.
    pub began: u64,
    /// How it ended, and when; none: it has not yet.
    pub ended: Option<(u64, Outcome)>,
}

/// How a goal ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// One in which goals end.
    pub status: Status,
    /// The server's words.
    pub text: String,
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
    topics: Mutex<Vec<(String, Kind)>>,
    /// Grows with each goal that has ended.
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

    fn begins(&self, topic: &str, of: WireType) -> Option<u16> {
        let part = part(topic, &of.name)?;
        let mut topics = self.topics.lock();
        let known = topics.iter().position(|known| *known == part);
        let number = u16::try_from(known.unwrap_or(topics.len())).ok()?;
        if known.is_none() {
            topics.push(part);
        }
        Some(number)
    }

    fn hears(&self, topic: u16, message: Message) {
        let Some((action, kind)) = self.topics.lock().get(usize::from(topic)).cloned() else {
            return;
        };
        let client = message.publisher.node();
        match kind {
            Kind::Goal => self.sent(action, &message.bytes, client),
            Kind::Result => self.answered(&action, &message.bytes),
        };
    }

    fn ends(&self, _topic: &str) {}
}

impl Heard {
    fn sent(&self, action: String, bytes: &Bytes, client: &str) -> Option<()> {
        let (goal, _) = messages::read_goal(bytes)?;
        let id = short(&goal.id);
        let client = (client != self.own).then(|| client.to_owned());
        let mut all = self.all.lock();
        // Its result may have been heard first: they come over two connections.
        let known = all
            .iter_mut()
            .rev()
            .find(|goal| goal.id == id && goal.action == action);
        match known {
            Some(goal) => goal.client = client,
            None => remember(
                &mut all,
                Goal {
                    action,
                    id,
                    client,
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
        let outcome = Outcome {
            status: state.status,
            text: short(&state.text),
        };
        let ended = Some((now(), outcome));
        let mut all = self.all.lock();
        let open = all
            .iter_mut()
            .rev()
            .find(|goal| goal.id == id && goal.action == action);
        match open {
            // A result that is latched comes again with each connection.
            Some(goal) if goal.ended.is_some() => return None,
            Some(goal) => goal.ended = ended,
            None => remember(
                &mut all,
                Goal {
                    action: action.to_owned(),
                    id,
                    client: None,
                    began: now(),
                    ended,
                },
            ),
        }
        drop(all);
        self.ended.send_modify(|count| *count += 1);
        Some(())
    }
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
                text: "there".into()
            }
        );
        assert_eq!(all[0].client.as_deref(), Some("/rover"));
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
        let clients: Vec<_> = all.iter().map(|goal| goal.client.as_deref()).collect();
        assert_eq!(clients, [Some("/rover"), None]);
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
