//! Lending: services of another ROS system offered to the nodes of this one.

use std::sync::Arc;

use async_trait::async_trait;
use tokio::sync::watch;

use super::{BusError, ServiceHandler, ServiceType};

/// The server of a service, by its own account.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceProvider {
    /// Node that serves the service.
    pub node: String,
    /// Type of the service.
    pub service_type: ServiceType,
    /// [Label](Lending::set_label) that the server announces.
    pub label: Option<String>,
}

/// A service of another ROS system.
#[derive(Clone)]
pub struct LentService {
    /// Type of the service.
    pub service_type: ServiceType,
    /// Forwards calls.
    pub handler: Arc<dyn ServiceHandler>,
    /// Becomes true, or loses its sender, when the service is no longer available; connections then end between two
    /// calls.
    pub gone: watch::Receiver<bool>,
}

/// Lends services of another ROS system to nodes.
#[async_trait]
pub trait Lender: Send + Sync + 'static {
    /// Looks for a service that no node serves here, on behalf of `node`, which waits for the answer. Later lookups ask
    /// again.
    async fn find_service(&self, service: &str, node: &str) -> Option<LentService>;
}

/// Lending of services from one ROS system to another. ROS 1 offers it only with our own Master.
#[async_trait]
pub trait Lending: Send + Sync {
    /// Lets nodes find the lender's services from now on. Services of this system always take precedence. Lent
    /// services are not registered: they can be looked up, called and waited for, but are not listed. There is one
    /// lender at a time.
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError>;
    /// Asks the server of a service for its type and identity, without calling the service.
    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError>;
    /// Sets the label announced to callers of the services that this node serves from now on, and to nodes that ask for
    /// their provider; it lets our own components recognize each other. Only the first call has an effect.
    fn set_label(&self, label: &str);
}
