//! Calls from this node to the Master, and the errors of XML-RPC as the bus's.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use parking_lot::Mutex;
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::{Instant, timeout_at};

use crate::bus::BusError;
use crate::net::Sockets;
use crate::ros1::reply::Reply;
use crate::ros1::xmlrpc::{self, Client, Value};

/// For the Master to answer anything but a long poll.
const ANSWER: Duration = Duration::from_secs(10);
/// Calls at a time, but for long polls. Each takes a connection of the Master, which has a limit; more would only wait
/// there, and their time would run.
pub(super) const AT_A_TIME: usize = 32;

/// The Master, as this node calls it.
pub(super) struct MasterClient {
    client: Client,
    uri: String,
    node: String,
    turns: Turns,
}

/// Whose turn it is to call: somebody who registers a thousand topics at once waits here.
pub(super) struct Turns {
    free: Semaphore,
    /// When the Master last answered a call.
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
        let client = Client::new(sockets, &uri)
            .map_err(to_bus_error)?
            .within(budget);
        Ok(Self {
            client,
            uri,
            node: node.to_owned(),
            turns: Turns::new(),
        })
    }

    /// The Master's address.
    pub(super) fn uri(&self) -> &str {
        &self.uri
    }

    /// Calls a method and gives its value; any answer but success is an error.
    pub(super) async fn call(&self, method: &str, args: Vec<Value>) -> Result<Value, BusError> {
        let answer = self.ask(method, args).await?;
        answer.map_err(|reason| BusError::Master {
            call: method.to_owned(),
            reason,
        })
    }

    /// Calls a method and gives its value, or the message with which the Master declined.
    pub(super) async fn ask(
        &self,
        method: &str,
        args: Vec<Value>,
    ) -> Result<Result<Value, String>, BusError> {
        self.ask_as(&self.node, method, args).await
    }

    /// The same in the name of another node or namespace.
    pub(super) async fn ask_as(
        &self,
        caller: &str,
        method: &str,
        args: Vec<Value>,
    ) -> Result<Result<Value, String>, BusError> {
        let Some(_turn) = self.turns.next().await else {
            return Err(BusError::Timeout {
                what: format!("{method} of {}", self.uri),
                after: ANSWER,
            });
        };
        let answer = self.raw(caller, method, args, ANSWER).await;
        let reply = answer.map_err(to_bus_error)?;
        self.turns.was_answered();
        Ok(if reply.code == 1 {
            Ok(reply.value)
        } else {
            Err(reply.message)
        })
    }

    /// The same with a time-out of its own and XML-RPC's errors.
    pub(super) async fn raw(
        &self,
        caller: &str,
        method: &str,
        mut args: Vec<Value>,
        time: Duration,
    ) -> Result<Reply, xmlrpc::Error> {
        args.insert(0, caller.into());
        let answer = self.client.call(method, &args, time).await?;
        Reply::from_value(answer).ok_or_else(|| xmlrpc::Error::Http {
            peer: "the ROS Master".to_owned(),
            reason: format!("its answer to {method} is not [code, message, value]"),
        })
    }
}

impl Turns {
    pub(super) fn new() -> Self {
        Self {
            free: Semaphore::new(AT_A_TIME),
            answered: Mutex::new(Instant::now()),
        }
    }

    pub(super) fn was_answered(&self) {
        *self.answered.lock() = Instant::now();
    }

    /// Waits for the caller's turn, as long as others are answered; `None` when nobody was for [`ANSWER`].
    pub(super) async fn next(&self) -> Option<SemaphorePermit<'_>> {
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

/// XML-RPC's errors as the bus's.
pub(super) fn to_bus_error(error: xmlrpc::Error) -> BusError {
    match error {
        xmlrpc::Error::Io { peer, source } => BusError::Io { what: peer, source },
        xmlrpc::Error::Timeout {
            peer,
            method,
            after,
        } => BusError::Timeout {
            what: format!("{method} of {peer}"),
            after,
        },
        xmlrpc::Error::Fault { method, fault, .. } => BusError::Master {
            call: method,
            reason: fault.text,
        },
        xmlrpc::Error::Http { peer, reason } => BusError::Protocol { what: peer, reason },
        xmlrpc::Error::Malformed { .. } | xmlrpc::Error::BadUri(_) => BusError::Protocol {
            what: "XML-RPC peer".to_owned(),
            reason: error.to_string(),
        },
    }
}
