//! Access tokens and policy rules: `/api/v1/tokens`, `/api/v1/policy`, `/api/v1/whoami`.

use access::{Glob, Grant, Role, RuleSubject};
use serde::{Deserialize, Serialize};

use crate::Millis;

/// Request to create a token (`POST /api/v1/tokens`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewToken {
    /// Name of the principal, used in rules and audit records.
    pub name: String,
    /// Role: `admin`, `operator`, `deployer`, `robot` or `viewer`.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// Service name patterns that the token gives access to; required for deployers, robots and viewers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Robot that the token identifies; required for robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Patterns of the configured classes that the principal may request.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// Lifetime in seconds (default: the token does not expire).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lifetime: Option<u64>,
}

/// An existing token. Its secret is returned only once, in [`Secret`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Token {
    /// Name of the principal.
    pub name: String,
    /// Role of the principal.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// Service name patterns that the token gives access to.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Robot that the token identifies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Patterns of the configured classes that the principal may request.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// Creation time.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Expiry time; absent if the token does not expire.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
    /// Last use, to the minute.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub last_used: Option<Millis>,
    /// Time of revocation; absent if the token is not revoked.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub revoked: Option<Millis>,
}

/// A token together with its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Secret {
    /// The token.
    pub token: Token,
    /// Bearer secret to present. The server does not store it.
    pub secret: String,
}

/// Request to add a policy rule (`POST /api/v1/policy`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewRule {
    /// Subject of the rule: a principal's name, or `role:ROLE`.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub who: RuleSubject,
    /// Service name pattern that the rule applies to.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub services: Glob,
    /// Grants, such as `subscribe:/camera/**` or `call:/detect`. An empty list grants nothing.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub allow: Vec<Grant>,
}

/// A policy rule.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Rule {
    /// Rule number; never reused.
    pub id: i64,
    /// Principals that the rule applies to.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub who: RuleSubject,
    /// Service name pattern that the rule applies to.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub services: Glob,
    /// Permissions granted by the rule.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub allow: Vec<Grant>,
}

/// The authenticated principal (`GET /api/v1/whoami`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Whoami {
    /// Name of the principal.
    pub name: String,
    /// Roles of the principal.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub roles: Vec<Role>,
    /// Service name patterns that the principal has access to.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Robot that the principal identifies as.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Actions that the principal may perform (`docs/access.md`): on the server, and at the service of the query or,
    /// without one, at a service of its own.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub may: Vec<String>,
}

/// An audit record (`GET /api/v1/audit`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Audited {
    /// Record number; never reused.
    pub id: i64,
    /// Time of the request.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Principal that made the request, with its roles.
    pub who: String,
    /// Origin of the request: an address and port, or a user of the daemon's machine.
    pub from: String,
    /// Policy action that the request was checked against.
    pub action: String,
    /// Words for what was done or tried: of a request, as an order (`stop`, `begin a push`).
    pub did: String,
    /// Object that the request acted on.
    pub object: String,
    /// HTTP status of the response; 403 if the request was denied.
    pub status: u16,
    /// Number of identical requests since the previous record that were not recorded separately.
    #[serde(default, skip_serializing_if = "is_zero")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub more: u64,
}

impl Audited {
    /// Returns the outcome as a word: `done`, `refused` or `failed`.
    pub fn outcome(&self) -> &'static str {
        match self.status {
            401 | 403 => "refused",
            status if status < 400 => "done",
            _ => "failed",
        }
    }
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}
