//! Services that nobody has registered here may be had from another ROS system: one node, the lender, is asked
//! whenever a lookup finds nothing. See docs/adr/025.
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
use tokio::sync::Semaphore;

use crate::net::Sockets;
use crate::ros1::reply::Reply;
use crate::ros1::xmlrpc::{Client, Value};

/// `cloudroid.lendServices(caller_id, caller_api)`: this node is the lender from now on.
pub(crate) const LEND_SERVICES: &str = "cloudroid.lendServices";
/// `cloudroid.lendService(caller_id, service, node)`, called at the lender: `[1, "", rosrpc URI]`, or a code that is
/// not 1 where it has no such service.
pub(crate) const LEND_SERVICE: &str = "cloudroid.lendService";

/// How the Master signs its calls.
const CALLER: &str = "/master";
/// A lookup waits no longer for the lender.
const PATIENCE: Duration = Duration::from_millis(1500);
/// Lookups that wait at a time; others find nothing.
const AT_A_TIME: usize = 64;

/// Who lends.
pub(super) struct Lending {
    lender: Mutex<Option<Lender>>,
    room: Semaphore,
}

#[derive(Clone)]
struct Lender {
    node: String,
    client: Arc<Client>,
}

impl Default for Lending {
    fn default() -> Self {
        Self {
            lender: Mutex::default(),
            room: Semaphore::new(AT_A_TIME),
        }
    }
}

impl Lending {
    /// The node at `api` takes the place of whoever lent before.
    pub(super) fn begin(
        &self,
        node: &str,
        api: &str,
        sockets: Arc<dyn Sockets>,
        budget: &Budget,
    ) -> Result<(), String> {
        let client = Client::new(sockets, api).map_err(|error| error.to_string())?;
        *self.lender.lock() = Some(Lender {
            node: node.to_owned(),
            client: Arc::new(client.within(budget)),
        });
        Ok(())
    }

    /// Where `node` finds a service that nobody has registered.
    pub(super) async fn find(&self, service: &str, node: &str) -> Option<String> {
        let lender = self.lender.lock().clone()?;
        // What the lender looks for itself it cannot lend.
        if lender.node == node {
            return None;
        }
        let _room = self.room.try_acquire().ok()?;
        let args: [Value; 3] = [CALLER.into(), service.into(), node.into()];
        match lender.client.call(LEND_SERVICE, &args, PATIENCE).await {
            Ok(answer) => match Reply::from_value(answer)? {
                Reply {
                    code: 1,
                    value: Value::String(api),
                    ..
                } if !api.is_empty() => Some(api),
                _ => None,
            },
            Err(error) => {
                tracing::debug!(service, node, %error, "the lender does not answer");
                None
            }
        }
    }
}
