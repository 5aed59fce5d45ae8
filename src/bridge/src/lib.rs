//! Sessions between one ROS system and WebSockets that speak rosbridge v2.
//!
//! Each servant has one [`Bridge`], which is shared by all its sockets. In: a [`ros::bus::Bus`], the definitions of the
//! servant's types, and connections after their HTTP upgrade. Out: how each connection ended, and [`Metrics`].
//!
//! ```text
//!               ┌ Fanout per topic: one subscription, encoded per format   ┐      ┌ topic queues ┐
//!  Bus ─────────┤                                                          ├──▶ ──┤              ├── Session ── socket
//!   ▲  ▲        └ services, actions, rosapi: answers ──────────────────────┘      └ control queue┘       │
//!   │  └───────── calls, goals ◀──────────────────────────────── Client ◀──── ops ◀──────────────────────┤
//!   └──────────── topics ◀──────── ROS bytes, decoded in place ◀─────────────────────────────────────────┘
//! ```
//!
//! What a client has asked for (subscriptions, advertisements, calls in progress) belongs to its *client*, which can
//! outlive the socket: with a resume token the next socket takes it over.
//!
//! Life cycle of a session; a connection may arrive before its servant is ready, and wait ([`WaitingConnection`]):
//!
//! ```text
//!  Waiting ──the servant is ready──▶ Open
//!
//!  Open ──frame over limits, idle, control queue full, servant gone──▶ Closing ──close frame or time-out──▶ Ended
//!   │ └──client's close frame──────────────────────────────────────────▲                                     ▲
//!   └──socket lost────────────────────────────────────────────────────────────────────────────────────────────┘
//! ```

#![forbid(unsafe_code)]

mod acks;
mod bridge;
mod client;
mod client_grants;
mod client_state;
mod clock;
mod connection;
mod counted_publisher;
mod cut;
mod early_messages;
mod fanout;
mod lacking;
mod lease;
mod metrics;
mod names;
mod options;
mod outbox;
mod own;
mod own_service;
mod presence;
mod quality;
mod refusals;
mod registrations;
mod republisher;
mod rosapi;
mod sample;
mod service_types;
mod session;
mod shared;
mod subscribers;
mod tf;
mod topic_publisher;
mod topic_queue;
mod topic_requests;
mod topics;
mod waiting;

/// Name of the node by which people inspect a servant. Messages of robots do not wait for it.
pub const INSIDE_NODE: &str = "/cloudroid_inside";

pub use bridge::{Bridge, refuse};
pub use client_grants::{ClientGrants, NotGrantedError};
pub use metrics::{Counter, Drops, Metrics, MetricsSnapshot};
pub use options::{BridgeOptions, RequestObserver, SessionOptions};
pub use session::{SessionCount, SessionEnd};
pub use subscribers::{WaitDeadlines, find_missing_subscribers, wait_for_subscribers};
pub use waiting::WaitingConnection;
