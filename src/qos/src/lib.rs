//! Quality of service on the robot: decisions as pure code, without I/O and threads; the caller passes the time in.
//!
//! ```text
//!   calls, goals, inputs ──▶ ┌──────────┐ ──▶ ask the cloud, the local original, or both
//!   answers, outputs     ──▶ │ Governor │ ──▶ deliver or drop, exactly one answer per request
//!   link, local original ──▶ │          │ ──▶ start, feed, stop feeding, stop the local original
//!   the time             ──▶ └──────────┘ ──▶ failures, safe stop, a report
//! ```
//! The parts, each usable alone: [`QosSla`] holds the goals and policies; [`Satisfaction`] is the algorithm that rates
//! the cloud; a [`TopicPair`] says which input triggers which output; `Arbiter` tracks for each request which sides
//! were asked and which answered; [`Decider`] decides about the local original; [`PhaseHistory`] records where the time
//! of requests goes. A [`Governor`] combines all of them for one node.
//!
//! The states of the local original of a stateless service, for `local = "cold"` and `local = "warm"`:
//! ```text
//!            Q < Q_t: Start             ready: Feed
//!  stopped ─────────────────▶ starting ─────────────▶ fed      cold
//!     ▲                                                │
//!     └──────────── Q > Q_t: StopFeeding, Stop ────────┘
//!
//!            at once: Start            Q < Q_t: Feed
//!  stopped ─────────────────▶ ready  ⇄──────────────▶ fed      warm
//!                                   Q > Q_t: StopFeeding
//! ```

#![forbid(unsafe_code)]

mod arbiter;
mod channel;
mod decider;
mod governor;
mod hand_over;
mod measure;
mod outcome;
mod pair;
mod phases;
mod quantile;
mod report;
mod request;
mod satisfaction;
mod sla;
mod sla_error;
mod span;

pub use arbiter::{DeliveryVerdict, RetentionLimits};
pub use channel::RequestChannel;
pub use decider::{Decider, DecisionReason, LocalState, QosEvent};
pub use governor::{Effect, Governor, OutputAge};
pub use hand_over::{HandOver, HandOverLedger, MissedInputs};
pub use measure::Meter;
pub use outcome::RequestOutcome;
pub use pair::{Correlation, ParsePairError, TopicPair};
pub use phases::{PhaseHistory, Phases, Quantiles};
pub use quantile::nearest_rank;
pub use report::{QosReport, RequestCounts, TimedEvent};
pub use request::{CorrelationKey, Failure, RequestId, RequestLeg, Responder, Responders, Stamp};
pub use satisfaction::{DEFAULT_CAP, ResponseGrade, Satisfaction};
pub use sla::{LocalPolicy, Measure, Mode, QosSla, SafeStop, WarmStart};
pub use sla_error::SlaError;
pub use span::{ParseSpanError, Span};
