//! Services of the robot that nodes in the cloud call. They are looked up here when such a node looks for them, and
//! watched from then on.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Weak};

use budget::Permit;
use link::RobotSession;
use link::control::{FromRobot, ServiceChannel};
use link::record::Call;
use ros::bus::{BusError, CallFate, FailureReason, Graph, ServiceProvider};

use super::state::{LentEntry, LentServices, Mirror};
use crate::{local, node_interface};

/// Reason why a service is not lent to the cloud.
#[derive(Debug, thiserror::Error)]
enum NotLendable {
    /// The robot does not have it.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The servant itself serves it; contains the name of the service.
    #[error("{0} is served by this servant itself")]
    OwnServant(String),
    /// Another servant serves it.
    #[error("{service} is served by another stub, {stub}")]
    OtherStub {
        /// Name of the service.
        service: String,
        /// Name of the stub's node.
        stub: String,
    },
}

impl LentServices {
    /// Clears the services at the start of another session, in which the cloud knows none.
    pub fn clear(&self) {
        self.services.lock().clear();
    }

    /// Looks up a service for the cloud and always reports the result. Until then the request counts against the
    /// cloud's budget.
    pub fn look_up(&self, mirror: &Mirror, service: String, held: Permit) {
        let (this, session) = (mirror.this.clone(), mirror.session());
        tokio::spawn(async move {
            let _held = held;
            let Some(mirror) = this.upgrade() else { return };
            let found = async { mirror.bus.lending()?.provider(&service).await }.await;
            let found = found.map_err(NotLendable::from);
            let found = found.and_then(|provider| mirror.check_lendable(&service, provider));
            let provider = match found {
                Ok(provider) => Some(provider),
                Err(error) => {
                    let reason = error.to_string();
                    tracing::debug!(service, reason, "not offered to the cloud");
                    None
                }
            };
            mirror.lent.report(&mirror, &session, service, provider);
        });
    }

    fn report(&self, mirror: &Mirror, session: &Arc<RobotSession>, service: String, provider: Option<ServiceProvider>) {
        let mut services = self.services.lock();
        // Another session has begun, and with it another numbering.
        if !Arc::ptr_eq(session, &mirror.session()) {
            return;
        }
        let of = provider.map(|provider| {
            let digest = &provider.service_type.digest;
            let same = services.get(&service);
            let same = same.filter(|known| known.node == provider.node && known.digest == *digest);
            let channel = same.map(|known| known.channel);
            let channel = channel.unwrap_or_else(|| self.next.fetch_add(1, Ordering::Relaxed));
            let served = ServiceChannel::new(channel, &service, &provider.service_type);
            let known =
                LentEntry { channel: served.channel, node: provider.node, digest: provider.service_type.digest };
            services.insert(service.clone(), known);
            served
        });
        if of.is_none() {
            services.remove(&service);
        }
        session.send_control(&FromRobot::Lent { service, of });
    }

    /// Makes a call that has `arrived` from the cloud; until it is answered, it counts against the cloud's budget.
    pub fn call(&self, mirror: &Mirror, call: Call, held: Permit, arrived: i64) {
        let Call { id, service: channel, request } = call;
        let session = mirror.session();
        let known = {
            let services = self.services.lock();
            let mut services = services.iter();
            services
                .find(|(_, service)| service.channel == channel)
                .map(|(name, service)| (name.clone(), service.digest.clone()))
        };
        let Some((name, digest)) = known else {
            let gone = FailureReason::new("no node on the robot serves this any more");
            return session.answer(id, arrived, Err(gone));
        };
        let this = mirror.this.clone();
        // A call may take long, and its session may be replaced in the meantime.
        let session = Arc::downgrade(&session);
        tokio::spawn(async move {
            let _held = held;
            let Some(mirror) = this.upgrade() else { return };
            let limit = local::call_limit_for(&name, mirror.call_limit);
            let called = mirror.bus.call_typed(&name, &digest, request, limit).await;
            if called.as_ref().is_err_and(is_provider_failure) {
                mirror.lent.withdraw(&mirror, |service| service.channel == channel);
            }
            let called = called.map_err(local::describe_failure);
            // Answered on the session that the call came from: in another one its id means another call.
            if let Some(session) = session.upgrade() {
                session.answer(id, arrived, called);
            }
        });
    }

    /// Reports to the cloud that these services are gone. When a node there looks for one again, the robot does too.
    fn withdraw(&self, mirror: &Mirror, gone: impl Fn(&LentEntry) -> bool) {
        let mut services = self.services.lock();
        services.retain(|name, service| {
            let gone = gone(service);
            if gone {
                mirror.session().send_control(&FromRobot::Lent { service: name.clone(), of: None });
            }
            !gone
        });
    }

    fn withdraw_missing(&self, mirror: &Mirror, graph: &Graph) {
        let services = self.services.lock();
        let elsewhere = |(name, service): &(&String, &LentEntry)| !node_interface::serves(graph, &service.node, name);
        let gone: Vec<u32> = services.iter().filter(elsewhere).map(|(_, service)| service.channel).collect();
        drop(services);
        if !gone.is_empty() {
            self.withdraw(mirror, |service| gone.contains(&service.channel));
        }
    }
}

impl Mirror {
    /// Returns an error for a service of the servant itself, which must not be lent back to it.
    fn check_lendable(&self, service: &str, provider: ServiceProvider) -> Result<ServiceProvider, NotLendable> {
        let own = provider.node == self.bus.node();
        if own || provider.label.as_ref() == Some(&self.label) {
            return Err(NotLendable::OwnServant(service.to_owned()));
        }
        // Stubs of an earlier version send no label.
        if self.siblings.read().contains(&provider.node) {
            return Err(NotLendable::OtherStub { service: service.to_owned(), stub: provider.node });
        }
        Ok(provider)
    }
}

/// Returns whether a call failed because the provider is another one or gone. A provider that answers with a failure is
/// present.
fn is_provider_failure(error: &BusError) -> bool {
    match error {
        BusError::CallFailed { fate, .. } => *fate != CallFate::Answered,
        BusError::Closed => false,
        _ => true,
    }
}

/// Reports services to the cloud that have gone, until the mirror ends.
pub async fn watch_graph(mirror: Weak<Mirror>) {
    let Some(mut graphs) = mirror.upgrade().map(|mirror| mirror.bus.graph()) else {
        return;
    };
    while graphs.changed().await.is_ok() {
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let graph = graphs.borrow_and_update().clone();
        mirror.lent.withdraw_missing(&mirror, &graph);
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
        async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
            Ok(request)
        }
    }

    #[test]
    fn a_service_is_taken_back_when_its_node_does_not_answer_any_more() {
        let failed = |fate| BusError::CallFailed { service: "/map".to_owned(), reason: "no".to_owned(), fate };
        for (error, taken_back) in [
            (failed(CallFate::Answered), false),
            (failed(CallFate::NotTaken), true),
            // The connection to the provider broke during the call.
            (failed(CallFate::Unknown), true),
            (BusError::NoService("/map".to_owned()), true),
            (BusError::Closed, false),
        ] {
            assert_eq!(is_provider_failure(&error), taken_back, "{error:?}");
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
            let can = mirror.check_lendable(&name, provider);
            assert_eq!(can.is_ok(), lent, "{node}: {can:?}");
        }
    }
}
