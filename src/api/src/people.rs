//! User accounts and sessions of the web page: `/api/v1/session`, `/api/v1/sessions`, `/api/v1/accounts`.

use access::{Glob, Role};
use serde::{Deserialize, Serialize};

use crate::Millis;

/// Header in which the web page returns [`Session::csrf`], which pages of other sites cannot read. Required for each
/// state-changing request that is authenticated by a cookie.
pub const CSRF_HEADER: &str = "x-csrf-token";

/// Credentials (`POST /api/v1/session`).
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SignIn {
    /// Account name.
    pub name: String,
    /// Password.
    pub password: String,
}

/// The current session (`GET /api/v1/session`).
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Session {
    /// Name of the signed-in user; absent if nobody is signed in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Role of the user.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub role: Option<Role>,
    /// Token that state-changing requests of this session must send in `X-CSRF-Token`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub csrf: Option<String>,
    /// Latest time at which the session ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
    /// True if authentication is required.
    pub needed: bool,
    /// True if accounts with passwords exist.
    pub accounts: bool,
    /// True if robots on the server's machine need no credentials even where authentication is required.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub loopback_robots: bool,
    /// Identity provider, if one is configured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provider: Option<ProviderLink>,
}

/// Sign-in through an identity provider.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ProviderLink {
    /// Display name of the provider.
    pub name: String,
    /// Path to which the browser navigates to sign in.
    pub path: String,
}

/// A session (`GET /api/v1/sessions`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct SessionLine {
    /// Session number; never reused.
    pub id: i64,
    /// Name of the user.
    pub name: String,
    /// Role of the user.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// Origin of the session.
    pub from: String,
    /// Time when the session began.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Last use.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub last_used: Millis,
    /// Latest time at which the session ends.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub expires: Millis,
}

/// Request to create an account (`POST /api/v1/accounts`).
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewAccount {
    /// Name of the user, used in rules and audit records.
    pub name: String,
    /// Password; at least 12 characters.
    pub password: String,
    /// Role: `admin`, `operator`, `deployer` or `viewer`.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// Service name patterns that the user gets access to; required for deployers and viewers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub services: Vec<Glob>,
}

/// Changes to an account (`PATCH /api/v1/accounts/{name}`). Every change ends all sessions of the user.
#[derive(Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct AccountChange {
    /// New password.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password: Option<String>,
    /// New role, given together with its services.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub role: Option<Role>,
    /// Service name patterns of the new role.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// True if sign-in is disabled.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disabled: Option<bool>,
}

/// An account (`GET /api/v1/accounts`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Account {
    /// Name of the user.
    pub name: String,
    /// Role of the user.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// Service name patterns that the user has access to.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Creation time.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Last sign-in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub last_login: Option<Millis>,
    /// Time when sign-in was disabled.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub disabled: Option<Millis>,
    /// Number of open sessions.
    pub sessions: usize,
}
