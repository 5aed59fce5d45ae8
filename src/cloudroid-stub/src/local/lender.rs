//! The robot's services, for the local original: it has a Master of its own, at which the robot's nodes are not
//! registered.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, BusError, Digest, Lender, Lent, ServiceHandler};
use tokio::sync::watch;

/// Longer than any goal is waited for.
const GOAL: Duration = Duration::from_secs(24 * 3600);

/// Lends what is served on the robot, but by the node that is stood in for.
pub struct Robot {
    bus: Arc<dyn Bus>,
    node: String,
    limit: Duration,
    /// Connections are never ended from here: a call that finds nobody fails with the reason.
    open: watch::Sender<bool>,
}

impl Robot {
    /// A service may take `limit`.
    pub fn new(node: &str, bus: &Arc<dyn Bus>, limit: Duration) -> Self {
        Self {
            bus: Arc::clone(bus),
            node: node.to_owned(),
            limit,
            open: watch::Sender::new(false),
        }
    }
}

#[async_trait]
impl Lender for Robot {
    async fn find(&self, service: &str, _node: &str) -> Option<Lent> {
        let provider = self.bus.lending().ok()?.provider(service).await.ok()?;
        // Its own would come back to it.
        if provider.node == self.node {
            return None;
        }
        Some(Lent {
            handler: Arc::new(Passing {
                bus: Arc::clone(&self.bus),
                service: service.to_owned(),
                limit: self.limit,
                digest: provider.service_type.digest.clone(),
            }),
            service_type: provider.service_type,
            gone: self.open.subscribe(),
        })
    }
}

/// Passes calls of one service to the robot.
struct Passing {
    bus: Arc<dyn Bus>,
    service: String,
    limit: Duration,
    digest: Digest,
}

#[async_trait]
impl ServiceHandler for Passing {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let (service, digest) = (&self.service, &self.digest);
        let limit = limit(service, self.limit);
        let called = self.bus.call_typed(service, digest, request, limit);
        called.await.map_err(|error| match error {
            BusError::CallFailed { reason, .. } => reason,
            error @ BusError::Timeout { .. } => took_too_long(&error),
            other => other.to_string(),
        })
    }
}

/// How long a service of the robot may take that has this limit. The result of a goal (ROS 2) takes as long as the goal.
pub fn limit(service: &str, limit: Duration) -> Duration {
    match service.ends_with("/_action/get_result") {
        true => limit.max(GOAL),
        false => limit,
    }
}

/// What is said of a service of the robot that has not answered within its limit, to who called it and in the log.
pub fn took_too_long(error: &BusError) -> String {
    let reason = format!("{error}; where it needs longer, raise call_limit in stub.toml");
    tracing::warn!("{reason}");
    reason
}
