//! The outcome of a request.

use std::time::Duration;

use crate::channel::RequestChannel;
use crate::phases::Phases;
use crate::request::{RequestId, Responder, Stamp};

/// The outcome of a request, reported once the cloud's time has counted. It is reported again, with the same id, when
/// more becomes known: an answer that came after T_max.
#[derive(Debug, Clone, PartialEq)]
pub struct RequestOutcome {
    /// The request.
    pub request: RequestId,
    /// The channel of the request.
    pub channel: RequestChannel,
    /// Stamp of the input, if answers are matched by it.
    pub stamp: Option<Stamp>,
    /// Response time of the cloud; `None` while it has not answered.
    pub cloud: Option<Duration>,
    /// The side whose answer was delivered to the application, and its response time; `None` without an answer.
    pub answer: Option<(Responder, Duration)>,
    /// Phases of the cloud's time, if known.
    pub phases: Option<Phases>,
    /// Q at this moment.
    pub q: f64,
}
