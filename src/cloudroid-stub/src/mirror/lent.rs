//! Services of the robot that nodes in the cloud call. They are looked up here when a node there looks for them, and
//! watched from then on.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Weak};

use budget::Permit;
use link::RobotSession;
use link::control::{FromRobot, Served};
use link::record::Called;
use parking_lot::Mutex;
use ros::bus::{BusError, CallFate, Digest, Graph, ServiceProvider};

use super::Mirror;
use crate::{local, seen};

/// What the cloud was told of.
#[derive(Default)]
pub struct LentServices {
    services: Mutex<HashMap<String, Service>>,
    next: AtomicU32,
}

struct Service {
    channel: u32,
    /// The node that serves it.
    node: String,
    digest: Digest,
}

impl LentServices {
    /// Another session begins: the cloud knows of none.
    pub fn renew(&self) {
        self.services.lock().clear();
    }

    /// The cloud asks for a service. It is told in any case; what it asks counts as its own until then.
    pub fn look_up(&self, mirror: &Mirror, service: String, held: Permit) {
        let (this, session) = (mirror.this.clone(), mirror.session());
        tokio::spawn(async move {
            let _held = held;
            let Some(mirror) = this.upgrade() else { return };
            let found = async { mirror.bus.lending()?.provider(&service).await }.await;
            let found = found.map_err(|error| error.to_string());
            let found = found.and_then(|provider| mirror.can_lend(&service, provider));
            let provider = match found {
                Ok(provider) => Some(provider),
                Err(reason) => {
                    tracing::debug!(service, reason, "not lent to the cloud");
                    None
                }
            };
            mirror.lent.report(&mirror, &session, service, provider);
        });
    }

    fn report(
        &self,
        mirror: &Mirror,
        session: &Arc<RobotSession>,
        service: String,
        provider: Option<ServiceProvider>,
    ) {
        let mut services = self.services.lock();
        // Another session has begun, and with it another count.
        if !Arc::ptr_eq(session, &mirror.session()) {
            return;
        }
        let of = provider.map(|provider| {
            let digest = &provider.service_type.digest;
            let same = services.get(&service);
            let same = same.filter(|known| known.node == provider.node && known.digest == *digest);
            let channel = same.map(|known| known.channel);
            let channel = channel.unwrap_or_else(|| self.next.fetch_add(1, Ordering::Relaxed));
            let served = Served::of(channel, &service, &provider.service_type);
            let known = Service {
                channel: served.channel,
                node: provider.node,
                digest: provider.service_type.digest,
            };
            services.insert(service.clone(), known);
            served
        });
        if of.is_none() {
            services.remove(&service);
        }
        session.report(&FromRobot::Lent { service, of });
    }

    /// Calls on behalf of the cloud; the request counts as the cloud's until it is answered.
    pub fn call(&self, mirror: &Mirror, call: Called) {
        let Called {
            id,
            service: channel,
            request,
            held,
            taken: arrived,
        } = call;
        let session = mirror.session();
        let known = {
            let services = self.services.lock();
            let mut services = services.iter();
            services
                .find(|(_, service)| service.channel == channel)
                .map(|(name, service)| (name.clone(), service.digest.clone()))
        };
        let Some((name, digest)) = known else {
            let gone = "nobody on the robot serves this any more".to_owned();
            return session.answer(id, arrived, Err(gone));
        };
        let this = mirror.this.clone();
        // A service may take long, and its session may be replaced meanwhile.
        let session = Arc::downgrade(&session);
        tokio::spawn(async move {
            let _held = held;
            let Some(mirror) = this.upgrade() else { return };
            let limit = local::limit(&name, mirror.call_limit);
            let called = mirror.bus.call_typed(&name, &digest, request, limit).await;
            if called.as_ref().is_err_and(is_of_the_provider) {
                mirror
                    .lent
                    .withdraw(&mirror, |service| service.channel == channel);
            }
            let called = called.map_err(|error| match error {
                BusError::CallFailed { reason, .. } => reason,
                error @ BusError::Timeout { .. } => local::took_too_long(&error),
                other => other.to_string(),
            });
            // By the session that it came by: the ids of another mean other calls.
            if let Some(session) = session.upgrade() {
                session.answer(id, arrived, called);
            }
        });
    }

    /// Tells the cloud that these are gone. When a node there looks for one again, so does the robot.
    fn withdraw(&self, mirror: &Mirror, gone: impl Fn(&Service) -> bool) {
        let mut services = self.services.lock();
        services.retain(|name, service| {
            let gone = gone(service);
            if gone {
                mirror.session().report(&FromRobot::Lent {
                    service: name.clone(),
                    of: None,
                });
            }
            !gone
        });
    }

