//! What an operator can set, and what each connection brings along.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;
use qos::Pair;
use ros::codec::NonFinite;
use rosbridge::{FragmentLimits, Level};

use crate::Granted;

/// Limits and habits of one servant's bridge. The defaults suit a robot on Wi-Fi.
#[derive(Debug, Clone)]
pub struct BridgeOptions {
    /// Longest WebSocket frame taken, in bytes; longer ones close the connection (1009).
    pub max_frame: usize,
    /// Longest WebSocket message taken, in bytes, whether in one frame or several (1009).
    pub max_message: usize,
    /// Time between pings; zero: none.
    pub ping_interval: Duration,
    /// A connection from which nothing, not even a pong, came for so long is closed (1001); zero: never.
    pub idle_timeout: Duration,
    /// How long a closed connection may take to say goodbye.
    pub close_timeout: Duration,
    /// Answers and status messages kept for a client that does not read; more close the connection (1008).
    pub control_messages: usize,
    /// Bytes of those.
    pub control_bytes: usize,
    /// Messages kept per topic for a client that reads slowly; the oldest are dropped beyond.
    pub topic_messages: usize,
    /// Bytes of those. However large they are, two are kept; as many as the client asked for where it did, at most ten.
    pub topic_bytes: usize,
    /// Bytes kept for one client over all its topics; one message is always kept. Its budget is a bound, too.
    pub session_bytes: usize,
    /// Messages that the bus keeps for the bridge, per topic.
    pub bus_queue: usize,
    /// Subscriptions one client may have.
    pub max_subscriptions: usize,
    /// Topics, services and actions one client may advertise, together.
    pub max_advertisements: usize,
    /// Service calls and goals of one client that may be under way at once.
    pub max_calls: usize,
    /// Bytes of arguments of those; a single call or goal may have more.
    pub max_call_bytes: usize,
    /// How long a service may take when the call says nothing.
    pub call_timeout: Duration,
    /// How long a goal waits for its action server to connect.
    pub action_timeout: Duration,
    /// How long messages published right after `advertise` wait for the first subscriber to connect.
    pub warm_up: Duration,
    /// How long a client with a resume token may be away.
    pub resume_grace: Duration,
    /// Bounds of messages that arrive in fragments.
    pub fragments: FragmentLimits,
    /// Most bytes that a `png` may unpack to.
    pub max_png: usize,
    /// How NaN and infinities are written in JSON.
    pub non_finite: NonFinite,
    /// Bytes of JSON or CBOR that one message from ROS may become; a longer one is not sent.
    pub max_encoded: usize,
    /// Budget for JSON and CBOR made of messages from ROS (above 64 KiB), for as long as they wait for their clients. A message
    /// that does not fit is not sent, and its clients get a status.
    pub budget: Budget,
    /// A WebSocket message that was begun and is not complete after this time closes its connection (1008).
    pub unfinished: Duration,
    /// Who hears of clients' requests to the servant: calls of its services, goals, and messages of the input of `pair`.
    pub called: Called,
    /// Topics on which clients ask and the servant answers, where there is one such pair.
    pub pair: Option<Pair>,
}

/// Hears how long each request of a client to the servant took, from the bridge to the servant and back; none where it failed.
#[derive(Clone, Default)]
pub struct Called(Option<Arc<Listener>>);

type Listener = dyn Fn(Option<Duration>) + Send + Sync;

impl Called {
    /// By this function, which must not block.
    pub fn by(listener: impl Fn(Option<Duration>) + Send + Sync + 'static) -> Called {
        Called(Some(Arc::new(listener)))
    }

    /// Tells of one request.
    pub fn tell(&self, took: Option<Duration>) {
        if let Some(listener) = &self.0 {
            listener(took);
        }
    }
}

impl fmt::Debug for Called {
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
            // Ten pictures of 1920x1080.
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
            fragments: FragmentLimits {
                bytes: 32 << 20,
                ..FragmentLimits::default()
            },
            max_png: 32 << 20,
            non_finite: NonFinite::Null,
            max_encoded: 64 << 20,
            budget: Budget::unlimited(),
            unfinished: Duration::from_secs(300),
            called: Called::default(),
            pair: None,
        }
    }
}

/// What is particular to one connection.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Who it is, for logs and the `connected_clients` topic: the robot's id or the peer's address.
    pub client: String,
    /// A secret that the client made up. Whoever presents it again within [`BridgeOptions::resume_grace`] finds
    /// subscriptions, advertisements and unanswered calls as they were left.
    pub resume: Option<String>,
    /// What was already read from the connection behind the HTTP upgrade.
    pub read_ahead: Bytes,
    /// Which status messages it hears until it says `set_level`.
    pub level: Level,
    /// Whether it receives what this bridge's own clients publish, as rosbridge's clients do. A robot's link does
    /// not: its ROS has those messages already.
    pub hears_clients: bool,
    /// Budget for unfinished messages of the client; one that does not fit closes its connection (1013).
    pub budget: Budget,
    /// What it may do.
    pub granted: Granted,
}

impl Default for SessionOptions {
    fn default() -> Self {
        Self {
            client: String::new(),
            resume: None,
            read_ahead: Bytes::new(),
            level: Level::Error,
            hears_clients: true,
            budget: Budget::unlimited(),
            granted: Granted::default(),
        }
    }
}
