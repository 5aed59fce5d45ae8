//! The reason that the other end gives for a failure.

/// The reason for a failure, in words for people, as it comes over a wire or is sent over one: a node's own words for a
/// failed service call, a rejected goal, a refusal by the other end of a link. Nothing is decided by it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct FailureReason(String);

impl FailureReason {
    /// Returns a reason with this text. There is no `From<String>`, so that no text becomes an error by accident.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// Returns the text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns the text, owned.
    pub fn into_string(self) -> String {
        self.0
    }
}

impl From<FailureReason> for String {
    fn from(reason: FailureReason) -> Self {
        reason.0
    }
}