    fn compare(&self, mirror: &Mirror, graph: &Graph) {
        let services = self.services.lock();
        let elsewhere =
            |(name, service): &(&String, &Service)| !seen::serves(graph, &service.node, name);
        let gone: Vec<u32> = services
            .iter()
            .filter(elsewhere)
            .map(|(_, service)| service.channel)
            .collect();
        drop(services);
        if !gone.is_empty() {
            self.withdraw(mirror, |service| gone.contains(&service.channel));
        }
    }
}

impl Mirror {
    /// What is served by the servant itself must not come back to it.
    fn can_lend(
        &self,
        service: &str,
        provider: ServiceProvider,
    ) -> Result<ServiceProvider, String> {
        let own = provider.node == self.bus.node();
        if own || provider.label.as_ref() == Some(&self.label) {
            return Err(format!("{service} is served by this very servant"));
        }
        // Stubs of an earlier version do not tell.
        if self.siblings.read().contains(&provider.node) {
            return Err(format!(
                "{service} is served by a sibling, {}",
                provider.node
            ));
        }
        Ok(provider)
    }
}

/// Whether a call failed since who serves is not who did, or is not there: whoever answers that it failed, is.
fn is_of_the_provider(error: &BusError) -> bool {
    match error {
        BusError::CallFailed { fate, .. } => *fate != CallFate::Answered,
        BusError::Closed => false,
        _ => true,
    }
}

/// Tells the cloud when a service that it was told of has gone, until the mirror ends.
pub async fn follow(mirror: Weak<Mirror>) {
    let Some(mut graphs) = mirror.upgrade().map(|mirror| mirror.bus.graph()) else {
        return;
    };
    while graphs.changed().await.is_ok() {
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let graph = graphs.borrow_and_update().clone();
        mirror.lent.compare(&mirror, &graph);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use async_trait::async_trait;
    use bytes::Bytes;
    use link::SessionOptions;
    use ros::bus::{Bus, Lending, ServiceHandler, ServiceType};
    use ros::net::HostSockets;
    use ros::ros1::Ros1Bus;
    use ros::ros1::master::{Master, MasterOptions};

    use super::*;

    struct Echo;

    #[async_trait]
    impl ServiceHandler for Echo {
        async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
            Ok(request)
        }
    }

    #[test]
    fn a_service_is_taken_back_when_its_node_does_not_answer_any_more() {
        let failed = |fate| BusError::CallFailed {
            service: "/map".to_owned(),
            reason: "no".to_owned(),
            fate,
        };
        for (error, taken_back) in [
            (failed(CallFate::Answered), false),
            (failed(CallFate::NotTaken), true),
            // The connection to its node broke in the middle of the call.
            (failed(CallFate::Unknown), true),
            (BusError::NoService("/map".to_owned()), true),
            (BusError::Closed, false),
        ] {
            assert_eq!(is_of_the_provider(&error), taken_back, "{error:?}");
        }
    }

    #[tokio::test]
    async fn what_comes_from_the_servant_is_not_lent_to_it() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let master = Master::new(MasterOptions::default());
        tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
        let join = async |name: &str, label: Option<&str>| {
            let bus = Ros1Bus::connect(Arc::new(HostSockets), address, name).await;
            let bus = bus.unwrap();
            if let Some(label) = label {
                bus.set_label(label);
            }
            bus
        };
        let own = join("/own", Some("maps for rover")).await;
        let options = SessionOptions {
            ping: Duration::from_secs(1),
            silent: Duration::from_secs(2),
            lost: Duration::from_secs(3),
            max_age: None,
        };
        let session = Arc::new(RobotSession::new(options));
        let label = "maps for rover".to_owned();
        let mirror = Mirror::start(own.clone(), label, session, Duration::from_secs(60));
        mirror.siblings.write().insert("/unlabelled".to_owned());
        for (node, label, lent) in [
            ("/sibling", Some("maps for rover"), false),
            ("/unlabelled", None, false),
            ("/of_another_service", Some("arms for rover"), true),
            ("/plain", None, true),
        ] {
            let bus = join(node, label).await;
            let of = ServiceType::new("pkg/Do", "abcd");
            let name = format!("{node}/do");
            let _serving = bus.serve(&name, of, Arc::new(Echo)).await.unwrap();
            let provider = own.provider(&name).await.unwrap();
            assert_eq!(provider.node, node);
            let can = mirror.can_lend(&name, provider);
            assert_eq!(can.is_ok(), lent, "{node}: {can:?}");
        }
    }
}
