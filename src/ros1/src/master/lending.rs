//! Services that no node has registered here may be lent by another ROS system: one node, the lender, is asked whenever
//! a lookup finds nothing. See docs/adr/025.
//!
//! ```text
//!  node ── lookupService ──▶ Master ─┬─ registered: its address
//!                                    └─ not: cloudroid.lendService ──▶ lender ─┬─ lent: the lender's address
//!                                                                             └─ not, or too late: no provider
//! ```

use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use parking_lot::Mutex;
use ros_bus::net::Sockets;
use tokio::sync::Semaphore;

use crate::reply::ApiReply;
use crate::xmlrpc::{self, Value, XmlRpcClient};

/// `cloudroid.lendServices(caller_id, caller_api)`: registers the node as lender.
pub(crate) const LEND_SERVICES: &str = "cloudroid.lendServices";
/// `cloudroid.lendService(caller_id, service, node)`, called at the lender: returns `[1, "", rosrpc URI]`, or another
/// code if it has no such service.
pub(crate) const LEND_SERVICE: &str = "cloudroid.lendService";

/// Caller id of the Master's calls.
const CALLER: &str = "/master";
/// Maximum time for which a lookup waits for the lender.
const PATIENCE: Duration = Duration::from_millis(1500);
/// Maximum number of lookups waiting for the lender; further ones find nothing.
const AT_A_TIME: usize = 64;

/// The registered lender, if any.
pub(super) struct LenderSlot {
    lender: Mutex<Option<RegisteredLender>>,
    room: Semaphore,
}

#[derive(Clone)]
struct RegisteredLender {
    node: String,
    client: Arc<XmlRpcClient>,
}

impl Default for LenderSlot {
    fn default() -> Self {
        Self { lender: Mutex::default(), room: Semaphore::new(AT_A_TIME) }
    }
}

impl LenderSlot {
    /// Registers the node at `api` as lender; replaces the previous one.
    pub(super) fn set_lender(
        &self,
        node: &str,
        api: &str,
        sockets: Arc<dyn Sockets>,
        budget: &Budget,
    ) -> Result<(), xmlrpc::Error> {
        let client = XmlRpcClient::new(sockets, api)?;
        *self.lender.lock() =
            Some(RegisteredLender { node: node.to_owned(), client: Arc::new(client.with_budget(budget)) });
        Ok(())
    }

    /// Returns the address of a service that no node has registered, on behalf of `node`.
    pub(super) async fn find_service(&self, service: &str, node: &str) -> Option<String> {
        let lender = self.lender.lock().clone()?;
        // The lender cannot lend what it is looking for itself.
        if lender.node == node {
            return None;
        }
        let _room = self.room.try_acquire().ok()?;
        let args: [Value; 3] = [CALLER.into(), service.into(), node.into()];
        match lender.client.call(LEND_SERVICE, &args, PATIENCE).await {
            Ok(answer) => match ApiReply::from_value(answer)? {
                ApiReply { code: 1, value: Value::String(api), .. } if !api.is_empty() => Some(api),
                _ => None,
            },
            Err(error) => {
                tracing::debug!(service, node, %error, "the lender does not answer");
                None
            }
        }
    }
}
