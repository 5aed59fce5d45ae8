//! Services of another system, lent to the nodes of this one. DDS has nobody whom nodes ask for a service: that one is looked for
//! is seen by its client's ends. So the lender is asked where there is a client without a server, and what it has is served by
//! this node.
//!
//! ```text
//!   a client, no server ──▶ Asking ──there──▶ Served here ──gone──┐
//!                            ▲  └──not there, in a second again   │
//!                            └────────────────────────────────────┘
//!   no client any more, or a server of the system's own: the loan ends
//! ```
//! Parts of actions are services like others. Their topics are not lent, but published by whoever lends.
//!
//! What is served by this node is known to others by a label that stands in what its ends tell of themselves, behind the hash
//! of the type: `typehash=RIHS01_…;cloudroid=LABEL;`. rmw takes out the keys that it knows.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use parking_lot::Mutex;
use rtps::{EndpointData, Topic};
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use super::bus::{Inner, Ros2Bus};
use super::calls::GRACE;
use super::names::{self, Named};
use super::seen::Seen;
use super::{node_ends, services};
use crate::bus::{BusError, Lender, Lending, Lent, ServiceProvider, ServiceType};

/// A service that was not there is asked for again after so long, for as long as it is sought.
const AGAIN: Duration = Duration::from_secs(1);
/// Services that are lent or asked for at a time: a node can have any number of clients.
const MOST: usize = 1000;
/// What a label follows.
const LABEL: &str = "cloudroid";

/// What is lent by a bus, and how its services are labelled.
#[derive(Default)]
pub(super) struct Loans {
    following: Mutex<Option<AbortHandle>>,
    label: OnceLock<String>,
}

impl Loans {
    /// The topic by which a service is asked, with the label if there is one.
    pub(super) fn labelled(&self, request: Topic) -> Topic {
        let Some(label) = self.label.get() else {
            return request;
        };
        let told = format!("{LABEL}={};", escaped(label));
        let user_data = [&request.user_data[..], told.as_bytes()].concat();
        Topic {
            user_data: user_data.into(),
            ..request
        }
    }
}

#[async_trait]
impl Lending for Ros2Bus {
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError> {
        self.inner.check_open()?;
        let following = Following {
            bus: Arc::clone(&self.inner),
            lender,
            loans: HashMap::new(),
        };
        let following = self.inner.spawn(following.run());
        if let Some(before) = self.inner.loans.following.lock().replace(following) {
            before.abort();
        }
        Ok(())
    }

    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError> {
        let bus = &self.inner;
        bus.check_name(service)?;
        if let Some(served) = services::here(bus, service) {
            return Ok(ServiceProvider {
                node: bus.node.clone(),
                service_type: served.of.clone(),
                label: bus.loans.label.get().cloned(),
            });
        }
        let mut seen = bus.seen.subscribe();
        let found = timeout(GRACE, async {
            loop {
                if let Some(found) = provider(&seen.borrow_and_update(), service) {
                    return Ok(found);
                }
                seen.changed().await.map_err(|_| BusError::Closed)?;
            }
        });
        let nobody = |_| Err(BusError::NoService(service.to_owned()));
        found.await.unwrap_or_else(nobody)
    }

    fn set_label(&self, label: &str) {
        let _ = self.inner.loans.label.set(label.to_owned());
    }
}

/// The first server of a service whose node is known.
fn provider(seen: &Seen, service: &str) -> Option<ServiceProvider> {
    let ends = seen.readers(&names::request_name(service));
    ends.iter()
        .filter(|end| seen.is_named(end.guid))
        .find_map(|end| {
            Some(ServiceProvider {
                node: seen.node(end.guid).to_string(),
                service_type: node_ends::service_type(seen, end, service, false)?,
                label: label_of(&end.user_data),
            })
        })
}

/// Looks which services are sought in vain.
struct Following {
    bus: Arc<Inner>,
    lender: Arc<dyn Lender>,
    /// By name; each ends when it is dropped.
    loans: HashMap<String, Loan>,
}

struct Loan(AbortHandle);

