//! What a node was told to be: its parameters (of ROS 1 by dynamic_reconfigure) and the state of its life (ROS 2). One side was told, and the other one is when it
//! begins: a new process of the local original, or another servant.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::OwnedMutexGuard;
use tokio::time::timeout;

use super::keeper::Answer;
use super::reconfigured;
use super::service_use::ServiceUse;

/// Requests that are kept; a slider that sets one parameter over and over is one of them.
const MOST: usize = 256;
/// For a node to do what it is told.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);
/// Where a message begins behind CDR's header.
const BEGIN: usize = 4;
/// States (`lifecycle_msgs/msg/State`) in which a node can be told to configure, and to activate itself.
const UNCONFIGURED: u8 = 1;
const INACTIVE: u8 = 2;

/// What was told last. A node may be told anew while it is told something new: one of the two comes first to each service, and what is
/// told anew is what holds by then.
#[derive(Debug, Default)]
pub struct Remembered {
    all: Mutex<All>,
    turns: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
}

/// While it lives, nobody else tells the node something by the same service.
pub type Turn = Option<OwnedMutexGuard<()>>;

#[derive(Debug, Default)]
struct All {
    /// In the order in which they were told.
    sets: Vec<Set>,
    /// How many were told.
    told: u64,
    /// What led from the beginning to where the node is.
    way: Vec<Step>,
}

/// Something that was set by this service.
#[derive(Debug, Clone)]
struct Set {
    /// Counted from 1, over all that was told.
    number: u64,
    service: String,
    /// What is set: a parameter, or all that the request says.
    target: Vec<u8>,
    request: Bytes,
}

/// A transition that the node was told by this service.
#[derive(Debug, Clone, PartialEq)]
struct Step {
    service: String,
    transition: Transition,
    request: Bytes,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Transition {
    Configure,
    Activate,
    Deactivate,
    Cleanup,
    Other,
}

impl Remembered {
    /// Whoever holds this tells the node by this service; one that does not answer is waited for no longer than that takes at most.
    pub async fn turn(&self, service: &str) -> Turn {
        let turn = {
            let mut turns = self.turns.lock();
            Arc::clone(turns.entry(service.to_owned()).or_default())
        };
        timeout(PATIENCE, turn.lock_owned()).await.ok()
    }

    /// The node was told this.
    pub fn note(&self, service: &str, what: &ServiceUse, request: &Bytes) {
        let all = &mut *self.all.lock();
        let service = service.to_owned();
        match what {
            ServiceUse::Set => {
                let target = target(request);
                all.sets
                    .retain(|known| known.service != service || known.target != target);
                if all.sets.len() == MOST {
                    all.sets.remove(0);
                }
                all.told += 1;
                all.sets.push(Set {
                    number: all.told,
                    service,
                    target,
                    request: request.clone(),
                });
            }
            ServiceUse::Transition => {
                let transition = Transition::of(request);
                let step = Step {
                    service,
                    transition,
                    request: request.clone(),
                };
                match transition {
                    Transition::Configure => all.way = vec![step],
                    Transition::Activate => {
                        all.way.truncate(1);
                        all.way.push(step);
                    }
                    Transition::Deactivate => all.way.truncate(1),
                    Transition::Cleanup => all.way.clear(),
                    // It ends with that, or knows itself what it means.
                    Transition::Other => {}
                }
            }
            _ => {}
        }
    }

    /// The first thing that was set after the one of this number, as it holds now.
    fn next_set(&self, after: u64) -> Option<Set> {
        let all = self.all.lock();
        let mut sets = all.sets.iter();
        sets.find(|set| set.number > after).cloned()
    }

