//! Services that the bridge answers itself if no node of the servant does: those of rosapi and tf.

use std::sync::Arc;

use access::Grants;
use async_trait::async_trait;
use budget::Budget;
use ros::schema::ServiceDef;

use crate::shared::BridgeShared;
use crate::{rosapi, tf};

/// The client that calls one of the bridge's own services.
pub(crate) struct Caller<'a> {
    /// Grants that filter the answer.
    pub grants: &'a Grants,
    /// Budget for the parsed arguments.
    pub budget: &'a Budget,
}

/// A service answered by the bridge itself.
#[async_trait]
pub(crate) trait OwnService: Send + Sync {
    /// Returns whether every client may call it: the answer only contains names and types, filtered by the caller's
    /// grants.
    fn is_filtered(&self) -> bool {
        false
    }

    /// Returns whether its answer depends on what nodes have registered.
    fn reads_graph(&self) -> bool {
        false
    }

    /// Returns its definition, in the servant's ROS.
    fn definition(&self, shared: &BridgeShared) -> Result<Arc<ServiceDef>, String>;

    /// Answers a request in JSON with a response in JSON.
    async fn answer(
        &self,
        shared: &Arc<BridgeShared>,
        args: &[u8],
        caller: &Caller<'_>,
    ) -> Result<Vec<u8>, String>;
}

/// Finds the service with this absolute name.
pub(crate) fn find_own_service(name: &str) -> Option<Box<dyn OwnService>> {
    if let Some(service) = rosapi::RosapiService::find(name) {
        return Some(Box::new(service));
    }
    (name == tf::SERVICE).then(|| Box::new(tf::RepublishTfs) as Box<dyn OwnService>)
}