impl Drop for Loan {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Following {
    async fn run(mut self) {
        let mut seen = self.bus.seen.subscribe();
        let mut served = self.bus.served.subscribe();
        loop {
            served.mark_unchanged();
            let now = Arc::clone(&seen.borrow_and_update());
            self.look(&now);
            let changed = tokio::select! {
                changed = seen.changed() => changed,
                changed = served.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
        }
    }

    fn look(&mut self, seen: &Seen) {
        let sought = sought(&self.bus, seen);
        self.loans.retain(|service, _| sought.contains_key(service));
        for (service, client) in sought {
            if self.loans.contains_key(&service) {
                continue;
            }
            if self.loans.len() >= MOST {
                return;
            }
            let lending = Borrower {
                bus: Arc::clone(&self.bus),
                lender: Arc::clone(&self.lender),
                service: service.clone(),
                client,
            };
            self.loans
                .insert(service, Loan(self.bus.spawn(lending.run())));
        }
    }
}

/// A node that looks for a service, and what it takes it for.
struct Client {
    node: Arc<str>,
    of: ServiceType,
}

/// Services that nodes have clients of and nobody serves, what is lent not counted.
fn sought(bus: &Inner, seen: &Seen) -> BTreeMap<String, Client> {
    let mut sought = BTreeMap::new();
    for end in seen.discovered.writers.values() {
        let Some(Named::Request(service)) = names::named(&end.topic) else {
            continue;
        };
        let Some(node) = seen.owner(end.guid) else {
            continue;
        };
        // Those of this node are not among them.
        let served = !seen.readers(&end.topic).is_empty();
        if served || services::here(bus, &service).is_some_and(|it| !it.lent) {
            continue;
        }
        if let Some(client) = client(seen, end, &service, node) {
            sought.entry(service).or_insert(client);
        }
    }
    sought
}

fn client(seen: &Seen, end: &EndpointData, service: &str, node: &Arc<str>) -> Option<Client> {
    let of = node_ends::service_type(seen, end, service, true)?;
    let node = Arc::clone(node);
    Some(Client { node, of })
}

/// Asks for one service for as long as it is sought, and serves it while it is there.
struct Borrower {
    bus: Arc<Inner>,
    lender: Arc<dyn Lender>,
    service: String,
    client: Client,
}

impl Borrower {
    async fn run(self) {
        let mut refused = None;
        loop {
            let found = self.lender.find(&self.service, &self.client.node).await;
            // One that is gone already is not there: it is not asked for without a pause.
            if let Some(lent) = found.filter(|lent| !*lent.gone.borrow()) {
                if self.served(lent, &mut refused).await {
                    continue;
                }
            }
            sleep(AGAIN).await;
        }
    }

    /// Serves it until it is gone; false where it cannot be served.
    async fn served(&self, lent: Lent, refused: &mut Option<ServiceType>) -> bool {
        let Lent {
            service_type: of,
            handler,
            mut gone,
        } = lent;
        let wanted = &self.client.of;
        if of.name != wanted.name || !of.agrees(wanted) {
            // Who looks for it would take it for one that never answers.
            if refused.as_ref() != Some(&of) {
                tracing::warn!(
                    service = self.service,
                    node = &*self.client.node,
                    "a service of the robot is not lent: it is {} {} there, and {} {} for the node that looks for it; both need the same \
                     definition",
                    of.name,
                    of.request,
                    wanted.name,
                    wanted.request
                );
                *refused = Some(of);
            }
            return false;
        }
        match services::lend(&self.bus, &self.service, of, handler) {
            Ok(_serving) => {
                // Without its sender it can be had no more, either.
                let _ = gone.wait_for(|gone| *gone).await;
                true
            }
            Err(error) => {
                tracing::debug!(service = self.service, %error, "not lent");
                false
            }
        }
    }
}

/// Letters, digits and a few signs stay; the others are two hexadecimal digits behind `%`.
fn escaped(label: &str) -> String {
    let mut text = String::new();
    for byte in label.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'/' | b':' => {
                text.push(char::from(byte));
            }
            _ => text.push_str(&format!("%{byte:02x}")),
        }
    }
    text
}

fn unescaped(text: &str) -> Option<String> {
    let mut bytes = Vec::new();
    let mut rest = text.as_bytes();
    while let [first, after @ ..] = rest {
        rest = after;
        if *first != b'%' {
            bytes.push(*first);
            continue;
        }
        let (digits, after) = rest.split_at_checked(2)?;
        let digits = std::str::from_utf8(digits).ok()?;
        bytes.push(u8::from_str_radix(digits, 16).ok()?);
        rest = after;
    }
    String::from_utf8(bytes).ok()
}

fn label_of(user_data: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(user_data).ok()?;
    let mut pairs = text.split(';').filter_map(|pair| pair.split_once('='));
    pairs
        .find(|(key, _)| *key == LABEL)
        .and_then(|(_, label)| unescaped(label))
}

#[cfg(test)]
mod tests {
    use super::super::type_hash;
    use super::*;
    use crate::bus::Digest;

    #[test]
    fn a_label_stands_beside_the_hash_of_the_type() {
        let hash = Digest::from(format!("RIHS01_{}", "0a".repeat(32)));
        let topic = |digest: &Digest| Topic {
            name: "rq/setRequest".to_owned(),
            type_name: "std_srvs::srv::dds_::SetBool_Request_".to_owned(),
            user_data: type_hash::user_data(digest),
        };
        let loans = Loans::default();
        assert_eq!(label_of(&loans.labelled(topic(&hash)).user_data), None);
        let label = "maps=1; for 100% größere rover";
        loans.label.set(label.to_owned()).expect("the first one");
        for digest in [hash, Digest::any()] {
            let told = loans.labelled(topic(&digest)).user_data;
            assert_eq!(label_of(&told).as_deref(), Some(label));
            assert_eq!(type_hash::of_message(&told), digest);
            let ends = told.iter().filter(|byte| **byte == b';').count();
            assert_eq!(ends, 1 + usize::from(!digest.is_any()));
        }
        for nonsense in [&b"cloudroid=%f"[..], b"cloudroid=%zz;", b"\xff"] {
            assert_eq!(label_of(nonsense), None);
        }
    }
}
