//! Ed25519 signatures (RFC 8032) in the format of OpenSSH's `ssh-keygen -Y` (PROTOCOL.sshsig), which robots can verify
//! with the tools they have.
//!
//! ```text
//!  HOME/signing.pem ─▶ SigningKey ──sign──▶ -----BEGIN SSH SIGNATURE----- ──PublicKey::verify, ssh-keygen -Y verify
//! ```

#![forbid(unsafe_code)]

mod key;
mod signature;
mod wire;

pub use key::{PublicKey, SigningKey};
pub use signature::{digest, to_armoured_lines, to_single_line};

/// An error of a key or signature.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {path}: {source}", path = .path.display())]
    Io {
        /// Operation that failed.
        action: &'static str,
        /// The key's file.
        path: std::path::PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file does not contain a key.
    #[error(
        "{path} holds no ed25519 key (PKCS #8 in PEM); restore it, or remove it to create a new one, which robots then \
            need to know (install.sh --key)",
        path = .0.display()
    )]
    NoKey(std::path::PathBuf),
    /// The system provides no random numbers.
    #[error("the system provides no random numbers for a key")]
    NoRandom,
    /// Not a valid public key.
    #[error("\"{0}\" is not an ed25519 key; write it as \"ssh-ed25519 AAAA…\"")]
    NoPublicKey(String),
    /// Not a valid signature.
    #[error("not an SSH signature by an ed25519 key")]
    NoSignature,
    /// The signature is for another namespace.
    #[error("the signature is for \"{found}\", not for \"{wanted}\"")]
    Namespace {
        /// Namespace of the signature.
        found: String,
        /// Expected namespace.
        wanted: String,
    },
    /// The signature is by another key.
    #[error("it is signed with another key, {0}")]
    OtherKey(PublicKey),
    /// The signature does not match the content.
    #[error("the signature does not match the content: it was changed or truncated")]
    OtherContent,
}
