//! A group as one robot's [`Reach`].

use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bridge::{Bridge, BridgeOptions, Metrics, SessionEnd, SessionOptions, Waiting};
use link::session::Lost;
use package::interface::Interface;
use ros::bus::{Bus, Graph};
use ros::schema::Registry;
use tokio::sync::watch;

use super::Group;
use crate::links::LinkStatus;
use crate::trial::{self, Material, Pace, Replay};
use crate::{Error, Reach, Stream, Tenant};

/// One robot's place in a group: a bridge of its own, so that its clients share what rosbridge has for clients of one robot,
/// and nothing with another's.
pub struct Seat {
    bus: Arc<dyn Bus>,
    bridge: Arc<Bridge>,
}

impl Seat {
    /// A place for one robot. `registry` holds the definitions of the service's types.
    pub fn new(group: &Arc<Group>, registry: Arc<Registry>, options: BridgeOptions) -> Seat {
        let bus = group.bus(&registry, &options.budget);
        Seat {
            bridge: Bridge::new(Arc::clone(&bus), registry, options),
            bus,
        }
    }
}

#[async_trait]
impl Reach for Seat {
    fn bus(&self) -> Arc<dyn Bus> {
        Arc::clone(&self.bus)
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.bus.graph()
    }

    async fn serve_rosbridge(
        &self,
        client: Waiting<Stream>,
        options: SessionOptions,
    ) -> SessionEnd {
        self.bridge.serve_waiting(client, options).await
    }

    async fn serve_link(&self, stream: Stream, _read_ahead: &[u8]) -> Lost {
        let reason = "robots share this service, and their stubs cannot use it yet: use it by rosbridge, or push it without --shared".to_owned();
        bridge::refuse(stream, 1008, &reason).await;
        Lost::Closed { code: 1008, reason }
    }

    fn links(&self) -> Vec<LinkStatus> {
        Vec::new()
    }

    fn metrics(&self) -> &Metrics {
        self.bridge.metrics()
    }

    async fn replay(
        &self,
        service: &str,
        interface: &Interface,
        material: &Material,
        pace: &Pace,
    ) -> Result<Replay, Error> {
        trial::replay(&self.bus, service, interface, material, pace).await
    }

    fn bind(&self, _tenant: Weak<dyn Tenant>) {}

    fn close_sessions(&self, reason: &str) {
        self.bridge.close(reason);
    }

    fn close(&self, reason: &str) {
        self.bridge.close(reason);
    }
}
