//! How one request went.

use std::time::Duration;

use crate::channel::Channel;
use crate::phases::Phases;
use crate::request::{RequestId, Side, Stamp};

/// What is known of a request once the cloud's time of it has counted. It is told again, with the same id, when more
/// becomes known: an answer that came after T_max.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// The request that was completed.
    pub request: RequestId,
    /// What was asked.
    pub channel: Channel,
    /// The input's stamp, where answers are recognised by it.
    pub stamp: Option<Stamp>,
    /// The cloud's time from asked to answered; none while it has not answered.
    pub cloud: Option<Duration>,
    /// Whose answer the application was given, and after what time; none while nobody has answered.
    pub answer: Option<(Side, Duration)>,
    /// Where the cloud's time went, if that is known.
    pub phases: Option<Phases>,
    /// Q now.
    pub q: f64,
}
