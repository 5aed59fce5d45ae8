//! Actions that a governor asks its driver to carry out.

use crate::channel::RequestChannel;
use crate::decider::QosEvent;
use crate::outcome::RequestOutcome;
use crate::request::{RequestId, Responder};

/// An action for the driver; actions are carried out in order.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect<P> {
    /// Send a message to one side.
    Give {
        /// The receiving side.
        side: Responder,
        /// The request it belongs to; `None` for messages that await no answer.
        request: Option<RequestId>,
        /// The channel to send it on.
        channel: RequestChannel,
        /// The message.
        payload: P,
    },
    /// Tell the application that no answer will come.
    Fail {
        /// The failed request.
        request: RequestId,
        /// The channel of the request.
        channel: RequestChannel,
        /// Error text for the caller.
        reason: String,
    },
    /// Publish the SLA's safe-stop message: no side has answered in time.
    SafeStop,
    /// The outcome of a request: reported when the cloud's time has counted, and again when more is known.
    Outcome(RequestOutcome),
    /// A decision about the local original.
    Event(QosEvent),
}
