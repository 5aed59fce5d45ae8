//! Options of an operator, and of each connection.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;
use qos::TopicPair;
use ros::codec::NonFinite;
use rosbridge::{FragmentLimits, StatusLevel};

use crate::ClientGrants;

/// Limits and timeouts of one servant's bridge. The defaults suit a robot on Wi-Fi.
#[derive(Debug, Clone)]
pub struct BridgeOptions {
    /// Maximum length of a WebSocket frame in bytes; longer ones close the connection (1009).
    pub max_frame: usize,
    /// Maximum length of a WebSocket message in bytes, in one frame or several; longer ones close the connection
    /// (1009).
    pub max_message: usize,
    /// Interval between pings; zero: none.
    pub ping_interval: Duration,
    /// Time after which a connection is closed if nothing, not even a pong, was received (1001); zero: never.
    pub idle_timeout: Duration,
    /// Time for the close handshake.
    pub close_timeout: Duration,
    /// Answers and status messages queued for a client that does not read; more close the connection (1008).
    pub control_messages: usize,
    /// Bytes of those.
    pub control_bytes: usize,
    /// Messages queued per topic for a client that reads slowly; beyond this the oldest are dropped.
    pub topic_messages: usize,
    /// Bytes of those. However large they are, two are kept, or as many as the client asked for, up to ten.
    pub topic_bytes: usize,
    /// Bytes queued for one client over all its topics; one message is always kept. Its budget is a bound, too.
    pub session_bytes: usize,
    /// Messages that the bus queues for the bridge, per topic.
    pub bus_queue: usize,
    /// Maximum number of subscriptions of one client.
    pub max_subscriptions: usize,
    /// Maximum number of topics, services and actions that one client advertises, together.
    pub max_advertisements: usize,
    /// Maximum number of service calls and goals of one client in progress at once.
    pub max_calls: usize,
    /// Maximum bytes of their arguments; a single call or goal may have more.
    pub max_call_bytes: usize,
    /// Timeout of a service call that has none of its own.
    pub call_timeout: Duration,
    /// Time that a goal waits for its action server to connect.
    pub action_timeout: Duration,
    /// Time that messages published right after `advertise` wait for the first subscriber to connect.
    pub warm_up: Duration,
    /// Grace period of a disconnected client with a resume token.
    pub resume_grace: Duration,
    /// Limits of messages that arrive in fragments.
    pub fragments: FragmentLimits,
    /// Maximum bytes of a decoded `png`.
    pub max_png: usize,
    /// Encoding of NaN and infinities in JSON.
    pub non_finite: NonFinite,
    /// Maximum bytes of JSON or CBOR for one message from ROS; a longer one is not sent.
    pub max_encoded: usize,
    /// Budget for messages from ROS encoded as JSON and CBOR (above 64 KiB), for as long as they wait for their
    /// clients. A message that does not fit is not sent, and its clients get a status message.
    pub budget: Budget,
    /// Time after which an incomplete WebSocket message closes its connection (1008).
    pub unfinished: Duration,
    /// Observer of clients' requests to the servant: calls of its services, goals, and messages of the input of `pair`.
    pub called: RequestObserver,
    /// Topics of requests to the servant and its answers, if there is such a pair.
    pub pair: Option<TopicPair>,
}

/// Observes the duration of each request of a client to the servant, from the bridge to the servant and back; `None` if
/// it failed.
#[derive(Clone, Default)]
pub struct RequestObserver(Option<Arc<RequestListener>>);

type RequestListener = dyn Fn(Option<Duration>) + Send + Sync;

impl RequestObserver {
    /// Creates an observer that calls this function, which must not block.
    pub fn new(listener: impl Fn(Option<Duration>) + Send + Sync + 'static) -> RequestObserver {
        RequestObserver(Some(Arc::new(listener)))
    }

    /// Records one request.
    pub fn record(&self, took: Option<Duration>) {
        if let Some(listener) = &self.0 {
            listener(took);
        }
    }
}

impl fmt::Debug for RequestObserver {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let heard = self.0.is_some();
        out.debug_tuple("Called").field(&heard).finish()
    }
}

impl Default for BridgeOptions {
    fn default() -> Self {
        Self {
            max_frame: 32 << 20,
            max_message: 32 << 20,
            ping_interval: Duration::from_secs(15),
            idle_timeout: Duration::from_secs(90),
            close_timeout: Duration::from_secs(3),
            control_messages: 4096,
            control_bytes: 32 << 20,
            topic_messages: 1000,
            topic_bytes: 4 << 20,
            // Ten images of 1920x1080.
            session_bytes: 64 << 20,
            bus_queue: 256,
            max_subscriptions: 1000,
            max_advertisements: 1000,
            max_calls: 1000,
            max_call_bytes: 64 << 20,
            call_timeout: Duration::from_secs(300),
            action_timeout: Duration::from_secs(10),
            warm_up: Duration::from_secs(1),
            resume_grace: Duration::from_secs(30),
            fragments: FragmentLimits { bytes: 32 << 20, ..FragmentLimits::default() },
            max_png: 32 << 20,
            non_finite: NonFinite::Null,
            max_encoded: 64 << 20,
            budget: Budget::without_limit(),
            unfinished: Duration::from_secs(300),
            called: RequestObserver::default(),
            pair: None,
        }
    }
}

/// Options of one connection.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Name of the client in logs and in the `connected_clients` topic: the robot's id or the peer's address.
    pub client: String,
    /// Secret chosen by the client. A connection that presents it again within [`BridgeOptions::resume_grace`] finds
    /// subscriptions, advertisements and unanswered calls as they were left.
    pub resume: Option<String>,
    /// Bytes already read from the connection after the HTTP upgrade.
    pub read_ahead: Bytes,
    /// Level of status messages until the client sends `set_level`.
    pub level: StatusLevel,
    /// Delivery of what this bridge's own clients publish, as for clients of rosbridge. Off for a robot's link: its ROS
    /// has those messages already.
    pub hears_clients: bool,
    /// Budget for the client's incomplete messages; one that does not fit closes its connection (1013).
    pub budget: Budget,
    /// Permissions of the client.
    pub granted: ClientGrants,
}

impl Default for SessionOptions {
    fn default() -> Self {
        Self {
            client: String::new(),
            resume: None,
            read_ahead: Bytes::new(),
            level: StatusLevel::Error,
            hears_clients: true,
            budget: Budget::without_limit(),
            granted: ClientGrants::default(),
        }
    }
}
