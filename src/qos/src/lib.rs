//! Quality of service on the robot: pure decisions, no I/O, no threads; the time is passed in.
//!
//! ```text
//!   calls, goals, inputs ──▶ ┌──────────┐ ──▶ ask the cloud, the local original, or both
//!   answers, outputs     ──▶ │ Governor │ ──▶ deliver or drop, exactly one answer per request
//!   link, local original ──▶ │          │ ──▶ start, feed, stop feeding, stop the local original
//!   the time             ──▶ └──────────┘ ──▶ failures, safe stop, a report
//! ```
//! The parts, each usable alone: [`Sla`] is what the robot was promised; [`Satisfaction`] is the algorithm that judges
//! the cloud; a [`Pair`] tells which input triggers which output; `Arbiter` knows for each request who was asked and
//! who answered; [`Decider`] runs the local original; [`PhaseBook`] says where the time of a request goes. A
//! [`Governor`] is all of them for one node.
//!
//! The local original of a stateless service, as `local = "cold"` and `local = "warm"` have it:
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

pub use arbiter::{Limits, Verdict};
pub use channel::Channel;
pub use decider::{Decider, Event, LocalState, Why};
pub use governor::{Effect, Governor};
pub use hand_over::{HandOver, Ledger, Missed};
pub use measure::Meter;
pub use outcome::Outcome;
pub use pair::{Correlation, Pair};
pub use phases::{PhaseBook, Phases, Quantiles};
pub use quantile::nearest_rank;
pub use report::{Counts, Report, TimedEvent};
pub use request::{Failure, Key, Leg, RequestId, Side, Sides, Stamp};
pub use satisfaction::{DEFAULT_CAP, Satisfaction, Step};
pub use sla::{Local, Measure, Mode, SafeStop, Sla, Warm};
pub use sla_error::SlaError;
pub use span::{NotASpan, Span};
