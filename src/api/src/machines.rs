//! Pairings of robots: `/api/v1/pairings`, and what robots ask themselves: `/api/v1/pair`, `/api/v1/renew`.

use access::Glob;
use serde::{Deserialize, Serialize};

use crate::Millis;

/// A robot to pair (`POST /api/v1/pairings`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewPairing {
    /// The robot's name.
    pub robot: String,
    /// For which services, as patterns.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Classes of the configuration that it may name, as patterns.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// Seconds for which the code is good; 15 minutes where it is not said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lifetime: Option<u64>,
    /// Host and port by which the robot reaches the daemon; as whoever asks reached it, where it is not said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// The lab's own authority signs the robot's certificates: it is paired at once, without a code.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub own_certificate: bool,
}

/// A pairing that was begun. Its code is told once, in the line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PairingMade {
    /// The robot's name.
    pub robot: String,
    /// What to give to `cloudroid-stub pair` on the robot; none where it has a certificate of the lab's own authority.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub line: Option<String>,
    /// When the code ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
}

/// A robot that is paired, or for which a code waits (`GET /api/v1/pairings`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Pairing {
    /// The robot's name.
    pub robot: String,
    /// For which services, as patterns.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub services: Vec<Glob>,
    /// Classes of the configuration that it may name, as patterns.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, value_type = Vec<String>))]
    pub classes: Vec<Glob>,
    /// What became of it.
    pub state: PairingState,
    /// The lab's own authority signs its certificates.
    pub own_certificate: bool,
    /// When it, or its code, was made.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// When its newest certificate, or its code, ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub expires: Option<Millis>,
    /// When the robot came last, to the minute.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub last_used: Option<Millis>,
}

/// What became of a pairing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum PairingState {
    /// Its code was not used yet.
    Waiting,
    /// The robot is paired.
    Paired,
}

/// What a robot shows to be paired (`POST /api/v1/pair`).
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Pair {
    /// The robot's name.
    pub robot: String,
    /// The pairing code.
    pub code: String,
    /// A request for a certificate: PKCS #10 (RFC 2986) in PEM.
    pub request: String,
}

/// What a robot asks another certificate with (`POST /api/v1/renew`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Renew {
    /// A request for a certificate of the key that was paired: PKCS #10 in PEM.
    pub request: String,
}

/// A robot's certificate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct RobotCertificate {
    /// The robot's name.
    pub robot: String,
    /// The certificate, in PEM.
    pub certificate: String,
    /// When it was made, by the daemon's clock.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub issued: Millis,
    /// When it ends, by the daemon's clock.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub expires: Millis,
}
