//! The identity of a caller and the credential that shows it.

use std::sync::Arc;

use access::Principal;
use api::Millis;
use store::{Owner, TokenHash};

/// Credential by which a caller is known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Credential {
    /// None: a local caller on a machine without any credentials, or an unauthenticated one.
    Nothing,
    /// None, of a robot on this machine where the operator admits such robots (`loopback_robots`).
    Loopback,
    /// A token of the configuration.
    Configured,
    /// A token of the database.
    Stored {
        /// Id of the token.
        id: i64,
        /// Hash of its secret, which changes on rotation.
        hash: TokenHash,
    },
    /// A TLS client certificate.
    Certificate {
        /// Id of the robot's pairing.
        pairing: i64,
        /// SHA-256 hash of the paired key; `None` if an authority other than the daemon's signs the robot's
        /// certificates.
        key: Option<String>,
        /// End of the certificate's validity.
        until: Millis,
    },
    /// A session of the page.
    Session {
        /// Id of the session.
        id: i64,
    },
    /// User id at the daemon's socket, from the kernel.
    User,
}

/// An authenticated caller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallerIdentity {
    /// The principal.
    pub principal: Arc<Principal>,
    /// The credential.
    pub shown: Credential,
    /// Hash of the token presented.
    pub token: Option<TokenHash>,
    /// Owner to which robot names are bound when the caller first uses them.
    pub owner: Option<Owner>,
}

impl CallerIdentity {
    /// Returns what the caller's resume tokens are bound to: a token of the database (whatever its current secret), a
    /// pairing, a person, or else the hash of the token.
    pub fn resume_binding(&self) -> Option<String> {
        match &self.shown {
            Credential::Stored { id, .. } => Some(format!("token {id}")),
            Credential::Certificate { pairing, .. } => Some(format!("pairing {pairing}")),
            // Shared by that person's next session.
            Credential::Session { .. } => Some(format!("person {}", self.principal.name)),
            _ => self.token.clone(),
        }
    }
}
