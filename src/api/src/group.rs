//! Services that robots share: servants that answer all of them together.

use serde::{Deserialize, Serialize};

/// What a deployer decides of a service that robots share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Shared {
    /// Servants that there are while a robot uses the service, at least.
    pub min: u32,
    /// Servants at most.
    pub max: u32,
    /// A request may be carried out twice: one whose servant was lost is asked again.
    pub idempotent: bool,
    /// Servants that work at the same call; the first answer is taken.
    pub replicas: u32,
    /// Calls that one servant has under way at most; the rest wait.
    pub calls: u32,
}

impl Default for Shared {
    fn default() -> Shared {
        Shared {
            min: 1,
            max: 4,
            idempotent: false,
            replicas: 1,
            calls: 8,
        }
    }
}

/// The servants of a revision that answer robots together, and their requests since the first of these robots came.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Group {
    /// Of this revision.
    pub revision: u64,
    /// Robots that use it.
    pub robots: usize,
    /// Its servants.
    pub servants: Vec<GroupServant>,
    /// Requests that wait for a servant.
    pub waiting: usize,
    /// Requests that were answered.
    pub answered: u64,
    /// Requests that failed since their servant was lost, or none was free in time.
    pub failed: u64,
    /// Requests that were asked again since their servant was lost.
    pub asked_again: u64,
    /// Requests that a second servant worked at although the first had answered.
    pub wasted: u64,
    /// Mean time from a request to its answer, milliseconds, of those answered lately.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_ms: Option<f64>,
}

/// A servant of a group.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct GroupServant {
    /// Its id.
    pub id: String,
    /// It can be asked.
    pub ready: bool,
    /// It ends what it works at, and is asked no more.
    pub retiring: bool,
    /// Requests that it works at.
    pub under_way: usize,
}
