//! Services that nodes look for and nobody serves: lent with default answers, whatever their type.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Digest, Lender, Lent, ServiceHandler, ServiceType};
use ros::codec::Time;
use ros::schema::{Registry, ServiceDef};
use tokio::sync::watch;

use super::plausible;

/// Answers every service that is looked for, and remembers which were.
pub(super) struct AnyService {
    by_digest: Arc<BTreeMap<Digest, Arc<ServiceDef>>>,
    asked: Mutex<BTreeMap<String, BTreeSet<String>>>,
    own_name: String,
    ending: watch::Sender<bool>,
}

impl AnyService {
    /// Knows the service types of the image; `own_name` is the looking node, whose questions do not count.
    pub(super) fn new(registry: &Registry, own_name: &str) -> Arc<Self> {
        let mut by_digest = BTreeMap::new();
        for key in registry.keys() {
            if let Some((package, name)) = key.split_once("/srv/")
                && let Ok(service) = registry.service(&format!("{package}/{name}"))
            {
                by_digest
                    .entry(Digest::from(&service.md5))
                    .or_insert(service);
            }
        }
        Arc::new(Self {
            by_digest: Arc::new(by_digest),
            asked: Mutex::default(),
            own_name: own_name.to_owned(),
            ending: watch::channel(false).0,
        })
    }

    /// What answers the service of this name and type in the place of its server, and the type as it is defined; none of
    /// a type that the image does not define.
    pub(super) fn serves(
        &self,
        registry: &Registry,
        service: &str,
        type_name: &str,
        nodes: &[String],
    ) -> Option<(ServiceType, Arc<dyn ServiceHandler>)> {
        let found = registry.service(type_name).ok()?;
        let nodes = nodes.iter().filter(|node| **node != self.own_name);
        let mut asked = self.asked.lock();
        asked
            .entry(service.to_owned())
            .or_default()
            .extend(nodes.cloned());
        let of = ServiceType::of(&found);
        let answers = Answers {
            by_digest: self.by_digest.clone(),
            service: Some(found),
        };
        Some((of, Arc::new(answers)))
    }

    /// Services that were looked for, with the nodes that did.
    pub(super) fn asked(&self) -> BTreeMap<String, BTreeSet<String>> {
        self.asked.lock().clone()
    }

    /// Takes everything back.
    pub(super) fn end(&self) {
        self.ending.send_replace(true);
    }
}

#[async_trait]
impl Lender for AnyService {
    async fn find(&self, service: &str, node: &str) -> Option<Lent> {
        if node == self.own_name || *self.ending.borrow() {
            return None;
        }
        let mut asked = self.asked.lock();
        asked
            .entry(service.to_owned())
            .or_default()
            .insert(node.to_owned());
        Some(Lent {
            service_type: ServiceType::new("*", "*"),
            handler: Arc::new(Answers {
                by_digest: self.by_digest.clone(),
                service: None,
            }),
            gone: self.ending.subscribe(),
        })
    }
}

/// Answers calls of one type, or of none yet.
struct Answers {
    by_digest: Arc<BTreeMap<Digest, Arc<ServiceDef>>>,
    service: Option<Arc<ServiceDef>>,
}

#[async_trait]
impl ServiceHandler for Answers {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let unknown = || "the image holds no definition of this service".to_owned();
        let service = self.service.as_ref().ok_or_else(unknown)?;
        plausible::message(&service.response, Time::now()).map_err(|error| error.to_string())
    }

    fn for_type(&self, digest: &Digest) -> Option<Arc<dyn ServiceHandler>> {
        let service = Some(self.by_digest.get(digest)?.clone());
        Some(Arc::new(Answers {
            by_digest: self.by_digest.clone(),
            service,
        }))
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
        let registry = Registry::of_definitions(RosVersion::Two, &definitions).expect("valid");
        let any = AnyService::new(&registry, "/looker");
        let nodes = ["/node".to_owned(), "/looker".to_owned()];
        let served = any.serves(&registry, "/do", "lab/srv/Do", &nodes);
        let (of, handler) = served.expect("defined");
        assert_eq!(of.name, "lab/srv/Do");
        let answer = handler.call(Bytes::new(), "/node").await.expect("answered");
        // The header of CDR, false, and an empty text with its length.
        assert_eq!(answer[..], [0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0]);
        assert_eq!(any.asked()["/do"], ["/node".to_owned()].into());
        assert!(
            any.serves(&registry, "/x", "lab/srv/None", &nodes)
                .is_none()
        );
    }

    #[tokio::test]
    async fn a_caller_is_answered_as_its_type_asks() {
        let text = "---\nint64 sum\nstring words\n".to_owned();
        let definitions = [("lab/srv/Add".to_owned(), text)].into();
        let registry = Registry::from_definitions(&definitions).expect("valid");
        let add = registry.service("lab/Add").expect("defined");
        let any = AnyService::new(&registry, "/looker");
        assert!(
            any.find("/add", "/looker").await.is_none(),
            "its own questions"
        );
        let lent = any.find("/add", "/node").await.expect("lent");
        let handler = lent
            .handler
            .for_type(&Digest::from(&add.md5))
            .expect("the type is known");
        let answer = handler.call(Bytes::new(), "/node").await.expect("answered");
        assert_eq!(answer.len(), 12);
        assert!(
            lent.handler.call(Bytes::new(), "/node").await.is_err(),
            "of no type"
        );
        assert!(any.asked()["/add"].contains("/node"));
        any.end();
        assert!(any.find("/add", "/node").await.is_none());
    }
}
