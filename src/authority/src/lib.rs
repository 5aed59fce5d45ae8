//! The daemon's certificate authority for robots, and reading robots' certificates (docs/adr/086).
//!
//! ```text
//!  HOME/tls/authority.pem ─▶ Authority ─┬─ request (PKCS #10) ──issue──▶ certificate of robot:NAME
//!                                       └─ certificate of a connection ──read──▶ VerifiedCertificate: robot, key, end
//! ```
//!
//! rustls verifies in the TLS handshake that a trusted authority signed the certificate and that the client holds its
//! key; this crate only reads it.

#![forbid(unsafe_code)]

mod client_certificate;
mod issue;
mod request;

use std::path::PathBuf;

pub use client_certificate::{
    UnreadableCertificate, ValidityPeriod, VerifiedCertificate, read_robot_certificate, read_validity,
};
pub use issue::{Authority, AuthorityPemError, IssuedRobotCertificate};
pub use request::{CertificateRequest, LONGEST};

/// Milliseconds since 1970.
pub type Millis = u64;

/// Prefix of a robot's name in a certificate: the scheme of a URI (RFC 3986).
pub const SCHEME: &str = "robot:";

/// Reason why a certificate is not issued or not accepted.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {path}: {source}", path = .path.display())]
    Io {
        /// The operation.
        action: &'static str,
        /// Path of the authority's file.
        path: PathBuf,
        /// Underlying error.
        source: std::io::Error,
    },
    /// The file holds no authority.
    #[error(
        "{path} holds no certificate with its key (PEM): {reason}; restore it, or remove it to create a new one and \
            pair all robots again",
        path = .path.display()
    )]
    NoAuthority {
        /// Path of the authority's file.
        path: PathBuf,
        /// Description of what is wrong.
        reason: AuthorityPemError,
    },
    /// A certificate could not be created.
    #[error("cannot create a certificate for {what}: {source}")]
    Unmade {
        /// Subject of the certificate.
        what: String,
        /// Underlying error.
        source: rcgen::Error,
    },
    /// The text is not a signing request.
    #[error("not a certificate request (PKCS #10 in PEM, RFC 2986): {0}")]
    NoRequest(String),
    /// The request is too long.
    #[error("a certificate request has at most {LONGEST} bytes, but this one has {0}")]
    TooLong(usize),
    /// The request is for another name.
    #[error("the request asks for a certificate of {found}, but the pairing is for {SCHEME}{robot}")]
    OtherName {
        /// Name in the request.
        found: String,
        /// Robot that the request must be for.
        robot: String,
    },
    /// The key type is not supported.
    #[error("the key type of the request is not supported; use P-256 or Ed25519 (cloudroid-stub pair creates one)")]
    Kind,
    /// The certificate names no robot, or several.
    #[error(
        "the client certificate names no robot: {0}; its subject alternative name (URI) or common name must be \
            {SCHEME}NAME"
    )]
    Nameless(String),
}
