//! Status of the daemon.

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::limits::{Limits, Usage};

/// Response of `GET /api/v1/status`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Status {
    /// Version of the daemon.
    pub version: String,
    /// Architecture of this machine, such as `x86_64` or `aarch64`; empty from earlier versions.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub architecture: String,
    /// Process id of the daemon.
    pub pid: u32,
    /// State directory.
    pub home: String,
    /// Listen address.
    pub listen: String,
    /// Fingerprint of the TLS certificate of the listen address: `SHA256:` and hexadecimal digits; absent without TLS.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub certificate: Option<String>,
    /// Service for connections that name none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default_service: Option<String>,
    /// Start time of the daemon.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub started: Millis,
    /// Isolation of servants.
    pub isolation: Isolation,
    /// Capacity of the machine and current reservations.
    pub capacity: Capacity,
    /// Default limits of a servant.
    pub limits: Limits,
    /// Number of published services.
    pub services: usize,
    /// Number of running servants.
    pub servants: usize,
    /// Number of warm containers, created ahead of demand.
    #[serde(default, alias = "spares")]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub warm_pool: usize,
    /// Number of warm containers whose nodes are running.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub warm_nodes: usize,
    /// Number of connected robots.
    pub connections: usize,
    /// Resource usage of all running servants together; the pressure is that of the whole machine, absent if the kernel
    /// does not report it.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub usage: Usage,
    /// Seconds of each servant that are kept for recordings; 0 if black boxes are off.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub black_box: f64,
    /// Problems of this machine.
    pub warnings: Vec<String>,
}

/// Isolation of servants.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Isolation {
    /// Mode: `require` or `best-effort`.
    pub mode: String,
    /// Version of the cgroup controllers in use; 0 if none can be used.
    pub cgroup_version: u8,
    /// Limits that this machine cannot enforce.
    pub missing: Vec<String>,
}

/// Capacity for servants.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Capacity {
    /// CPU available for reservations, in cores.
    pub cpus: f64,
    /// Memory available for reservations, in bytes.
    pub memory: u64,
    /// Reserved CPU in cores.
    pub cpus_reserved: f64,
    /// Reserved memory in bytes.
    pub memory_reserved: u64,
    /// Number of servants waiting for admission.
    pub waiting: usize,
}

/// The daemon's clock, for comparison with another clock.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Clock {
    /// Milliseconds since 1970, with fraction.
    pub now: f64,
}
