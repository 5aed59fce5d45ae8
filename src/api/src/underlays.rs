//! Underlays, which other packages are compiled and run upon: `GET /api/v1/underlays`.

use serde::{Deserialize, Serialize};

use crate::{Millis, Size};

/// An underlay: a compiled workspace that others stand on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Underlay {
    /// Name of the underlay.
    pub name: String,
    /// Number of its revision, which replaced the earlier ones.
    pub revision: u64,
    /// Base that it was built on.
    pub base: String,
    /// ROS version: 1 or 2.
    pub ros: u8,
    /// ROS distribution.
    pub distribution: String,
    /// ROS packages, with those of the underlays that it was built on.
    pub packages: Vec<String>,
    /// Compressed size of its layers.
    pub bytes: Size,
    /// Time of publication.
    pub published: Millis,
    /// Human-readable description of what was pushed.
    pub source: String,
    /// Services that stand on it, as far as the caller may see them.
    pub services: Vec<StandingService>,
}

/// A service that stands on an underlay.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct StandingService {
    /// Name of the service.
    pub service: String,
    /// Revision of the underlay that its current revision was built on; it stays on that one until it is pushed again.
    pub on: u64,
}
