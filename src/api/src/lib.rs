//! Types of the HTTP API under `/api/v1`, shared by the daemon, the command line and the web page: plain serde types
//! without behaviour, except for parsing and printing sizes. Times are in milliseconds since 1970, sizes in bytes.
//!
//! A response is one of these types as JSON, a stream of them as JSON lines ([`NDJSON`]), or a [`problem::Problem`]
//! with the HTTP status that it contains.

pub mod access;
pub mod bases;
pub mod calibration;
mod count;
pub mod cpuset;
pub mod dictionary;
pub mod differences;
pub mod doctor;
pub mod event;
pub mod exec;
pub mod explain;
pub mod fit;
pub mod goals;
pub mod grants;
pub mod group;
pub mod history;
pub mod interface;
pub mod limits;
pub mod machines;
pub mod people;
pub mod problem;
pub mod push;
pub mod pushes;
pub mod recordings;
pub mod rollout;
pub mod servant;
pub mod service;
pub mod shadow;
pub mod size;
pub mod sla;
pub mod status;
pub mod stream;
pub mod stub;
pub mod topics;
pub mod trial;
pub mod underlays;

pub use calibration::{Calibration, CalibrationEvent, CalibrationOptions};
pub use count::count;
pub use cpuset::CpuSet;
pub use doctor::{Check, CheckStatus, Doctor};
pub use event::{EVENT_KINDS, Event, Level};
pub use fit::{Cost, Expected, Fit, UseForecast};
pub use grants::{Grants, Volume};
pub use group::{Group, GroupServant, Shared};
pub use interface::Interface;
pub use limits::{Caps, Limits, Pressure, Usage};
pub use problem::Problem;
pub use push::{PushEvent, PushOptions};
pub use pushes::{PushCount, PushState, PushStatus};
pub use rollout::Rollout;
pub use servant::{
    BackOff, KeptLog, LogLevel, LogLine, NodeDown, NodeStage, Phase, ResponseTimes, Servant, Stopped, Stream, Terms,
    TopicDrops,
};
pub use service::{Node, Revision, Rollback, ServiceDetail, ServiceSummary};
pub use shadow::{Shadow, ShadowEvent, ShadowOptions};
pub use size::Size;
pub use sla::{Measure, Sla, Span, Stated};
pub use status::{Capacity, Clock, Isolation, Status};
pub use stub::Stubs;
pub use underlays::{StandingService, Underlay};

/// Media type of streams: one JSON value per line.
pub const NDJSON: &str = "application/x-ndjson";

/// Milliseconds since 1970-01-01 UTC.
pub type Millis = u64;

/// Schemas of types that have no name of their own.
#[cfg(feature = "schema")]
pub mod schema {
    /// Milliseconds since 1970-01-01 UTC.
    #[derive(utoipa::ToSchema)]
    pub struct Millis(pub u64);
}
