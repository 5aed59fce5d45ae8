//! Reconciles what this node wants registered with what it believes the Master has, one call at a time per name, so
//! that unregistering and registering again cannot overtake each other.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use ros_bus::{BusError, Graph};

use super::master_client::MasterClient;
use crate::xmlrpc::Value;

/// Kind of a registration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Kind {
    Publisher,
    Subscriber,
    Service,
}

type Key = (Kind, String);

/// Initial and maximum pause before a service that another node has registered too is registered again; the pause
/// doubles each time. Callers reach the node that registered last.
const PAUSES: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(600));

/// Another node registers the same service.
struct RegistrationConflict {
    /// Earliest time to register again.
    until: Instant,
    pause: Duration,
}

#[derive(Default)]
struct Slot {
    /// Type to register with; `None` if it is not to be registered.
    wanted: Mutex<Option<String>>,
    /// Type known to the Master. Locked during the call that changes it.
    told: tokio::sync::Mutex<Option<String>>,
}

/// All registrations of this node.
pub(super) struct Registrar {
    master: Arc<MasterClient>,
    slave_uri: String,
    service_uri: String,
    slots: Mutex<HashMap<Key, Arc<Slot>>>,
    contests: Mutex<HashMap<String, RegistrationConflict>>,
}

impl Registrar {
    pub(super) fn new(master: Arc<MasterClient>, slave_uri: String, service_uri: String) -> Self {
        Self { master, slave_uri, service_uri, slots: Mutex::default(), contests: Mutex::default() }
    }

    pub(super) fn slave_uri(&self) -> &str {
        &self.slave_uri
    }

    pub(super) fn service_uri(&self) -> &str {
        &self.service_uri
    }

    /// Sets the desired registration; [`Registrar::sync`] applies it.
    pub(super) fn set_wanted(&self, kind: Kind, name: &str, type_name: Option<&str>) {
        let mut slots = self.slots.lock();
        let slot = slots.entry((kind, name.to_owned())).or_default();
        *slot.wanted.lock() = type_name.map(str::to_owned);
    }

    /// Returns true if it is to be registered.
    pub(super) fn is_wanted(&self, kind: Kind, name: &str) -> bool {
        let slots = self.slots.lock();
        let slot = slots.get(&(kind, name.to_owned()));
        slot.is_some_and(|slot| slot.wanted.lock().is_some())
    }

    /// Brings the Master's registration of one name up to date; with `again`, even if it is believed to be. Returns the
    /// Master's answer if anything was registered.
    pub(super) async fn sync(&self, kind: Kind, name: &str, again: bool) -> Result<Option<Value>, BusError> {
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
                    // If this fails the Master is gone, or the next look at the graph will notice.
                    let _ = self.unregister(kind, name).await;
                }
                drop(told);
                self.remove_unused(&key, slot);
                Ok(None)
            }
        }
    }

    /// Removes a slot that is neither wanted nor in use.
    fn remove_unused(&self, key: &Key, slot: Arc<Slot>) {
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

    /// Returns the differences to what the Master shows of node `node`: registrations that are missing and those that
    /// are surplus.
    pub(super) fn differences(&self, node: &str, graph: &Graph) -> Vec<(Kind, String)> {
        let ours = graph.nodes.get(node).is_none_or(|uri| *uri == self.slave_uri);
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
                // Not those with a call in progress.
                slot.told.try_lock().is_ok_and(|told| told.is_some()) && slot.wanted.lock().is_some()
            })
            .filter(|((kind, name), _)| !ours || !has(*kind, name))
            .filter(|((kind, name), _)| match graph.services.get(name) {
                Some(other) if *kind == Kind::Service && other != node => self.should_reregister(name, other),
                _ => true,
            })
            .map(|(key, _)| key.clone())
            .collect();
        if ours {
            let topics = graph.topics.keys().flat_map(|name| [(Kind::Publisher, name), (Kind::Subscriber, name)]);
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

    /// Returns true if a service that `other` has registered is to be registered again now. Without a pause two such
    /// nodes would do nothing but overwrite each other's registration.
    fn should_reregister(&self, name: &str, other: &str) -> bool {
        let now = Instant::now();
        let mut contests = self.contests.lock();
        let Some(contest) = contests.get_mut(name) else {
            tracing::warn!(
                service = name,
                "{other} also serves it, and calls go to whichever node registered last; it is registered again \
                    periodically"
            );
            let pause = PAUSES.0;
            let until = now + pause;
            contests.insert(name.to_owned(), RegistrationConflict { until, pause });
            return true;
        };
        if now < contest.until {
            return false;
        }
        contest.pause = (contest.pause * 2).min(PAUSES.1);
        contest.until = now + contest.pause;
        true
    }

    /// Removes a registration that the Master shows and this node does not want.
    pub(super) async fn withdraw_surplus(&self, kind: Kind, name: &str) {
        self.slots.lock().entry((kind, name.to_owned())).or_default();
        let _ = self.sync(kind, name, true).await;
    }

    /// Removes all registrations.
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
