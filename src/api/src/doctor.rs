//! What the host needs, and whether it is there.

use serde::{Deserialize, Serialize};

/// The result of all checks.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Doctor {
    /// Every check, in the order in which a person would fix them.
    pub checks: Vec<Check>,
}

impl Doctor {
    /// Nothing that is needed is missing.
    pub fn well(&self) -> bool {
        self.checks
            .iter()
            .all(|check| check.status != CheckStatus::Missing)
    }
}

/// One need.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Check {
    /// What is needed.
    pub name: String,
    /// Whether it is there.
    pub status: CheckStatus,
    /// What was found.
    pub found: String,
    /// The command or the setting that fixes it.
    #[serde(default, skip_serializing_if = "Option::is_none", alias = "mend")]
    pub fix: Option<String>,
}

/// Whether a need is met.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum CheckStatus {
    /// What is checked is there.
    Ok,
    /// It works without, but less well.
    Warning,
    /// It does not work without.
    Missing,
}
