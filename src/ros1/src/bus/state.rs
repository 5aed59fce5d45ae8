//! State shared by all parts of a bus.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicI32};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use ros_bus::net::Sockets;
use ros_bus::{Graph, Lender, ParamChangeSender, ServiceHandler, ServiceType, WireType};
use tokio::runtime::Handle;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tracing::Span;

use super::master_client::MasterClient;
use super::registrar::Registrar;
use super::topic_in::TopicIn;
use super::topic_out::TopicOut;
use crate::tcpros::{FrameBounds, Header, ServiceConnection};
use crate::xmlrpc::XmlRpcClient;

/// Time for a peer to accept a connection and answer its header.
pub(super) const HANDSHAKE: Duration = Duration::from_secs(10);
/// Time for queued messages and unregistrations when the bus closes.
pub(super) const FAREWELL: Duration = Duration::from_secs(2);

/// State shared by all parts of a bus.
pub(crate) struct Ros1BusState {
    pub(super) sockets: Arc<dyn Sockets>,
    pub(crate) node: String,
    /// Host in our addresses, and the port of our TCPROS server.
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) frames: FrameBounds,
    pub(super) master: Arc<MasterClient>,
    pub(super) registrar: Registrar,
    pub(super) subscriptions: Mutex<HashMap<String, Arc<TopicIn>>>,
    pub(super) publications: Mutex<HashMap<String, Arc<TopicOut>>>,
    /// Notified when something is advertised, and when somebody wants to know what type subscribers request.
    pub(super) publishing: Notify,
    pub(super) services: Mutex<HashMap<String, Arc<ServiceEntry>>>,
    pub(super) label: OnceLock<String>,
    pub(super) lending: Loans,
    pub(super) calls: CallPool,
    pub(super) publisher_clients: PublisherClients,
    pub(crate) graph: watch::Sender<Arc<Graph>>,
    pub(super) shutdown: watch::Sender<Option<String>>,
    /// Watchers of all parameters; those that are gone are removed when something changes.
    pub(super) param_watchers: Mutex<Vec<ParamChangeSender>>,
    pub(super) closed: AtomicBool,
    pub(super) runtime: Handle,
    /// Span of the log in which the bus was joined, for all its tasks.
    pub(super) log_span: Span,
    pub(super) tasks: Mutex<JoinSet<()>>,
    pub(super) next_id: AtomicI32,
}

/// Idle connections, by service.
#[derive(Default)]
pub(super) struct CallPool {
    pub(super) idle: Mutex<HashMap<String, Vec<IdleConnection>>>,
}

/// A connection, and the address of the server's node when it was made, if the graph showed it.
pub(super) struct IdleConnection {
    pub(super) connection: ServiceConnection,
    pub(super) address: Option<String>,
}

/// Clients of publishers that were queried recently.
#[derive(Default)]
pub(super) struct PublisherClients {
    pub(super) clients: Mutex<HashMap<String, (Arc<XmlRpcClient>, Instant)>>,
}

/// The lender and the services lent, by name.
#[derive(Default)]
pub(super) struct Loans {
    pub(super) lender: Mutex<Option<Arc<dyn Lender>>>,
    pub(super) lent: Mutex<HashMap<String, Arc<ServiceEntry>>>,
}

/// One service.
pub(super) struct ServiceEntry {
    pub(super) service_type: ServiceType,
    pub(super) handler: Arc<dyn ServiceHandler>,
    /// True, or without a sender, once the service has ended.
    pub(super) ended: watch::Receiver<bool>,
}

/// Returns the type declared in a TCPROS connection header.
pub(super) fn wire_type_from_header(header: &Header) -> WireType {
    WireType::new(
        header.get("type").unwrap_or("*"),
        header.get("md5sum").unwrap_or("*"),
        header.text("message_definition"),
    )
}