    /// Tells a node that has begun anew, which is called by `ask`. What it refuses, it would have refused before.
    pub async fn tell(&self, ask: impl Fn(&str, Bytes) -> Answer) {
        let told =
            async |service: &str, request: Bytes| match timeout(PATIENCE, ask(service, request))
                .await
            {
                Ok(Ok(answer)) => Some(answer),
                Ok(Err(failure)) => {
                    tracing::debug!(service, reason = failure.text(), "not told to a node anew");
                    None
                }
                Err(_) => {
                    tracing::warn!(service, "a node that has begun anew does not answer");
                    None
                }
            };
        // Whatever is set meanwhile comes behind, and so last to the node, too: one request may set what others do.
        let mut last = 0;
        while let Some(next) = self.next_set(last) {
            let _turn = self.turn(&next.service).await;
            last = next.number;
            let holds = |set: &Set| set.number == next.number;
            if self.all.lock().sets.iter().any(holds) {
                told(&next.service, next.request).await;
            }
        }
        let way = self.all.lock().way.clone();
        for step in way {
            let _turn = self.turn(&step.service).await;
            if !self.all.lock().way.contains(&step) {
                continue;
            }
            // A transition that does not lead on from where they are makes nodes of rclpy end.
            let states = step.service.replace("change_state", "get_state");
            let state = told(&states, EMPTY.into()).await;
            let from = match step.transition {
                Transition::Configure => UNCONFIGURED,
                _ => INACTIVE,
            };
            if state.is_some_and(|state| state.get(BEGIN) == Some(&from)) {
                told(&step.service, step.request).await;
            }
        }
    }
}

/// A request without fields: CDR fills it with one byte.
const EMPTY: &[u8] = &[0, 1, 0, 0, 0];

impl Transition {
    /// By its label where there is one, as nodes read it, else by its number (`lifecycle_msgs/msg/Transition`).
    fn of(request: &[u8]) -> Self {
        match (text(request, BEGIN + 4), request.get(BEGIN)) {
            (Some(b"configure"), _) => Self::Configure,
            (Some(b"activate"), _) => Self::Activate,
            (Some(b"deactivate"), _) => Self::Deactivate,
            (Some(b"cleanup"), _) => Self::Cleanup,
            (None | Some(b""), Some(1)) => Self::Configure,
            (None | Some(b""), Some(2)) => Self::Cleanup,
            (None | Some(b""), Some(3)) => Self::Activate,
            (None | Some(b""), Some(4)) => Self::Deactivate,
            _ => Self::Other,
        }
    }
}

/// What a request sets: the parameter, where it is one, else all that it says.
fn target(request: &Bytes) -> Vec<u8> {
    if let Some(names) = reconfigured::names(request) {
        return names;
    }
    match (number(request, BEGIN), text(request, BEGIN + 4)) {
        (Some(1), Some(name)) => name.to_vec(),
        _ => request.to_vec(),
    }
}

/// A number at this place, in little endian, as all of ROS 2 writes.
fn number(message: &[u8], at: usize) -> Option<u32> {
    let little = message.get(1)? & 1 == 1;
    let bytes = message.get(at..at + 4)?.try_into().ok()?;
    little.then(|| u32::from_le_bytes(bytes))
}

/// A string at this place, without its end.
fn text(message: &[u8], at: usize) -> Option<&[u8]> {
    let length = usize::try_from(number(message, at)?).ok()?;
    let begin = at + 4;
    message.get(begin..begin.checked_add(length.checked_sub(1)?)?)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    /// A request with one parameter of this name, and something behind it.
    fn set(name: &str, value: u8) -> Bytes {
        let length = u32::try_from(name.len() + 1).unwrap().to_le_bytes();
        let text = [&length[..], name.as_bytes(), &[0, value]].concat();
        [&[0, 1, 0, 0, 1, 0, 0, 0][..], &text].concat().into()
    }

    fn change(id: u8, label: &str) -> Bytes {
        let length = u32::try_from(label.len() + 1).unwrap().to_le_bytes();
        let text = [&length[..], label.as_bytes(), &[0]].concat();
        [&[0, 1, 0, 0, id, 0, 0, 0][..], &text].concat().into()
    }

    /// Services, and what they were asked.
    type Heard = Vec<(String, Bytes)>;

    /// What a node is told that is in this state at first.
    async fn told(all: &Remembered, state: u8) -> Heard {
        let heard: Arc<Mutex<(u8, Heard)>> = Arc::new(Mutex::new((state, vec![])));
        all.tell(|service, request| {
            let mut heard = heard.lock();
            let state = heard.0;
            if service.ends_with("get_state") {
                return Box::pin(async move { Ok(vec![0, 1, 0, 0, state].into()) });
            }
            heard.0 += u8::from(service.ends_with("change_state"));
            heard.1.push((service.to_owned(), request));
            Box::pin(async { Ok(Bytes::new()) })
        })
        .await;
        std::mem::take(&mut heard.lock().1)
    }

    #[tokio::test]
    async fn a_node_that_begins_anew_is_told_what_holds() {
        let all = Remembered::default();
        for (name, value) in [("max", 1), ("min", 2), ("max", 3)] {
            all.note("/n/set_parameters", &ServiceUse::Set, &set(name, value));
        }
        let steps = [
            change(1, ""),
            change(0, "activate"),
            change(4, ""),
            change(3, ""),
        ];
        for step in &steps {
            all.note("/n/change_state", &ServiceUse::Transition, step);
        }
        let sets = [set("min", 2), set("max", 3)].map(|it| ("/n/set_parameters".to_owned(), it));
        let way = [&steps[0], &steps[3]].map(|it| ("/n/change_state".to_owned(), it.clone()));
        let everything = told(&all, UNCONFIGURED).await;
        assert_eq!(everything, [&sets[..], &way[..]].concat());
        // Somebody else has it go on already.
        assert_eq!(told(&all, 3).await, sets);
        all.note(
            "/n/change_state",
            &ServiceUse::Transition,
            &change(2, "cleanup"),
        );
        assert_eq!(told(&all, UNCONFIGURED).await, sets);
        for number in 0..1000 {
            let name = format!("p{number}");
            all.note("/n/set_parameters", &ServiceUse::Set, &set(&name, 0));
        }
        assert_eq!(told(&all, UNCONFIGURED).await.len(), MOST);
    }

    #[tokio::test]
    async fn what_is_set_while_a_node_is_told_anew_holds_in_the_end() {
        let all = Arc::new(Remembered::default());
        let service = "/n/set_parameters";
        let note = |all: &Remembered, request: &Bytes| all.note(service, &ServiceUse::Set, request);
        let [speed, both, faster, slow] = [
            set("speed", 1),
            change(7, "both"),
            set("speed", 2),
            set("slow", 1),
        ];
        note(&all, &speed);
        note(&all, &both);
        note(&all, &slow);
        let (heard, asked) = (Arc::new(Mutex::new(Vec::new())), Arc::new(Mutex::new(None)));
        all.tell(|_, request| {
            let first = heard.lock().is_empty();
            heard.lock().push(request);
            if first {
                // While the first is on its way somebody sets something, and waits for the turn.
                let (setting, heard, faster) = (all.clone(), heard.clone(), faster.clone());
                let set = tokio::spawn(async move {
                    let _turn = setting.turn(service).await;
                    heard.lock().push(faster.clone());
                    setting.note(service, &ServiceUse::Set, &faster);
                });
                *asked.lock() = Some(set);
            }
            Box::pin(async {
                tokio::task::yield_now().await;
                Ok(Bytes::new())
            })
        })
        .await;
        // The old value came first, and none of it after the new one; what may set it, too, came between.
        let heard = heard.lock().clone();
        assert_eq!(heard, [speed, faster.clone(), both, slow, faster]);
    }
}
