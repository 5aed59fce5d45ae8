//! Settings of a node: its parameters (in ROS 1 by dynamic_reconfigure) and its lifecycle state (ROS 2). They are sent
//! to one side and replayed to the other when it starts: a new process of the local original, or another servant.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::OwnedMutexGuard;
use tokio::time::timeout;

use super::pending_answer::PendingAnswer;
use super::reconfigured;
use super::service_use::ServiceUse;

/// Largest number of requests that are kept; repeated changes of one parameter, as by a slider, count once.
const MAX_REQUESTS: usize = 256;
/// Time allowed for a node to answer a request.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);
/// Offset of a message behind the CDR header.
const BEGIN: usize = 4;
/// Lifecycle states (`lifecycle_msgs/msg/State`) in which a node can be configured, and activated.
const LIFECYCLE_UNCONFIGURED: u8 = 1;
const INACTIVE: u8 = 2;

/// The last settings of a node. A new setting may be made during a replay: for each service one of the two comes first,
/// and the replay uses the settings that are current by then.
#[derive(Debug, Default)]
pub struct RememberedSettings {
    all: Mutex<RememberedState>,
    turns: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
}

/// Guard that excludes other requests to the same service.
pub type ServiceTurn = Option<OwnedMutexGuard<()>>;

#[derive(Debug, Default)]
struct RememberedState {
    /// Remembered values in the order of the requests.
    sets: Vec<RememberedSet>,
    /// Total number of requests.
    told: u64,
    /// Transitions from the initial to the current lifecycle state.
    way: Vec<LifecycleStep>,
}

/// A setting made by a request to this service.
#[derive(Debug, Clone)]
struct RememberedSet {
    /// Number of the request, counted from 1 over all settings.
    number: u64,
    service: String,
    /// Key of the setting: the name of the parameter, or the whole request.
    target: Vec<u8>,
    request: Bytes,
}

/// A lifecycle transition requested by this service.
#[derive(Debug, Clone, PartialEq)]
struct LifecycleStep {
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

impl RememberedSettings {
    /// Waits for the exclusive right to send to this service, but no longer than a request to a node that does not
    /// answer may take.
    pub async fn acquire_turn(&self, service: &str) -> ServiceTurn {
        let turn = {
            let mut turns = self.turns.lock();
            Arc::clone(turns.entry(service.to_owned()).or_default())
        };
        timeout(PATIENCE, turn.lock_owned()).await.ok()
    }

    /// Records a request that was sent to the node.
    pub fn record(&self, service: &str, what: &ServiceUse, request: &Bytes) {
        let all = &mut *self.all.lock();
        let service = service.to_owned();
        match what {
            ServiceUse::Set => {
                let target = set_target(request);
                all.sets.retain(|known| known.service != service || known.target != target);
                if all.sets.len() == MAX_REQUESTS {
                    all.sets.remove(0);
                }
                all.told += 1;
                all.sets.push(RememberedSet { number: all.told, service, target, request: request.clone() });
            }
            ServiceUse::Transition => {
                let transition = Transition::parse(request);
                let step = LifecycleStep { service, transition, request: request.clone() };
                match transition {
                    Transition::Configure => all.way = vec![step],
                    Transition::Activate => {
                        all.way.truncate(1);
                        all.way.push(step);
                    }
                    Transition::Deactivate => all.way.truncate(1),
                    Transition::Cleanup => all.way.clear(),
                    // It ends the node, or only the node knows its meaning.
                    Transition::Other => {}
                }
            }
            _ => {}
        }
    }

    /// Returns the first current setting with a number greater than `after`.
    fn next_set(&self, after: u64) -> Option<RememberedSet> {
        let all = self.all.lock();
        let mut sets = all.sets.iter();
        sets.find(|set| set.number > after).cloned()
    }

