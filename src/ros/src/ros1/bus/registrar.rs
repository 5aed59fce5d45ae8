//! What this node wants registered, and what it believes the Master has: brought together one call at a time
//! per name, so that taking back and registering again cannot overtake each other.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use super::master_client::MasterClient;
use crate::bus::{BusError, Graph};
use crate::ros1::xmlrpc::Value;

/// What is registered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Kind {
    Publisher,
    Subscriber,
    Service,
}

type Key = (Kind, String);

/// A service that another node has registered as well is taken back after such a pause, which doubles each time, at most up
/// to the second. Who calls it reaches the node that registered last.
const PAUSES: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(600));

/// Another node registers the same service.
struct Contest {
    /// It is not taken back before.
    until: Instant,
    pause: Duration,
}

#[derive(Default)]
struct Slot {
    /// The type to be registered with, if it is to be registered.
    wanted: Mutex<Option<String>>,
    /// The type the Master was told. Locked while it is being told.
    told: tokio::sync::Mutex<Option<String>>,
}

/// All registrations of this node.
pub(super) struct Registrar {
    master: Arc<MasterClient>,
    slave_uri: String,
    service_uri: String,
    slots: Mutex<HashMap<Key, Arc<Slot>>>,
    contests: Mutex<HashMap<String, Contest>>,
}

impl Registrar {
    pub(super) fn new(master: Arc<MasterClient>, slave_uri: String, service_uri: String) -> Self {
        Self {
            master,
            slave_uri,
            service_uri,
            slots: Mutex::default(),
            contests: Mutex::default(),
        }
    }

    pub(super) fn slave_uri(&self) -> &str {
        &self.slave_uri
    }

    pub(super) fn service_uri(&self) -> &str {
        &self.service_uri
    }

    /// Says what is wanted from now on; [`Registrar::sync`] makes it so.
    pub(super) fn want(&self, kind: Kind, name: &str, type_name: Option<&str>) {
        let mut slots = self.slots.lock();
        let slot = slots.entry((kind, name.to_owned())).or_default();
        *slot.wanted.lock() = type_name.map(str::to_owned);
    }

    /// Whether something is to be registered.
    pub(super) fn is_wanted(&self, kind: Kind, name: &str) -> bool {
        let slots = self.slots.lock();
        let slot = slots.get(&(kind, name.to_owned()));
        slot.is_some_and(|slot| slot.wanted.lock().is_some())
    }

    /// Tells the Master what it must know of one name, even if it was told (`again`). The Master's answer, if
    /// anything was registered.
    pub(super) async fn sync(
        &self,
        kind: Kind,
        name: &str,
        again: bool,
    ) -> Result<Option<Value>, BusError> {
        let key = (kind, name.to_owned());
        let Some(slot) = self.slots.lock().get(&key).cloned() else {
            return Ok(None);
        };
        let mut told = slot.told.lock().await;
        let wanted = slot.wanted.lock().clone();
        match wanted {
            Some(wanted) if again || told.as_ref() != Some(&wanted) => {
                let answer = self.register(kind, name, &wanted).await?;
                *told = Some(wanted);
                Ok(Some(answer))
            }
            Some(_) => Ok(None),
            None => {
                if told.take().is_some() || again {
                    // If this fails the Master is gone, or the graph's next look will find it.
                    let _ = self.unregister(kind, name).await;
                }
                drop(told);
                self.forget(&key, slot);
                Ok(None)
            }
        }
    }

    /// Removes a slot that nobody wants or works on.
    fn forget(&self, key: &Key, slot: Arc<Slot>) {
        let mut slots = self.slots.lock();
        let unused = Arc::strong_count(&slot) == 2 && slot.wanted.lock().is_none();
        if unused {
            slots.remove(key);
            if key.0 == Kind::Service {
                self.contests.lock().remove(&key.1);
            }
        }
    }

