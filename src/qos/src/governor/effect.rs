//! What a governor wants done.

use crate::channel::Channel;
use crate::decider::Event;
use crate::outcome::Outcome;
use crate::request::{RequestId, Side};

/// What is to be done, in this order.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect<P> {
    /// Hand this to one side.
    Give {
        /// The side that is asked.
        side: Side,
        /// The request it belongs to; none for messages that await no answer.
        request: Option<RequestId>,
        /// Where it goes.
        channel: Channel,
        /// The message.
        payload: P,
    },
    /// Tell the application that there will be no answer.
    Fail {
        /// The request that failed.
        request: RequestId,
        /// Where it was asked.
        channel: Channel,
        /// Error text for the caller.
        reason: String,
    },
    /// Publish the SLA's safe-stop message: nobody has answered in time.
    SafeStop,
    /// The cloud's time of a request has counted, or more is known of one whose has.
    Outcome(Outcome),
    /// A decision about the local original.
    Event(Event),
}