    /// Replays the settings to a new node, which is called by `ask`. A request that it refuses would have been refused
    /// before.
    pub async fn replay(&self, ask: impl Fn(&str, Bytes) -> PendingAnswer) {
        let told = async |service: &str, request: Bytes| match timeout(PATIENCE, ask(service, request)).await {
            Ok(Ok(answer)) => Some(answer),
            Ok(Err(failure)) => {
                tracing::debug!(service, reason = failure.text(), "cannot repeat a request to a restarted node");
                None
            }
            Err(_) => {
                tracing::warn!(service, "a restarted node does not answer");
                None
            }
        };
        // Settings that are made meanwhile have higher numbers, so the node receives them last: one request may set
        // what others do.
        let mut last = 0;
        while let Some(next) = self.next_set(last) {
            let _turn = self.acquire_turn(&next.service).await;
            last = next.number;
            let holds = |set: &RememberedSet| set.number == next.number;
            if self.all.lock().sets.iter().any(holds) {
                told(&next.service, next.request).await;
            }
        }
        let way = self.all.lock().way.clone();
        for step in way {
            let _turn = self.acquire_turn(&step.service).await;
            if !self.all.lock().way.contains(&step) {
                continue;
            }
            // An invalid transition would end an rclpy node.
            let states = step.service.replace("change_state", "get_state");
            let state = told(&states, EMPTY.into()).await;
            let from = match step.transition {
                Transition::Configure => LIFECYCLE_UNCONFIGURED,
                _ => INACTIVE,
            };
            if state.is_some_and(|state| state.get(BEGIN) == Some(&from)) {
                told(&step.service, step.request).await;
            }
        }
    }
}

/// A request without fields: CDR pads it with one byte.
const EMPTY: &[u8] = &[0, 1, 0, 0, 0];

impl Transition {
    /// Parses a transition by its label if it has one, as nodes do, otherwise by its id
    /// (`lifecycle_msgs/msg/Transition`).
    fn parse(request: &[u8]) -> Self {
        match (read_string(request, BEGIN + 4), request.get(BEGIN)) {
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

/// Returns the key of a setting: the name of the parameter, or the whole request.
fn set_target(request: &Bytes) -> Vec<u8> {
    if let Some(names) = reconfigured::parameter_names(request) {
        return names;
    }
    match (read_u32(request, BEGIN), read_string(request, BEGIN + 4)) {
        (Some(1), Some(name)) => name.to_vec(),
        _ => request.to_vec(),
    }
}

/// Reads a number at this offset, in little endian, as all ROS 2 implementations write it.
fn read_u32(message: &[u8], at: usize) -> Option<u32> {
    let little = message.get(1)? & 1 == 1;
    let bytes = message.get(at..at + 4)?.try_into().ok()?;
    little.then(|| u32::from_le_bytes(bytes))
}

/// Reads a string at this offset, without its terminator.
fn read_string(message: &[u8], at: usize) -> Option<&[u8]> {
    let length = usize::try_from(read_u32(message, at)?).ok()?;
    let begin = at + 4;
    message.get(begin..begin.checked_add(length.checked_sub(1)?)?)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    /// Returns a request with one parameter of this name and some value.
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

    /// Services, and the requests that they received.
    type Heard = Vec<(String, Bytes)>;

    /// Replays to a node that is in this state initially, and returns its requests.
    async fn replayed_requests(all: &RememberedSettings, state: u8) -> Heard {
        let heard: Arc<Mutex<(u8, Heard)>> = Arc::new(Mutex::new((state, vec![])));
        all.replay(|service, request| {
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
        let all = RememberedSettings::default();
        for (name, value) in [("max", 1), ("min", 2), ("max", 3)] {
            all.record("/n/set_parameters", &ServiceUse::Set, &set(name, value));
        }
        let steps = [change(1, ""), change(0, "activate"), change(4, ""), change(3, "")];
        for step in &steps {
            all.record("/n/change_state", &ServiceUse::Transition, step);
        }
        let sets = [set("min", 2), set("max", 3)].map(|it| ("/n/set_parameters".to_owned(), it));
        let way = [&steps[0], &steps[3]].map(|it| ("/n/change_state".to_owned(), it.clone()));
        let everything = replayed_requests(&all, LIFECYCLE_UNCONFIGURED).await;
        assert_eq!(everything, [&sets[..], &way[..]].concat());
        // Another client has already advanced the state.
        assert_eq!(replayed_requests(&all, 3).await, sets);
        all.record("/n/change_state", &ServiceUse::Transition, &change(2, "cleanup"));
        assert_eq!(replayed_requests(&all, LIFECYCLE_UNCONFIGURED).await, sets);
        for number in 0..1000 {
            let name = format!("p{number}");
            all.record("/n/set_parameters", &ServiceUse::Set, &set(&name, 0));
        }
        assert_eq!(replayed_requests(&all, LIFECYCLE_UNCONFIGURED).await.len(), MAX_REQUESTS);
    }

    #[tokio::test]
    async fn what_is_set_while_a_node_is_told_anew_holds_in_the_end() {
        let all = Arc::new(RememberedSettings::default());
        let service = "/n/set_parameters";
        let note = |all: &RememberedSettings, request: &Bytes| all.record(service, &ServiceUse::Set, request);
        let [speed, both, faster, slow] = [set("speed", 1), change(7, "both"), set("speed", 2), set("slow", 1)];
        note(&all, &speed);
        note(&all, &both);
        note(&all, &slow);
        let (heard, asked) = (Arc::new(Mutex::new(Vec::new())), Arc::new(Mutex::new(None)));
        all.replay(|_, request| {
            let first = heard.lock().is_empty();
            heard.lock().push(request);
            if first {
                // During the first request, another client makes a setting and waits for its turn.
                let (setting, heard, faster) = (all.clone(), heard.clone(), faster.clone());
                let set = tokio::spawn(async move {
                    let _turn = setting.acquire_turn(service).await;
                    heard.lock().push(faster.clone());
                    setting.record(service, &ServiceUse::Set, &faster);
                });
                *asked.lock() = Some(set);
            }
            Box::pin(async {
                tokio::task::yield_now().await;
                Ok(Bytes::new())
            })
        })
        .await;
        // The old value came first and was not repeated after the new one; the other request, which may set the same
        // parameter, came in between.
        let heard = heard.lock().clone();
        assert_eq!(heard, [speed, faster.clone(), both, slow, faster]);
    }
}