    async fn register(&self, kind: Kind, name: &str, type_name: &str) -> Result<Value, BusError> {
        let (method, detail) = match kind {
            Kind::Publisher => ("registerPublisher", type_name),
            Kind::Subscriber => ("registerSubscriber", type_name),
            Kind::Service => ("registerService", self.service_uri.as_str()),
        };
        let args = vec![name.into(), detail.into(), self.slave_uri.as_str().into()];
        self.master.call(method, args).await
    }

    async fn unregister(&self, kind: Kind, name: &str) -> Result<Value, BusError> {
        let (method, uri) = match kind {
            Kind::Publisher => ("unregisterPublisher", &self.slave_uri),
            Kind::Subscriber => ("unregisterSubscriber", &self.slave_uri),
            Kind::Service => ("unregisterService", &self.service_uri),
        };
        let args = vec![name.into(), uri.as_str().into()];
        self.master.call(method, args).await
    }

    /// Compares with what the Master shows of node `node`: what it lacks and what it has too much.
    pub(super) fn differences(&self, node: &str, graph: &Graph) -> Vec<(Kind, String)> {
        let ours = graph
            .nodes
            .get(node)
            .is_none_or(|uri| *uri == self.slave_uri);
        let has = |kind: Kind, name: &str| {
            let topic = graph.topics.get(name);
            let among = |nodes: &[String]| nodes.iter().any(|other| other == node);
            match kind {
                Kind::Publisher => topic.is_some_and(|topic| among(&topic.publishers)),
                Kind::Subscriber => topic.is_some_and(|topic| among(&topic.subscribers)),
                Kind::Service => graph.services.get(name).is_some_and(|other| other == node),
            }
        };
        let slots = self.slots.lock();
        let mut wrong: Vec<Key> = slots
            .iter()
            .filter(|(_, slot)| {
                // Not those that are being told just now.
                slot.told.try_lock().is_ok_and(|told| told.is_some())
                    && slot.wanted.lock().is_some()
            })
            .filter(|((kind, name), _)| !ours || !has(*kind, name))
            .filter(|((kind, name), _)| match graph.services.get(name) {
                Some(other) if *kind == Kind::Service && other != node => {
                    self.takes_back(name, other)
                }
                _ => true,
            })
            .map(|(key, _)| key.clone())
            .collect();
        if ours {
            let topics = graph
                .topics
                .keys()
                .flat_map(|name| [(Kind::Publisher, name), (Kind::Subscriber, name)]);
            let services = graph.services.keys().map(|name| (Kind::Service, name));
            let surplus = topics
                .chain(services)
                .filter(|(kind, name)| has(*kind, name))
                .map(|(kind, name)| (kind, name.clone()))
                .filter(|key| !slots.contains_key(key));
            wrong.extend(surplus);
        }
        wrong
    }

    /// Whether a service that `other` has registered is to be registered again now. Two nodes that did so each time they see
    /// the other's registration would do nothing else.
    fn takes_back(&self, name: &str, other: &str) -> bool {
        let now = Instant::now();
        let mut contests = self.contests.lock();
        let Some(contest) = contests.get_mut(name) else {
            tracing::warn!(
                service = name,
                "{other} serves it, too, and calls go to whoever registered last; it is registered again now and then"
            );
            let pause = PAUSES.0;
            let until = now + pause;
            contests.insert(name.to_owned(), Contest { until, pause });
            return true;
        };
        if now < contest.until {
            return false;
        }
        contest.pause = (contest.pause * 2).min(PAUSES.1);
        contest.until = now + contest.pause;
        true
    }

    /// Takes back a registration that the Master shows and nobody here wants.
    pub(super) async fn withdraw_surplus(&self, kind: Kind, name: &str) {
        self.slots
            .lock()
            .entry((kind, name.to_owned()))
            .or_default();
        let _ = self.sync(kind, name, true).await;
    }

    /// Takes everything back.
    pub(super) async fn withdraw_all(&self) {
        let keys: Vec<Key> = {
            let slots = self.slots.lock();
            for slot in slots.values() {
                *slot.wanted.lock() = None;
            }
            slots.keys().cloned().collect()
        };
        for (kind, name) in keys {
            let _ = self.sync(kind, &name, false).await;
        }
    }
}
