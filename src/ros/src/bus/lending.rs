//! Services of another ROS system, lent to the nodes of this one.

use std::sync::Arc;

use async_trait::async_trait;
use tokio::sync::watch;

use super::{BusError, ServiceHandler, ServiceType};

/// A service's server, as it told of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceProvider {
    /// The node that serves it.
    pub node: String,
    /// What it serves.
    pub service_type: ServiceType,
    /// How it [labels](Lending::set_label) itself.
    pub label: Option<String>,
}

/// A service of another ROS system.
#[derive(Clone)]
pub struct Lent {
    /// The type of the service.
    pub service_type: ServiceType,
    /// Passes calls on.
    pub handler: Arc<dyn ServiceHandler>,
    /// Becomes true, or loses its sender, when it can be had no more: connections end then, between two calls.
    pub gone: watch::Receiver<bool>,
}

/// Lends nodes the services of another ROS system.
#[async_trait]
pub trait Lender: Send + Sync + 'static {
    /// `node` looks for a service that nobody serves here, and waits for the answer. Later lookups ask again.
    async fn find(&self, service: &str, node: &str) -> Option<Lent>;
}

/// Services that cross from one ROS system to another. ROS 1 offers it with our own Master.
#[async_trait]
pub trait Lending: Send + Sync {
    /// From now on nodes find the lender's services, too. What is served here always comes first, and what is lent
    /// is not registered: it can be looked up, called and waited for. One lender at a time.
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError>;
    /// Asks a server for its type without calling it, and who it is.
    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError>;
    /// Is told to whoever calls services of this node, or asks for their provider, by those that are served from now on:
    /// what belongs together knows itself by it. The first one stays.
    fn set_label(&self, label: &str);
}
