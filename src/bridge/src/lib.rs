//! A session between one ROS system and one WebSocket that speaks rosbridge v2.
//!
//! One [`Bridge`] stands before each servant and is shared by all its sockets. In: a [`ros::bus::Bus`], the
//! definitions of the servant's types, and connections behind their HTTP upgrade. Out: how each ended, and
//! [`Metrics`].
//!
//! ```text
//!               ┌ Fanout per topic: one subscription, encoded per format   ┐      ┌ topic queues ┐
//!  Bus ─────────┤                                                          ├──▶ ──┤              ├── Session ── socket
//!   ▲  ▲        └ services, actions, rosapi: answers ──────────────────────┘      └ control queue┘       │
//!   │  └───────── calls, goals ◀──────────────────────────────── Client ◀──── ops ◀──────────────────────┤
//!   └──────────── topics ◀──────── ROS bytes, decoded in place ◀─────────────────────────────────────────┘
//! ```
//!
//! What a client has asked for (subscriptions, advertisements, calls under way) belongs to its *client*, which can
//! outlive the socket: with a resume token the next socket takes it over.
//!
//! A session's life; a connection may come before its servant is there, and wait ([`Waiting`]):
//!
//! ```text
//!  Waiting ──the servant is there──▶ Open
//!
//!  Open ──frame over limits, idle, control queue full, servant gone──▶ Closing ──close frame or time-out──▶ Ended
//!   │ └──client's close frame──────────────────────────────────────────▲                                     ▲
//!   └──socket lost────────────────────────────────────────────────────────────────────────────────────────────┘
//! ```

#![forbid(unsafe_code)]

mod acks;
mod bridge;
mod client;
mod clock;
mod connection;
mod counted;
mod cut;
mod fanout;
mod granted;
mod kept;
mod lacking;
mod lease;
mod metrics;
mod names;
mod options;
mod outbox;
mod own;
mod presence;
mod quality;
mod refusals;
mod registrations;
mod rosapi;
mod sample;
mod service_types;
mod shared;
mod tf;
mod topic_publisher;
mod topic_queue;
mod topic_requests;
mod topics;
mod waiting;

/// The name of the node by which people look into a servant. What robots send does not wait for it.
pub const INSIDE: &str = "/cloudroid_inside";

pub use bridge::{Bridge, SessionCount, SessionEnd, refuse};
pub use granted::Granted;
pub use metrics::{Counter, Drops, Metrics};
pub use options::{BridgeOptions, Called, SessionOptions};
pub use waiting::Waiting;
