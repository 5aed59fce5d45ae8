//! Stand-ins for services that nodes look up and nobody provides: default answers for any type.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Digest, FailureReason, Lender, LentService, ServiceHandler, ServiceType};
use ros::codec::Time;
use ros::schema::{Registry, ServiceDef};
use tokio::sync::watch;

use super::plausible;

/// Answers all services that are looked up, and records them.
pub(super) struct AnyServiceLender {
    by_digest: Arc<BTreeMap<Digest, Arc<ServiceDef>>>,
    asked: Mutex<BTreeMap<String, BTreeSet<String>>>,
    own_name: String,
    ending: watch::Sender<bool>,
}

impl AnyServiceLender {
    /// Creates a lender for the service types of the image; lookups by `own_name`, the observing node, are ignored.
    pub(super) fn new(registry: &Registry, own_name: &str) -> Arc<Self> {
        let mut by_digest = BTreeMap::new();
        for key in registry.keys() {
            if let Some((package, name)) = key.split_once("/srv/")
                && let Ok(service) = registry.service(&format!("{package}/{name}"))
            {
                by_digest.entry(Digest::from(&service.md5)).or_insert(service);
            }
        }
        Arc::new(Self {
            by_digest: Arc::new(by_digest),
            asked: Mutex::default(),
            own_name: own_name.to_owned(),
            ending: watch::channel(false).0,
        })
    }

    /// Returns a handler for the service of this name and type, and the type as defined; `None` if the image does not
    /// define it.
    pub(super) fn handler_for(
        &self,
        registry: &Registry,
        service: &str,
        type_name: &str,
        nodes: &[String],
    ) -> Option<(ServiceType, Arc<dyn ServiceHandler>)> {
        let found = registry.service(type_name).ok()?;
        let nodes = nodes.iter().filter(|node| **node != self.own_name);
        let mut asked = self.asked.lock();
        asked.entry(service.to_owned()).or_default().extend(nodes.cloned());
        let of = ServiceType::from_service(&found);
        let answers = DefaultAnswers { by_digest: self.by_digest.clone(), service: Some(found) };
        Some((of, Arc::new(answers)))
    }

    /// Returns the services looked up so far, with the nodes that did.
    pub(super) fn requested_services(&self) -> BTreeMap<String, BTreeSet<String>> {
        self.asked.lock().clone()
    }

    /// Revokes all services.
    pub(super) fn revoke(&self) {
        self.ending.send_replace(true);
    }
}

#[async_trait]
impl Lender for AnyServiceLender {
    async fn find_service(&self, service: &str, node: &str) -> Option<LentService> {
        if node == self.own_name || *self.ending.borrow() {
            return None;
        }
        let mut asked = self.asked.lock();
        asked.entry(service.to_owned()).or_default().insert(node.to_owned());
        Some(LentService {
            service_type: ServiceType::new("*", "*"),
            handler: Arc::new(DefaultAnswers { by_digest: self.by_digest.clone(), service: None }),
            gone: self.ending.subscribe(),
        })
    }
}

/// Handler with default answers for one type, or for a type that is not known yet.
struct DefaultAnswers {
    by_digest: Arc<BTreeMap<Digest, Arc<ServiceDef>>>,
    service: Option<Arc<ServiceDef>>,
}

#[async_trait]
impl ServiceHandler for DefaultAnswers {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let unknown = || FailureReason::new("the image has no definition of this service");
        let service = self.service.as_ref().ok_or_else(unknown)?;
        plausible::default_message(&service.response, Time::now())
            .map_err(|error| FailureReason::new(error.to_string()))
    }

    fn for_type(&self, digest: &Digest) -> Option<Arc<dyn ServiceHandler>> {
        let service = Some(self.by_digest.get(digest)?.clone());
        Some(Arc::new(DefaultAnswers { by_digest: self.by_digest.clone(), service }))
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::RosVersion;

    use super::*;

    #[tokio::test]
    async fn a_server_of_ros_2_is_stood_in_for() {
        let text = "---\nbool success\nstring message\n".to_owned();
        let definitions = [("lab/srv/Do".to_owned(), text)].into();
        let registry = Registry::with_definitions(RosVersion::Two, &definitions).expect("valid");
        let any = AnyServiceLender::new(&registry, "/looker");
        let nodes = ["/node".to_owned(), "/looker".to_owned()];
        let served = any.handler_for(&registry, "/do", "lab/srv/Do", &nodes);
        let (of, handler) = served.expect("defined");
        assert_eq!(of.name, "lab/srv/Do");
        let answer = handler.call(Bytes::new(), "/node").await.expect("answered");
        // CDR header, false, and an empty string with its length.
        assert_eq!(answer[..], [0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0]);
        assert_eq!(any.requested_services()["/do"], ["/node".to_owned()].into());
        assert!(any.handler_for(&registry, "/x", "lab/srv/None", &nodes).is_none());
    }

    #[tokio::test]
    async fn a_caller_is_answered_as_its_type_asks() {
        let text = "---\nint64 sum\nstring words\n".to_owned();
        let definitions = [("lab/srv/Add".to_owned(), text)].into();
        let registry = Registry::from_definitions(&definitions).expect("valid");
        let add = registry.service("lab/Add").expect("defined");
        let any = AnyServiceLender::new(&registry, "/looker");
        assert!(any.find_service("/add", "/looker").await.is_none(), "its own questions");
        let lent = any.find_service("/add", "/node").await.expect("lent");
        let handler = lent.handler.for_type(&Digest::from(&add.md5)).expect("the type is known");
        let answer = handler.call(Bytes::new(), "/node").await.expect("answered");
        assert_eq!(answer.len(), 12);
        assert!(lent.handler.call(Bytes::new(), "/node").await.is_err(), "of no type");
        assert!(any.requested_services()["/add"].contains("/node"));
        any.revoke();
        assert!(any.find_service("/add", "/node").await.is_none());
    }
}
