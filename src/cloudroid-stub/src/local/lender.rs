//! Lends the robot's services to the local original: it has a Master of its own, where the robot's nodes are not
//! registered.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, BusError, Digest, FailureReason, Lender, LentService, ServiceHandler};
use tokio::sync::watch;

/// Time limit for the result of a goal, longer than any goal takes.
const GOAL: Duration = Duration::from_secs(24 * 3600);

/// Lends the services of the robot, except those of the node that the stub stands in for.
pub struct RobotLender {
    bus: Arc<dyn Bus>,
    node: String,
    limit: Duration,
    /// Never set: connections are not closed by this side, and a call without a server fails with the reason.
    open: watch::Sender<bool>,
}

impl RobotLender {
    /// Creates a lender whose calls may take `limit`.
    pub fn new(node: &str, bus: &Arc<dyn Bus>, limit: Duration) -> Self {
        Self { bus: Arc::clone(bus), node: node.to_owned(), limit, open: watch::Sender::new(false) }
    }
}

#[async_trait]
impl Lender for RobotLender {
    async fn find_service(&self, service: &str, _node: &str) -> Option<LentService> {
        let provider = self.bus.lending().ok()?.provider(service).await.ok()?;
        // The node's own services must not be lent to itself.
        if provider.node == self.node {
            return None;
        }
        Some(LentService {
            handler: Arc::new(ForwardedService {
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

/// Forwards calls of one service to the robot.
struct ForwardedService {
    bus: Arc<dyn Bus>,
    service: String,
    limit: Duration,
    digest: Digest,
}

#[async_trait]
impl ServiceHandler for ForwardedService {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let (service, digest) = (&self.service, &self.digest);
        let limit = call_limit_for(service, self.limit);
        let called = self.bus.call_typed(service, digest, request, limit);
        called.await.map_err(describe_failure)
    }
}

/// Returns the time limit for a call of a robot's service. The result of a goal (ROS 2) may take as long as the goal.
pub fn call_limit_for(service: &str, limit: Duration) -> Duration {
    if service.ends_with("/_action/get_result") { limit.max(GOAL) } else { limit }
}

/// Returns the reason for the failed call of a robot's service that its caller is given. Logs it if the service has not
/// answered within its limit.
pub fn describe_failure(error: BusError) -> FailureReason {
    match error {
        BusError::CallFailed { reason, .. } => FailureReason::new(reason),
        BusError::Timeout { .. } => {
            let reason = format!("{error}; where it needs longer, raise call_limit in stub.toml");
            tracing::warn!("{reason}");
            FailureReason::new(reason)
        }
        other => FailureReason::new(other.to_string()),
    }
}
