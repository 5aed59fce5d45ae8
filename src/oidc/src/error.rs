//! Why nobody is signed in.

/// Characters of what a provider says that are passed on.
const LONGEST: usize = 300;

/// Why nobody is signed in.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// An address that is none, or that others could read on the way.
    #[error(
        "{0:?} is no address of a provider; write https://HOST/PATH (http:// is for this machine alone), without query"
    )]
    NoAddress(String),
    /// The provider gives no answer, or none that can be used.
    #[error("the identity provider {issuer} cannot be asked: {reason}")]
    Unreachable {
        /// Its issuer identifier.
        issuer: String,
        /// The cause.
        reason: String,
    },
    /// Too many sign in at once.
    #[error("too many people sign in at once")]
    Busy,
    /// The state is unknown.
    #[error("this sign-in was not begun here, is over, or took longer than 10 minutes")]
    UnknownState,
    /// Another browser began it.
    #[error("this sign-in was begun in another browser")]
    OtherBrowser,
    /// The provider says that nobody signed in (section 3.1.2.6).
    #[error("the identity provider refused: {reason}")]
    Denied {
        /// In its words.
        reason: String,
    },
    /// The provider does not know the code.
    #[error("the identity provider does not take its code back: {reason}")]
    Code {
        /// In its words.
        reason: String,
    },
    /// The provider does not know this server.
    #[error("the identity provider {issuer} refuses this server: {reason}")]
    Client {
        /// Its issuer identifier.
        issuer: String,
        /// In its words.
        reason: String,
    },
    /// What the provider says of the person cannot be believed.
    #[error("the ID token of {issuer} is not good: {reason}")]
    Token {
        /// Its issuer identifier.
        issuer: String,
        /// What is wrong.
        reason: String,
    },
}

impl Error {
    /// What the provider says that it is refused for.
    pub fn denied(reason: &str) -> Error {
        Error::Denied {
            reason: cut(reason),
        }
    }

    /// Whether it is for an operator to look at.
    pub fn is_providers(&self) -> bool {
        matches!(
            self,
            Error::Unreachable { .. } | Error::Client { .. } | Error::Token { .. }
        )
    }

    /// Whether somebody may have made it up who tries many.
    pub fn is_guess(&self) -> bool {
        matches!(
            self,
            Error::UnknownState | Error::OtherBrowser | Error::Code { .. }
        )
    }

    /// What to do.
    pub fn next(&self) -> &'static str {
        match self {
            Error::NoAddress(_) => "correct [oidc] of the configuration",
            Error::Unreachable { .. } => {
                "try again later; an operator looks at issuer in [oidc] of the configuration, and at the provider; accounts and tokens work on"
            }
            Error::Busy => "try again later",
            Error::UnknownState | Error::OtherBrowser | Error::Code { .. } => {
                "sign in again from the portal's page, in one browser that takes cookies"
            }
            Error::Denied { .. } => "sign in again, or ask who runs the identity provider",
            Error::Client { .. } => {
                "compare client_id and client_secret_file in [oidc] of the configuration with what the provider has for this server"
            }
            Error::Token { .. } => {
                "sign in again; if it is so again, compare issuer and client_id in [oidc] of the configuration with the provider's, and both clocks"
            }
        }
    }
}

/// What others say, for a message: of a bounded length, in a line.
pub(crate) fn cut(text: &str) -> String {
    let plain = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    plain.take(LONGEST).collect()
}

/// An error with what caused it.
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
