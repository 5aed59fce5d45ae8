//! Ages of an output.

use std::time::Duration;

/// Ages of an output when it arrives.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct OutputAge {
    /// Time since the stamp of the input that it answers; zero if unknown.
    pub since_stamp: Duration,
    /// Time since the newest input that its node had been given when it published the output; `None` if unknown.
    pub since_input: Option<Duration>,
}

impl From<Duration> for OutputAge {
    fn from(since_stamp: Duration) -> Self {
        Self { since_stamp, since_input: None }
    }
}
