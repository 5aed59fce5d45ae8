//! What a node of ROS 2 was told to be: its parameters and the state of its life. One side was told, and the other one is when it
//! begins: a new process of the local original, or another servant.

use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::time::timeout;

use super::keeper::Answer;
use super::service_use::ServiceUse;

/// Requests that are kept; a slider that sets one parameter over and over is one of them.
const MOST: usize = 256;
/// For a node to do what it is told.
const PATIENCE: Duration = Duration::from_secs(10);
/// Where a message begins behind CDR's header.
const BEGIN: usize = 4;
/// States (`lifecycle_msgs/msg/State`) in which a node can be told to configure, and to activate itself.
const UNCONFIGURED: u8 = 1;
const INACTIVE: u8 = 2;

/// What was told last.
#[derive(Debug, Default)]
pub struct Remembered(Mutex<All>);

#[derive(Debug, Default)]
struct All {
    /// By what is set: service and parameter.
    sets: Vec<((String, Vec<u8>), Bytes)>,
    /// The service and what led from the beginning to where the node is.
    way: Vec<(String, Transition, Bytes)>,
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
    /// The node was told this.
    pub fn note(&self, service: &str, what: &ServiceUse, request: &Bytes) {
        let all = &mut *self.0.lock();
        match what {
            ServiceUse::Set => {
                let key = (service.to_owned(), target(request));
                all.sets.retain(|(known, _)| *known != key);
                if all.sets.len() == MOST {
                    all.sets.remove(0);
                }
                all.sets.push((key, request.clone()));
            }
            ServiceUse::Transition => {
                let transition = Transition::of(request);
                let step = (service.to_owned(), transition, request.clone());
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

    /// Tells a node that has begun anew, which is called by `ask`. What it refuses, it would have refused before.
    pub async fn tell(&self, ask: impl Fn(&str, Bytes) -> Answer) {
        let (sets, way) = {
            let all = self.0.lock();
            (all.sets.clone(), all.way.clone())
        };
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
        for ((service, _), request) in sets {
            told(&service, request).await;
        }
        for (service, transition, request) in way {
            // A transition that does not lead on from where they are makes nodes of rclpy end.
            let states = service.replace("change_state", "get_state");
            let state = told(&states, EMPTY.into()).await;
            let from = match transition {
                Transition::Configure => UNCONFIGURED,
                _ => INACTIVE,
            };
            if state.is_some_and(|state| state.get(BEGIN) == Some(&from)) {
                told(&service, request).await;
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
}
