//! What a service is given beyond its container: nothing, unless its push asks for it and the daemon's configuration
//! allows it.

use serde::{Deserialize, Serialize};

/// Devices, volumes and ways out.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Grants {
    /// Devices by their names in CDI specifications, such as `nvidia.com/gpu=0`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub devices: Vec<String>,
    /// Directories or files of the daemon's machine, read-only.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub volumes: Vec<Volume>,
    /// `HOST:PORT` that its nodes may connect to, by TCP.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub egress: Vec<String>,
}

impl Grants {
    /// Whether there is nothing.
    pub fn is_empty(&self) -> bool {
        *self == Grants::default()
    }
}

/// A directory or file of the machine, as nodes see it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// On the machine; absolute.
    pub source: String,
    /// Inside; absolute.
    pub target: String,
}
