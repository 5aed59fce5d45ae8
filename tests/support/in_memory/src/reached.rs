//! The opener and the connection that it opens. Sessions and links are held until they are closed; they carry no
//! messages.

use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bridge::{SessionEnd, SessionOptions, WaitingConnection};
use futures_util::future::BoxFuture;
use package::interface::Interface;
use parking_lot::Mutex;
use reach::links::LinkStatus;
use reach::{
    Error, FlowCounts, InsideView, Material, ObservedBus, Observer, Opener, Reach, ReachOptions, RecordedRevision,
    Replay, ReplayPace, Tenant, UpgradedStream,
};
use ros::bus::{Bus, Graph, RosVersion};
use ros::sizes::SizeSummary;
use servant::engine::ServantHandle;
use tokio::sync::watch;

use crate::engine::MemoryEngine;
use crate::servants::MemoryServant;

struct MemoryReach {
    servant: Arc<MemoryServant>,
    tenant: Mutex<Option<Weak<dyn Tenant>>>,
    closed: watch::Sender<Option<String>>,
}

#[async_trait]
impl Opener for MemoryEngine {
    async fn open(
        &self,
        servant: &Arc<dyn ServantHandle>,
        recorded: BoxFuture<'_, RecordedRevision>,
        _options: ReachOptions,
        _observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error> {
        recorded.await;
        let id = servant.id();
        let servant = self.servant(id);
        Ok(Arc::new(MemoryReach {
            servant: servant.ok_or_else(|| Error::Elsewhere(id.to_owned()))?,
            tenant: Mutex::default(),
            closed: watch::Sender::default(),
        }))
    }

    async fn observe(
        &self,
        servant: &Arc<dyn ServantHandle>,
        _ros: RosVersion,
        _name: &str,
        _egress: &[String],
    ) -> Result<ObservedBus, Error> {
        Err(Error::Elsewhere(servant.id().to_owned()))
    }

    fn process_ids(&self, _servant: &str) -> Vec<i32> {
        Vec::new()
    }
}

impl MemoryReach {
    async fn wait_until_closed(&self) -> String {
        let mut closed = self.closed.subscribe();
        let reason = closed.wait_for(Option::is_some).await;
        reason.ok().and_then(|reason| reason.clone()).unwrap_or_default()
    }
}

#[async_trait]
impl Reach for MemoryReach {
    fn bus(&self) -> Arc<dyn Bus> {
        self.servant.system.join("/cloudroid_bridge")
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.servant.graph.subscribe()
    }

    async fn serve_rosbridge(&self, client: WaitingConnection<UpgradedStream>, _options: SessionOptions) -> SessionEnd {
        let reason = self.wait_until_closed().await;
        client.refuse(1012, &reason).await;
        SessionEnd::Closed { code: 1012, reason }
    }

    async fn serve_inside(&self, client: WaitingConnection<UpgradedStream>, _options: SessionOptions) -> SessionEnd {
        let reason = self.wait_until_closed().await;
        client.refuse(1012, &reason).await;
        SessionEnd::Closed { code: 1012, reason }
    }

    async fn open_inside(&self) -> Result<InsideView, (u16, String)> {
        Err((1011, "nothing passes here".to_owned()))
    }

    async fn serve_link(&self, _stream: UpgradedStream, _read_ahead: &[u8], end: BoxFuture<'_, String>) -> String {
        tokio::select! {
            reason = self.wait_until_closed() => reason,
            reason = end => reason,
        }
    }

    fn links(&self) -> Vec<LinkStatus> {
        Vec::new()
    }

    fn flows(&self) -> Vec<FlowCounts> {
        let (inputs, outputs) = *self.servant.flow.lock();
        let node = String::new();
        vec![FlowCounts { node, inputs, outputs }]
    }

    fn warn_flow(&self, _flow: &str, what: &str) {
        self.servant.reported.lock().push(what.to_owned());
    }

    fn inputs(&self) -> Vec<(String, SizeSummary)> {
        self.servant.inputs.summaries()
    }

    async fn replay(
        &self,
        service: &str,
        _interface: &Interface,
        _material: &Material,
        _pace: &ReplayPace,
    ) -> Result<Replay, Error> {
        Err(Error::Trial(format!("{service} answers nothing")))
    }

    fn bind_tenant(&self, tenant: Weak<dyn Tenant>) {
        *self.tenant.lock() = Some(tenant);
    }

    fn close_sessions(&self, reason: &str) {
        self.closed.send_replace(Some(reason.to_owned()));
    }

    fn close(&self, reason: &str) {
        self.closed.send_replace(Some(reason.to_owned()));
    }
}
