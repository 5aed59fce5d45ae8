//! Errors of a sign-in.

/// Maximum length in characters of provider messages that are passed on.
const LONGEST: usize = 300;

/// Reason why a sign-in failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The URL is invalid or would be sent in plain text.
    #[error(
        "{0:?} is not the address of a provider; write https://HOST/PATH without a query (http:// only for this \
            machine)"
    )]
    NoAddress(String),
    /// The provider did not answer, or its answer is unusable.
    #[error("cannot reach the identity provider {issuer}: {reason}")]
    Unreachable {
        /// Issuer identifier of the provider.
        issuer: String,
        /// Underlying error.
        reason: String,
    },
    /// The limit of concurrent sign-ins is reached.
    #[error("too many sign-ins at once")]
    Busy,
    /// The state is unknown.
    #[error("this sign-in was not started here, is already finished, or took longer than 10 minutes")]
    UnknownState,
    /// The sign-in was started in another browser.
    #[error("this sign-in was started in another browser")]
    OtherBrowser,
    /// The provider reported that the sign-in failed (section 3.1.2.6).
    #[error("the identity provider refused: {reason}")]
    Denied {
        /// The provider's message.
        reason: String,
    },
    /// The provider rejected the authorization code.
    #[error("the identity provider rejected its own code: {reason}")]
    Code {
        /// The provider's message.
        reason: String,
    },
    /// The provider rejected this server's client credentials.
    #[error("the identity provider {issuer} rejected this server: {reason}")]
    Client {
        /// Issuer identifier of the provider.
        issuer: String,
        /// The provider's message.
        reason: String,
    },
    /// The ID token or userinfo failed verification.
    #[error("the ID token of {issuer} is invalid: {reason}")]
    Token {
        /// Issuer identifier of the provider.
        issuer: String,
        /// Description of what is wrong.
        reason: String,
    },
}

impl Error {
    /// Creates the error for a sign-in that the provider refused.
    pub fn from_denial(reason: &str) -> Error {
        Error::Denied { reason: sanitize(reason) }
    }

    /// Returns true if an operator has to look into it.
    pub fn is_provider_fault(&self) -> bool {
        matches!(self, Error::Unreachable { .. } | Error::Client { .. } | Error::Token { .. })
    }

    /// Returns true if the error may be the result of guessing.
    pub fn is_guess(&self) -> bool {
        matches!(self, Error::UnknownState | Error::OtherBrowser | Error::Code { .. })
    }

    /// Returns what the person should do next.
    pub fn next_step(&self) -> &'static str {
        match self {
            Error::NoAddress(_) => "correct [oidc] of the configuration",
            Error::Unreachable { .. } => {
                "try again later, or ask an operator to check issuer in [oidc] of the configuration, and the provider; \
                    accounts and tokens still work"
            }
            Error::Busy => "try again later",
            Error::UnknownState | Error::OtherBrowser | Error::Code { .. } => {
                "sign in again from the portal's page, in one browser with cookies enabled"
            }
            Error::Denied { .. } => "sign in again, or ask the operator of the identity provider",
            Error::Client { .. } => {
                "compare client_id and client_secret_file in [oidc] of the configuration with the settings of the \
                    provider for this server"
            }
            Error::Token { .. } => {
                "sign in again; if it fails again, compare issuer and client_id in [oidc] of the configuration with \
                    the provider's, and both clocks"
            }
        }
    }
}

/// Sanitizes third-party text for a message: limits its length and replaces control characters by blanks.
pub(crate) fn sanitize(text: &str) -> String {
    let plain = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    plain.take(LONGEST).collect()
}

/// Formats an error with its causes.
pub(crate) fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let more = error.to_string();
        if !text.ends_with(&more) {
            text = format!("{text}: {more}");
        }
        cause = error.source();
    }
    text
}
