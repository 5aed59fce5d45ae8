//! Ed25519 signatures (RFC 8032) in the form of OpenSSH's `ssh-keygen -Y` (PROTOCOL.sshsig), which robots verify with
//! what they have.
//!
//! ```text
//!  HOME/signing.pem ─▶ SigningKey ──sign──▶ -----BEGIN SSH SIGNATURE----- ──PublicKey::verify, ssh-keygen -Y verify
//! ```

#![forbid(unsafe_code)]

mod key;
mod signature;
mod wire;

pub use key::{PublicKey, SigningKey};
pub use signature::{digest, in_a_line, in_lines};

/// Why a key or a signature is of no use.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file system refused.
    #[error("cannot {action} {path}: {source}", path = .path.display())]
    Io {
        /// What was being done.
        action: &'static str,
        /// The key's file.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file holds no key.
    #[error(
        "{path} holds no ed25519 key (PKCS #8 in PEM); put the right one back, or remove it to get another, which robots then \
         have to be told (install.sh --key)",
        path = .0.display()
    )]
    NoKey(std::path::PathBuf),
    /// No random numbers.
    #[error("the system gives no random numbers for a key")]
    NoRandom,
    /// A public key that is none.
    #[error("\"{0}\" is no ed25519 key; it is written as \"ssh-ed25519 AAAA…\"")]
    NoPublicKey(String),
    /// What should be a signature is none.
    #[error("it is no SSH signature by an ed25519 key")]
    NoSignature,
    /// It is for something else.
    #[error("the signature is one of \"{found}\", not of \"{wanted}\"")]
    Namespace {
        /// What it was made for.
        found: String,
        /// What it should have been made for.
        wanted: String,
    },
    /// It is somebody else's.
    #[error("it is signed by another key, {0}")]
    OtherKey(PublicKey),
    /// What is signed is not what is there.
    #[error("the signature is of other content: it was changed, or broke off on its way")]
    OtherContent,
}
