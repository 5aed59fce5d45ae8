//! The error of an invalid SLA.

/// An invalid field of an SLA.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {reason}")]
pub struct SlaError {
    /// Path of the field, such as `t_max` or `measure.age.max`.
    pub field: String,
    /// The problem, and what to write instead.
    pub reason: String,
}

impl SlaError {
    pub(crate) fn new(field: &str, reason: impl Into<String>) -> Self {
        Self { field: field.to_owned(), reason: reason.into() }
    }
}
