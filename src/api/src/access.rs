//! Tokens and policy: who may do what. `/api/v1/tokens`, `/api/v1/policy`, `/api/v1/whoami`.

use access::{Glob, Grant, Role, Who};
use serde::{Deserialize, Serialize};

use crate::Millis;

/// A token to make (`POST /api/v1/tokens`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewToken {
    /// The principal's name, by which rules and records know it.
    pub name: String,
    /// What it is for: `admin`, `operator`, `deployer`, `robot` or `viewer`.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// For which services, as patterns; needed for deployers, robots and viewers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// The robot that it is; needed for robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Classes of the configuration that it may name, as patterns.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// Seconds after which it ends; never, where it is not said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lifetime: Option<u64>,
}

/// A token that was made. Its secret is told once, by [`Secret`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Token {
    /// The principal's name.
    pub name: String,
    /// What it is for.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// For which services, as patterns.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// The robot that it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Classes that it may name, as patterns.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// When it was made.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// When it ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
    /// When it was shown last, to the minute.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub last_used: Option<Millis>,
    /// When it was revoked.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub revoked: Option<Millis>,
}

/// A token with its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Secret {
    /// What it is for.
    pub token: Token,
    /// What its holder shows. It is kept nowhere.
    pub secret: String,
}

/// A rule to write (`POST /api/v1/policy`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewRule {
    /// For whom: a principal's name, or `role:ROLE`.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub who: Who,
    /// For which services, as a pattern.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub services: Glob,
    /// What is granted: `subscribe:/camera/**`, `call:/detect`. Nothing is, where the list is empty.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub allow: Vec<Grant>,
}

/// A rule of the policy.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Rule {
    /// Its number, never given twice.
    pub id: i64,
    /// The principals that it is for.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub who: Who,
    /// The services that it is for.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub services: Glob,
    /// What is granted.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub allow: Vec<Grant>,
}

/// Who asks (`GET /api/v1/whoami`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Whoami {
    /// Its name.
    pub name: String,
    /// Its roles.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub roles: Vec<Role>,
    /// Services that it is for, as patterns.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// The robot that it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
}

/// What somebody did (`GET /api/v1/audit`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Audited {
    /// Its number, never given twice.
    pub id: i64,
    /// When it was done.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Who, with its roles.
    pub who: String,
    /// From where: an address and port, or a user of the daemon's machine.
    pub from: String,
    /// Which of the policy's actions it is.
    pub action: String,
    /// The request, without its query.
    pub did: String,
    /// The object that it was done to.
    pub object: String,
    /// The answer's HTTP status: 403 where it was refused.
    pub status: u16,
    /// So many alike before it, since the last one that is here, were not recorded.
    #[serde(default, skip_serializing_if = "is_zero")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub more: u64,
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}
