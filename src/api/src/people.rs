//! People: their accounts, and sessions of the page. `/api/v1/session`, `/api/v1/sessions`, `/api/v1/accounts`.

use access::{Glob, Role};
use serde::{Deserialize, Serialize};

use crate::Millis;

/// The header by which the page shows that it has read [`Session::csrf`], which pages of other sites cannot. Each request that
/// changes something and shows a cookie needs it.
pub const CSRF_HEADER: &str = "x-csrf-token";

/// Name and password (`POST /api/v1/session`).
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SignIn {
    /// The account's name.
    pub name: String,
    /// Its password.
    pub password: String,
}

/// Who is signed in (`GET /api/v1/session`).
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Session {
    /// Who; none: nobody.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Its role.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub role: Option<Role>,
    /// What requests of this session that change something show in `X-CSRF-Token`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub csrf: Option<String>,
    /// When the session ends at the latest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
    /// Whether anybody needs to say who it is here.
    pub needed: bool,
    /// Whether there are accounts with passwords.
    pub accounts: bool,
    /// An identity provider that knows people, too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provider: Option<ProviderLink>,
}

/// Where people sign in by an identity provider.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ProviderLink {
    /// As people know it.
    pub name: String,
    /// Where a browser goes to.
    pub path: String,
}

/// A session of somebody (`GET /api/v1/sessions`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct SessionLine {
    /// Its number, never given twice.
    pub id: i64,
    /// Whose.
    pub name: String,
    /// In which role.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// From where it was begun.
    pub from: String,
    /// When it was begun.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// When it was used last.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub last_used: Millis,
    /// When it ends at the latest.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub expires: Millis,
}

/// An account to make (`POST /api/v1/accounts`).
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewAccount {
    /// The person's name, by which rules and records know it.
    pub name: String,
    /// At least 12 characters.
    pub password: String,
    /// What it is for: `admin`, `operator`, `deployer` or `viewer`.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// For which services, as patterns; needed for deployers and viewers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub services: Vec<Glob>,
}

/// What to change of an account (`PATCH /api/v1/accounts/{name}`). Each change ends all sessions of the person.
#[derive(Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct AccountChange {
    /// Another password.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password: Option<String>,
    /// Another role, with the services that it is for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub role: Option<Role>,
    /// For which services, as patterns.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Nobody may sign in, or somebody may again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disabled: Option<bool>,
}

/// An account (`GET /api/v1/accounts`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Account {
    /// The person's name.
    pub name: String,
    /// What it is for.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub role: Role,
    /// For which services, as patterns.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// When it was made.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// When somebody last signed in by it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub last_login: Option<Millis>,
    /// Since when nobody may sign in by it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub disabled: Option<Millis>,
    /// Sessions that it has.
    pub sessions: usize,
}
