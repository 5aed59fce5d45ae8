//! Services of another system, lent to the nodes of this one. DDS has no service registry that a node would query: a
//! lookup is visible only by its client's endpoints. So the lender is asked where there is a client without a server,
//! and the services that it has are served by this node.
//!
//! ```text
//!   client without server ──▶ asking ──found──▶ served here ──gone──┐
//!                              ▲  └──not found: retry in a second   │
//!                              └────────────────────────────────────┘
//!   no client any more, or a server in the system itself: the loan ends
//! ```
//! Parts of actions are services like others. Their topics are not lent, but published by the component that lends.
//!
//! Services of this node are recognized by a label in the user data of their endpoints, after the type hash:
//! `typehash=RIHS01_…;cloudroid=LABEL;`. rmw picks out the keys that it knows.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use ros_bus::{BusError, Lender, Lending, LentService, ServiceProvider, ServiceType};
use rtps::{EndpointData, TopicDescription};
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use super::bus::Ros2Bus;
use super::calls::GRACE;
use super::names::{self, RosTopicRole};
use super::seen::DiscoverySnapshot;
use super::state::{Loans, Ros2BusState};
use super::{node_ends, services};

/// Pause before a service that was not found is requested again, for as long as a client looks for it.
const AGAIN: Duration = Duration::from_secs(1);
/// Maximum number of services lent or requested at a time: a node can have any number of clients.
const MOST: usize = 1000;
/// Key of the label in the user data.
const LABEL: &str = "cloudroid";

impl Loans {
    /// Adds the label, if any, to the request topic of a service.
    pub(super) fn add_label(&self, request: TopicDescription) -> TopicDescription {
        let Some(label) = self.label.get() else {
            return request;
        };
        let told = format!("{LABEL}={};", escape(label));
        let user_data = [&request.user_data[..], told.as_bytes()].concat();
        TopicDescription { user_data: user_data.into(), ..request }
    }
}

