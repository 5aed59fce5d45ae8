//! Reasons why a credential is not accepted.

use api::Millis;

use crate::tokens::AuthRefusal;

/// Reason why a token, session or sign-in is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AuthenticationError {
    /// The token was revoked.
    #[error("this token was revoked")]
    Revoked,
    /// The token has expired.
    #[error("this token has expired")]
    Expired,
    /// The token is unknown.
    #[error("this token is not known")]
    Unknown,
    /// The token was not looked at.
    #[error("too many unknown tokens came from this address; tokens are not checked for {} s", .0.div_ceil(1000))]
    Slowed(Millis),
    /// The password, or the result of a provider's sign-in, was not looked at.
    #[error(
        "too many failed sign-ins from this address or for this account; sign-ins are not checked for {} s",
        .0.div_ceil(1000)
    )]
    SlowedSignIn(Millis),
    /// The session is unknown or over.
    #[error("this session has ended")]
    SessionOver,
}

/// Reason why an `auth` message does not authenticate its sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AuthMessageError {
    /// The message was looked at and refused.
    #[error(transparent)]
    Refused(#[from] AuthRefusal),
    /// The token was refused, or not checked.
    #[error(transparent)]
    Token(#[from] AuthenticationError),
}

/// Reason why a certificate is not accepted although a trusted authority has signed it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CertificateRefusal {
    /// The certificate names no robot.
    #[error("{0}")]
    Nameless(String),
    /// The robot was never paired.
    #[error("robot {0} is not paired")]
    NotPaired(String),
    /// The robot was unpaired.
    #[error("robot {0} was unpaired")]
    Unpaired(String),
    /// The robot was paired again, with another key or another authority.
    #[error("robot {0} was paired again with another key than that of this certificate")]
    Replaced(String),
    /// The certificate has expired while the connection is open.
    #[error("the certificate of robot {0} has expired")]
    Expired(String),
}

/// Reason why a pairing code is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PairingCodeRefusal {
    /// The code is unknown.
    #[error("this pairing code is not known")]
    Unknown,
    /// The code is for another robot.
    #[error("this pairing code is for another robot")]
    Another,
    /// The code was used.
    #[error("this pairing code was already used")]
    Used,
    /// The code was cancelled or replaced by a newer one.
    #[error("this pairing code was cancelled or replaced by a newer one")]
    Cancelled,
    /// The code has expired.
    #[error("this pairing code has expired")]
    Expired,
}
