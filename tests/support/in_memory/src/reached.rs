//! The opener, and what it gives. Sessions and links are held until they are closed; no message passes.

use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bridge::{Metrics, SessionEnd, SessionOptions, Waiting};
use futures_util::future::BoxFuture;
use link::session::Lost;
use package::interface::Interface;
use parking_lot::Mutex;
use reach::links::LinkStatus;
use reach::{
    Error, Flow, Look, Looked, Material, Observer, Opener, Pace, Reach, ReachOptions, Recorded,
    Replay, Stream, Tenant,
};
use ros::bus::{Bus, Graph, RosVersion};
use ros::sizes::Seen;
use servant::engine::Servant;
use tokio::sync::watch;

use crate::engine::MemoryEngine;
use crate::servants::MemoryServant;

struct MemoryReach {
    servant: Arc<MemoryServant>,
    metrics: Metrics,
    tenant: Mutex<Option<Weak<dyn Tenant>>>,
    closed: watch::Sender<Option<String>>,
}

#[async_trait]
impl Opener for MemoryEngine {
    async fn open(
        &self,
        servant: &Arc<dyn Servant>,
        recorded: BoxFuture<'_, Recorded>,
        _options: ReachOptions,
        _observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error> {
        recorded.await;
        let id = servant.id();
        let servant = self.servant(id);
        Ok(Arc::new(MemoryReach {
            servant: servant.ok_or_else(|| Error::Elsewhere(id.to_owned()))?,
            metrics: Metrics::default(),
            tenant: Mutex::default(),
            closed: watch::Sender::default(),
        }))
    }

    async fn look(
        &self,
        servant: &Arc<dyn Servant>,
        _ros: RosVersion,
        _name: &str,
        _egress: &[String],
    ) -> Result<Look, Error> {
        Err(Error::Elsewhere(servant.id().to_owned()))
    }

    fn processes(&self, _servant: &str) -> Vec<i32> {
        Vec::new()
    }
}

impl MemoryReach {
    async fn end(&self) -> String {
        let mut closed = self.closed.subscribe();
        let reason = closed.wait_for(Option::is_some).await;
        reason
            .ok()
            .and_then(|reason| reason.clone())
            .unwrap_or_default()
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

    async fn serve_rosbridge(
        &self,
        client: Waiting<Stream>,
        _options: SessionOptions,
    ) -> SessionEnd {
        let reason = self.end().await;
        client.refuse(1012, &reason).await;
        SessionEnd::Closed { code: 1012, reason }
    }

    async fn serve_inside(&self, client: Waiting<Stream>, _options: SessionOptions) -> SessionEnd {
        let reason = self.end().await;
        client.refuse(1012, &reason).await;
        SessionEnd::Closed { code: 1012, reason }
    }

    async fn look_inside(&self) -> Result<Looked, (u16, String)> {
        Err((1011, "nothing passes here".to_owned()))
    }

    async fn serve_link(&self, _stream: Stream, _read_ahead: &[u8]) -> Lost {
        let reason = self.end().await;
        Lost::Closed { code: 1012, reason }
    }

    fn links(&self) -> Vec<LinkStatus> {
        Vec::new()
    }

    fn flows(&self) -> Vec<Flow> {
        let (inputs, outputs) = *self.servant.flow.lock();
        let node = String::new();
        vec![Flow {
            node,
            inputs,
            outputs,
        }]
    }

    fn report(&self, _flow: &str, what: &str) {
        self.servant.reported.lock().push(what.to_owned());
    }

    fn inputs(&self) -> Vec<(String, Seen)> {
        self.servant.inputs.seen()
    }

    fn metrics(&self) -> &Metrics {
        &self.metrics
    }

    async fn replay(
        &self,
        service: &str,
        _interface: &Interface,
        _material: &Material,
        _pace: &Pace,
    ) -> Result<Replay, Error> {
        Err(Error::Trial(format!("{service} answers nothing")))
    }

    fn bind(&self, tenant: Weak<dyn Tenant>) {
        *self.tenant.lock() = Some(tenant);
    }

    fn close_sessions(&self, reason: &str) {
        self.closed.send_replace(Some(reason.to_owned()));
    }

    fn close(&self, reason: &str) {
        self.closed.send_replace(Some(reason.to_owned()));
    }
}