#[async_trait]
impl Lending for Ros2Bus {
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError> {
        self.inner.check_open()?;
        let following = LoanManager { bus: Arc::clone(&self.inner), lender, loans: HashMap::new() };
        let following = self.inner.spawn(following.run());
        if let Some(before) = self.inner.loans.following.lock().replace(following) {
            before.abort();
        }
        Ok(())
    }

    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError> {
        let bus = &self.inner;
        bus.check_name(service)?;
        if let Some(served) = services::local_service(bus, service) {
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

/// Returns the first server of a service whose node is known.
fn provider(seen: &DiscoverySnapshot, service: &str) -> Option<ServiceProvider> {
    let ends = seen.readers(&names::request_name(service));
    ends.iter().filter(|end| seen.is_named(end.guid)).find_map(|end| {
        Some(ServiceProvider {
            node: seen.node(end.guid).to_string(),
            service_type: node_ends::service_type(seen, end, service, false)?,
            label: parse_label(&end.user_data),
        })
    })
}

/// Tracks the services that nodes look for in vain.
struct LoanManager {
    bus: Arc<Ros2BusState>,
    lender: Arc<dyn Lender>,
    /// By service name; a loan ends when it is dropped.
    loans: HashMap<String, Loan>,
}

struct Loan(AbortHandle);

impl Drop for Loan {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl LoanManager {
    async fn run(mut self) {
        let mut seen = self.bus.seen.subscribe();
        let mut served = self.bus.served.subscribe();
        loop {
            served.mark_unchanged();
            let now = Arc::clone(&seen.borrow_and_update());
            self.update_loans(&now);
            let changed = tokio::select! {
                changed = seen.changed() => changed,
                changed = served.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
        }
    }

    fn update_loans(&mut self, seen: &DiscoverySnapshot) {
        let sought = sought_services(&self.bus, seen);
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
            self.loans.insert(service, Loan(self.bus.spawn(lending.run())));
        }
    }
}

/// A node that looks for a service, and the type it expects.
struct SeekingClient {
    node: Arc<str>,
    of: ServiceType,
}

/// Returns the services that nodes have clients for and that no node serves; lent services do not count as served.
fn sought_services(bus: &Ros2BusState, seen: &DiscoverySnapshot) -> BTreeMap<String, SeekingClient> {
    let mut sought = BTreeMap::new();
    for end in seen.discovered.writers.values() {
        let Some(RosTopicRole::Request(service)) = names::topic_role(&end.topic) else {
            continue;
        };
        let Some(node) = seen.owner(end.guid) else {
            continue;
        };
        // Clients of this node are not included.
        let served = !seen.readers(&end.topic).is_empty();
        if served || services::local_service(bus, &service).is_some_and(|it| !it.lent) {
            continue;
        }
        if let Some(client) = seeking_client(seen, end, &service, node) {
            sought.entry(service).or_insert(client);
        }
    }
    sought
}

fn seeking_client(
    seen: &DiscoverySnapshot,
    end: &EndpointData,
    service: &str,
    node: &Arc<str>,
) -> Option<SeekingClient> {
    let of = node_ends::service_type(seen, end, service, true)?;
    let node = Arc::clone(node);
    Some(SeekingClient { node, of })
}

/// Requests one service from the lender for as long as a client looks for it, and serves it while it is available.
struct Borrower {
    bus: Arc<Ros2BusState>,
    lender: Arc<dyn Lender>,
    service: String,
    client: SeekingClient,
}

impl Borrower {
    async fn run(self) {
        let mut refused = None;
        loop {
            let found = self.lender.find_service(&self.service, &self.client.node).await;
            // A service that has just gone counts as not found; otherwise it would be requested without a pause.
            if let Some(lent) = found.filter(|lent| !*lent.gone.borrow()) {
                if self.serve_until_gone(lent, &mut refused).await {
                    continue;
                }
            }
            sleep(AGAIN).await;
        }
    }

    /// Serves the service until it is gone; returns false if it cannot be served.
    async fn serve_until_gone(&self, lent: LentService, refused: &mut Option<ServiceType>) -> bool {
        let LentService { service_type: of, handler, mut gone } = lent;
        let wanted = &self.client.of;
        if of.name != wanted.name || !of.is_compatible_with(wanted) {
            // The client would take it for a server that never answers.
            if refused.as_ref() != Some(&of) {
                tracing::warn!(
                    service = self.service,
                    node = &*self.client.node,
                    "a service of the robot is not lent: it is {} {} there, and {} {} for the node that looks for \
                     it; both need the same \
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
                // If the sender is gone, the service is no longer available either.
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

/// Escapes a label: letters, digits and a few signs are kept; the others become `%` and two hexadecimal digits.
fn escape(label: &str) -> String {
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

fn unescape(text: &str) -> Option<String> {
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

fn parse_label(user_data: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(user_data).ok()?;
    let mut pairs = text.split(';').filter_map(|pair| pair.split_once('='));
    pairs.find(|(key, _)| *key == LABEL).and_then(|(_, label)| unescape(label))
}

#[cfg(test)]
mod tests {
    use ros_bus::Digest;

    use super::super::type_hash;
    use super::*;

    #[test]
    fn a_label_stands_beside_the_hash_of_the_type() {
        let hash = Digest::from(format!("RIHS01_{}", "0a".repeat(32)));
        let topic = |digest: &Digest| TopicDescription {
            name: "rq/setRequest".to_owned(),
            type_name: "std_srvs::srv::dds_::SetBool_Request_".to_owned(),
            user_data: type_hash::user_data(digest),
        };
        let loans = Loans::default();
        assert_eq!(parse_label(&loans.add_label(topic(&hash)).user_data), None);
        let label = "maps=1; for 100% größere rover";
        loans.label.set(label.to_owned()).expect("the first one");
        for digest in [hash, Digest::any()] {
            let told = loans.add_label(topic(&digest)).user_data;
            assert_eq!(parse_label(&told).as_deref(), Some(label));
            assert_eq!(type_hash::message_hash(&told), digest);
            let ends = told.iter().filter(|byte| **byte == b';').count();
            assert_eq!(ends, 1 + usize::from(!digest.is_any()));
        }
        for nonsense in [&b"cloudroid=%f"[..], b"cloudroid=%zz;", b"\xff"] {
            assert_eq!(parse_label(nonsense), None);
        }
    }
}
