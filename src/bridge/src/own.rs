//! Services that the bridge answers itself, where no node of the servant does: rosapi's and tf's.

use std::sync::Arc;

use access::Grants;
use async_trait::async_trait;
use budget::Budget;
use ros::schema::ServiceDef;

use crate::shared::Shared;
use crate::{rosapi, tf};

/// The client that calls a service of the bridge's own.
pub(crate) struct Caller<'a> {
    /// What it is shown.
    pub grants: &'a Grants,
    /// Where what its arguments become counts.
    pub budget: &'a Budget,
}

/// A service of the bridge's own.
#[async_trait]
pub(crate) trait OwnService: Send + Sync {
    /// Whether anybody may call it: it tells of names and types alone, and of those names alone that its caller may use.
    fn is_filtered(&self) -> bool {
        false
    }

    /// Whether its answer is about what nodes have registered.
    fn shows_graph(&self) -> bool {
        false
    }

    /// Its definition, in the servant's ROS.
    fn definition(&self, shared: &Shared) -> Result<Arc<ServiceDef>, String>;

    /// The response, as JSON, to a request in JSON.
    async fn answer(
        &self,
        shared: &Arc<Shared>,
        args: &[u8],
        caller: &Caller<'_>,
    ) -> Result<Vec<u8>, String>;
}

/// The one of this absolute name.
pub(crate) fn find(name: &str) -> Option<Box<dyn OwnService>> {
    if let Some(service) = rosapi::Service::find(name) {
        return Some(Box::new(service));
    }
    (name == tf::SERVICE).then(|| Box::new(tf::RepublishTfs) as Box<dyn OwnService>)
}
