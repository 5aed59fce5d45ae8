//! Checks of the host's prerequisites.

use serde::{Deserialize, Serialize};

/// Result of all checks.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Doctor {
    /// All checks, in the order in which they should be fixed.
    pub checks: Vec<Check>,
}

impl Doctor {
    /// Returns whether no required prerequisite is missing.
    pub fn is_healthy(&self) -> bool {
        self.checks.iter().all(|check| check.status != CheckStatus::Missing)
    }
}

/// Check of one prerequisite.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Check {
    /// Name of the prerequisite.
    pub name: String,
    /// Result of the check.
    pub status: CheckStatus,
    /// Description of what was found.
    pub found: String,
    /// Command or setting that fixes the problem.
    #[serde(default, skip_serializing_if = "Option::is_none", alias = "mend")]
    pub fix: Option<String>,
}

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum CheckStatus {
    /// The prerequisite is met.
    Ok,
    /// The daemon works without it, with restrictions.
    Warning,
    /// The daemon does not work without it.
    Missing,
}
