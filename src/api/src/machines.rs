//! Pairing of robots: `/api/v1/pairings`, and the requests made by robots: `/api/v1/pair`, `/api/v1/renew`.

use access::Glob;
use serde::{Deserialize, Serialize};

use crate::Millis;

/// Request to pair a robot (`POST /api/v1/pairings`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewPairing {
    /// Name of the robot.
    pub robot: String,
    /// Service name patterns that the robot gets access to.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Patterns of the configured classes that the robot may request.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// Lifetime of the pairing code in seconds (default: 900).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lifetime: Option<u64>,
    /// Host and port under which the robot reaches the daemon (default: the address of this request).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// True if the robot's certificate is issued by the site's own CA: the robot is then paired at once, without a
    /// code.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub own_certificate: bool,
}

/// A new pairing. The pairing code is returned only once, in the line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PairingMade {
    /// Name of the robot.
    pub robot: String,
    /// Argument for `cloudroid-stub pair` on the robot; absent if the robot has a certificate of the site's own CA.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub line: Option<String>,
    /// Expiry time of the pairing code.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
}

/// A paired robot, or a robot with a pending pairing code (`GET /api/v1/pairings`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Pairing {
    /// Name of the robot.
    pub robot: String,
    /// Service name patterns that the robot has access to.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Patterns of the configured classes that the robot may request.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// State of the pairing.
    pub state: PairingState,
    /// True if the robot's certificates are issued by the site's own CA.
    pub own_certificate: bool,
    /// Creation time of the pairing, or of its code.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Expiry time of the latest certificate, or of the code.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
    /// Last connection of the robot, to the minute.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub last_used: Option<Millis>,
}

/// State of a pairing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum PairingState {
    /// The code has not been used yet.
    Waiting,
    /// The robot is paired.
    Paired,
}

/// Pairing request of a robot (`POST /api/v1/pair`).
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Pair {
    /// Name of the robot.
    pub robot: String,
    /// Pairing code.
    pub code: String,
    /// Certificate signing request: PKCS #10 (RFC 2986) in PEM.
    pub request: String,
}

/// Certificate renewal request of a robot (`POST /api/v1/renew`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Renew {
    /// Certificate signing request for the paired key: PKCS #10 in PEM.
    pub request: String,
}

/// Certificate of a robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct RobotCertificate {
    /// Name of the robot.
    pub robot: String,
    /// Certificate in PEM.
    pub certificate: String,
    /// Time of issue, by the daemon's clock.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub issued: Millis,
    /// Expiry time, by the daemon's clock.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub expires: Millis,
}
