//! Shared services: groups of servants that serve several robots together.

use serde::{Deserialize, Serialize};

/// Settings of a service whose servants are shared by robots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Shared {
    /// Minimum number of servants while any robot uses the service.
    pub min: u32,
    /// Maximum number of servants.
    pub max: u32,
    /// True if a request may be executed twice: if its servant is lost, it is retried on another one.
    pub idempotent: bool,
    /// Number of servants that each call is sent to; the first answer is used.
    pub replicas: u32,
    /// Maximum number of concurrent calls per servant; further calls are queued.
    pub calls: u32,
}

impl Default for Shared {
    fn default() -> Shared {
        Shared { min: 1, max: 4, idempotent: false, replicas: 1, calls: 8 }
    }
}

/// The servants of a revision that serve robots together, with request counts since the first of these robots
/// connected.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Group {
    /// Revision of the servants.
    pub revision: u64,
    /// Number of robots that use the group.
    pub robots: usize,
    /// Servants of the group.
    pub servants: Vec<GroupServant>,
    /// Number of queued requests.
    pub waiting: usize,
    /// Number of answered requests.
    pub answered: u64,
    /// Number of requests that failed because their servant was lost or none became free in time.
    pub failed: u64,
    /// Number of requests that were retried because their servant was lost.
    pub asked_again: u64,
    /// Number of requests that a second servant was still executing when the first answer arrived.
    pub wasted: u64,
    /// Mean response time of recently answered requests, in milliseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_ms: Option<f64>,
}

/// A servant of a group.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct GroupServant {
    /// Id of the servant.
    pub id: String,
    /// True if the servant accepts requests.
    pub ready: bool,
    /// True if the servant finishes its current requests and accepts no more.
    pub retiring: bool,
    /// Number of requests in progress.
    pub under_way: usize,
}
