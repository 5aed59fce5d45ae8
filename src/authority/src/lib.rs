//! The daemon's authority, which signs robots' certificates, and what a certificate says of its robot (docs/adr/086).
//!
//! ```text
//!  HOME/tls/authority.pem ─▶ Authority ─┬─ request (PKCS #10) ──issue──▶ certificate of robot:NAME
//!                                       └─ certificate of a connection ──read──▶ Shown: robot, key, end
//! ```
//!
//! Whether a certificate was signed by somebody who is trusted, and whether who shows it has its key, is found out in the TLS handshake,
//! by rustls; here it is only read.

#![forbid(unsafe_code)]

mod issue;
mod request;
mod shown;

use std::path::PathBuf;

pub use issue::{Authority, Issued};
pub use request::{LONGEST, Request};
pub use shown::{Period, Shown, period, read};

/// Milliseconds since 1970.
pub type Millis = u64;

/// What stands before a robot's name in a certificate: it is a URI (RFC 3986) of this scheme.
pub const SCHEME: &str = "robot:";

/// Why a certificate is not made, or says nothing.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file system refused.
    #[error("cannot {action} {path}: {source}", path = .path.display())]
    Io {
        /// What was being done.
        action: &'static str,
        /// The authority's file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file holds no authority.
    #[error(
        "{path} holds no certificate with its key (PEM): {reason}; put the right one back, or remove it to get another, and pair \
         all robots again",
        path = .path.display()
    )]
    NoAuthority {
        /// The authority's file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A certificate cannot be made.
    #[error("cannot make a certificate for {what}: {source}")]
    Unmade {
        /// For whom.
        what: String,
        /// The cause.
        source: rcgen::Error,
    },
    /// What should be a request is none.
    #[error("this is no request for a certificate (PKCS #10 in PEM, RFC 2986): {0}")]
    NoRequest(String),
    /// It is longer than a request can be.
    #[error("a request for a certificate has at most {LONGEST} bytes, and this one has {0}")]
    TooLong(usize),
    /// It is for somebody else.
    #[error(
        "the request asks for a certificate of {found}, and the pairing is for {SCHEME}{robot}"
    )]
    OtherName {
        /// What it asks for.
        found: String,
        /// Whom it may be for.
        robot: String,
    },
    /// A key of a kind that is not taken.
    #[error(
        "the request has a key of a kind that is not taken here; make one of P-256 or Ed25519 (cloudroid-stub pair makes one)"
    )]
    Kind,
    /// A certificate that names no robot, or two.
    #[error(
        "the certificate that was shown names no robot: {0}; its subject alternative name (URI) or common name has to be {SCHEME}NAME"
    )]
    Nameless(String),
}
