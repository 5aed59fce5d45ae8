//! Access that a service is given beyond its container. The push must request it, and the daemon's configuration must
//! allow it.

use serde::{Deserialize, Serialize};

/// Devices, volumes and egress.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Grants {
    /// Devices by CDI name, such as `nvidia.com/gpu=0`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub devices: Vec<String>,
    /// Directories or files of the daemon's machine, mounted read-only.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub volumes: Vec<Volume>,
    /// Destinations (`HOST:PORT`) that the nodes may connect to over TCP.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub egress: Vec<String>,
}

impl Grants {
    /// Returns whether nothing is granted.
    pub fn is_empty(&self) -> bool {
        *self == Grants::default()
    }
}

/// A directory or file of the machine, mounted into the container.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// Absolute path on the machine.
    pub source: String,
    /// Absolute path in the container.
    pub target: String,
}
