//! Calls from this node to the Master, and conversion of XML-RPC errors to bus errors.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use parking_lot::Mutex;
use ros_bus::net::Sockets;
use ros_bus::{BusError, FailureReason};
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::{Instant, timeout_at};

use crate::reply::ApiReply;
use crate::xmlrpc::{self, Value, XmlRpcClient};

/// Time for the Master to answer anything but a long poll.
const ANSWER: Duration = Duration::from_secs(10);
/// Maximum number of concurrent calls, long polls excluded. Each uses a connection of the Master, which has a limit;
/// more calls would only wait there while their time runs.
pub(super) const AT_A_TIME: usize = 32;

/// Client of the Master.
pub(super) struct MasterClient {
    client: XmlRpcClient,
    uri: String,
    node: String,
    turns: CallLimiter,
}

/// Limits concurrent calls: a node that registers a thousand topics at once waits here.
pub(super) struct CallLimiter {
    free: Semaphore,
    /// Time at which the Master last answered a call.
    answered: Mutex<Instant>,
}

impl MasterClient {
    pub(super) fn new(
        sockets: Arc<dyn Sockets>,
        address: SocketAddr,
        node: &str,
        budget: &Budget,
    ) -> Result<Self, BusError> {
        let uri = format!("http://{address}/");
        let client = XmlRpcClient::new(sockets, &uri).map_err(to_bus_error)?.with_budget(budget);
        Ok(Self { client, uri, node: node.to_owned(), turns: CallLimiter::new() })
    }

    /// Returns the Master's address.
    pub(super) fn uri(&self) -> &str {
        &self.uri
    }

    /// Calls a method and returns its value; any answer but success is an error.
    pub(super) async fn call(&self, method: &str, args: Vec<Value>) -> Result<Value, BusError> {
        let answer = self.ask(method, args).await?;
        answer.map_err(|reason| BusError::Master { call: method.to_owned(), reason: reason.into_string() })
    }

    /// Calls a method and returns its value, or the message with which the Master declined.
    pub(super) async fn ask(&self, method: &str, args: Vec<Value>) -> Result<Result<Value, FailureReason>, BusError> {
        self.ask_in_name_of(&self.node, method, args).await
    }

    /// Calls a method like [`ask`](Self::ask), in the name of another node or namespace.
    pub(super) async fn ask_in_name_of(
        &self,
        caller: &str,
        method: &str,
        args: Vec<Value>,
    ) -> Result<Result<Value, FailureReason>, BusError> {
        let Some(_turn) = self.turns.acquire().await else {
            return Err(BusError::Timeout { what: format!("{method} of {}", self.uri), after: ANSWER });
        };
        let answer = self.call_raw(caller, method, args, ANSWER).await;
        let reply = answer.map_err(to_bus_error)?;
        self.turns.record_answer();
        Ok(if reply.code == 1 { Ok(reply.value) } else { Err(FailureReason::new(reply.message)) })
    }

    /// Calls a method with its own time limit; returns XML-RPC errors as such.
    pub(super) async fn call_raw(
        &self,
        caller: &str,
        method: &str,
        mut args: Vec<Value>,
        time: Duration,
    ) -> Result<ApiReply, xmlrpc::Error> {
        args.insert(0, caller.into());
        let answer = self.client.call(method, &args, time).await?;
        ApiReply::from_value(answer).ok_or_else(|| xmlrpc::Error::Http {
            peer: "the ROS Master".to_owned(),
            reason: format!("its answer to {method} is not [code, message, value]"),
        })
    }
}

impl CallLimiter {
    pub(super) fn new() -> Self {
        Self { free: Semaphore::new(AT_A_TIME), answered: Mutex::new(Instant::now()) }
    }

    pub(super) fn record_answer(&self) {
        *self.answered.lock() = Instant::now();
    }

    /// Waits for a permit for as long as other calls are answered; returns `None` if none was answered for [`ANSWER`].
    pub(super) async fn acquire(&self) -> Option<SemaphorePermit<'_>> {
        let mut since = Instant::now();
        loop {
            if let Ok(turn) = timeout_at(since + ANSWER, self.free.acquire()).await {
                return turn.ok();
            }
            let answered = *self.answered.lock();
            if answered <= since {
                return None;
            }
            since = answered;
        }
    }
}

/// Converts an XML-RPC error to a bus error.
pub(super) fn to_bus_error(error: xmlrpc::Error) -> BusError {
    match error {
        xmlrpc::Error::Io { peer, source } => BusError::Io { what: peer, source },
        xmlrpc::Error::Timeout { peer, method, after } => {
            BusError::Timeout { what: format!("{method} of {peer}"), after }
        }
        xmlrpc::Error::Fault { method, fault, .. } => BusError::Master { call: method, reason: fault.text },
        xmlrpc::Error::Http { peer, reason } => BusError::Protocol { what: peer, reason },
        xmlrpc::Error::Malformed { .. } | xmlrpc::Error::BadUri(_) => {
            BusError::Protocol { what: "XML-RPC peer".to_owned(), reason: error.to_string() }
        }
    }
}
