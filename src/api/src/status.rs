//! The daemon at a glance.

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::limits::{Limits, Usage};

/// What `GET /api/v1/status` answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Status {
    /// The daemon's version.
    pub version: String,
    /// Its process id.
    pub pid: u32,
    /// Where its state is.
    pub home: String,
    /// Where it listens.
    pub listen: String,
    /// The fingerprint of the certificate that it shows there, `SHA256:` with hexadecimal digits; none where it speaks plain
    /// text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub certificate: Option<String>,
    /// Where plain connections go.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default_service: Option<String>,
    /// When it started.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub started: Millis,
    /// What holds the servants apart.
    pub isolation: Isolation,
    /// What the machine gives and what is taken.
    pub capacity: Capacity,
    /// Limits of a servant where its push said nothing.
    pub limits: Limits,
    /// Published services.
    pub services: usize,
    /// Servants alive now.
    pub servants: usize,
    /// Containers made ahead, for robots to come.
    #[serde(default, alias = "spares")]
    pub warm_pool: usize,
    /// Those of them in which the nodes run.
    #[serde(default)]
    pub warm_nodes: usize,
    /// Connections of robots now.
    pub connections: usize,
    /// What the servants that live use together; the pressure is the whole machine's, none where the kernel does not
    /// tell.
    #[serde(default)]
    pub usage: Usage,
    /// What does not work as it should on this machine.
    pub warnings: Vec<String>,
}

/// What holds the servants apart.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Isolation {
    /// `require` or `best-effort`.
    pub mode: String,
    /// Version of the cgroup controllers in use; 0: none can be used.
    pub cgroup_version: u8,
    /// Limits that this machine cannot set.
    pub missing: Vec<String>,
}

/// Room for servants.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Capacity {
    /// Cores that servants may be promised.
    pub cpus: f64,
    /// Memory that servants may be promised.
    pub memory: u64,
    /// Cores promised now.
    pub cpus_reserved: f64,
    /// Memory promised now.
    pub memory_reserved: u64,
    /// Servants waiting for room.
    pub waiting: usize,
}

/// The daemon's clock, for comparing another with it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Clock {
    /// Milliseconds since 1970 with their fraction.
    pub now: f64,
}
