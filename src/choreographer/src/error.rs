use api::Size;

use crate::decide::admission::AdmissionError;
use crate::decide::terms::TermsError;

/// Maximum number of nodes of one robot whose stubs may state something: statements are kept and stored for as long as
/// the servant lives.
pub(crate) const STATING: usize = 64;

/// The error of a servant that is not resized.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ResizeError {
    /// The terms cannot be granted.
    #[error(transparent)]
    Untenable(TermsError),
    /// There is no capacity for more.
    #[error(transparent)]
    Full(AdmissionError),
    /// The servant would be killed for lack of memory.
    #[error("it uses {used} of memory, more than the new limit {wanted}")]
    Used {
        /// Memory in use.
        used: Size,
        /// Memory limit that it would get.
        wanted: Size,
    },
    /// Too many clients of the robot have stated requirements.
    #[error("{STATING} nodes of its robot already have requests")]
    Many,
}

/// The error of a servant that cannot be started, used or changed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No servant has this id.
    #[error("no servant {id:?}")]
    UnknownServant {
        /// The requested id.
        id: String,
        /// Existing ids.
        exists: Vec<String>,
    },
    /// There is no capacity.
    #[error(transparent)]
    Full(#[from] AdmissionError),
    /// The robot's terms cannot be granted.
    #[error(transparent)]
    Terms(#[from] TermsError),
    /// The robot's new statement cannot be applied to its existing servant, which stays unchanged.
    #[error("servant {servant} of {service} cannot be resized for {stated}: {reason}")]
    NotResized {
        /// Id of the servant.
        servant: String,
        /// The service.
        service: String,
        /// The new statement.
        stated: String,
        /// The reason.
        reason: Box<ResizeError>,
    },
    /// The servant is a place in a group and has no container of its own.
    #[error(
        "{id} is the reservation of robot {robot} at the shared service {service}: it has no container; look at the \
            service's servants instead"
    )]
    Place {
        /// Id of the servant.
        id: String,
        /// The service.
        service: String,
        /// The robot.
        robot: String,
    },
    /// The servant could not be started, or ended.
    #[error("the servant of {service} for robot {robot} {reason}")]
    Servant {
        /// The service.
        service: String,
        /// The robot.
        robot: String,
        /// The failure, as a phrase that starts with a verb.
        reason: String,
        /// Last lines of its log.
        log: Vec<String>,
    },
    /// The robot's servants have failed repeatedly.
    #[error(
        "servants of {service} for robot {robot} have failed {failures} times in a row (last: {reason}); next start in \
            {} s at the earliest",
        crate::decide::back_off::seconds(*again)
    )]
    BackOff {
        /// The service.
        service: String,
        /// The robot.
        robot: String,
        /// Number of failures in a row.
        failures: u32,
        /// The last failure, as a phrase that starts with a verb.
        reason: String,
        /// Time after which the robot may ask again.
        again: std::time::Duration,
    },
    /// The service never had a rollout.
    #[error("{0} has no rollout")]
    NoRollout(String),
    /// The rollout cannot be started or changed.
    #[error("{0}")]
    Rollout(String),
    /// The daemon is shutting down.
    #[error("the daemon is shutting down")]
    Ending,
    /// The service cannot be calibrated.
    #[error("{0}")]
    Calibration(String),
    /// A calibrated servant needed more memory than allowed.
    #[error(
        "{service} needs more than {memory} of memory: the kernel killed it{}",
        if *ready { " during its requests" } else { " while it started" }
    )]
    OutOfMemory {
        /// The service.
        service: String,
        /// The memory limit.
        memory: api::Size,
        /// The servant had become ready.
        ready: bool,
    },
    /// The revision cannot be compared with what a robot uses.
    #[error("{0}")]
    Shadow(String),
    /// An error of the catalogue.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// An error of the state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// An error of the container engine.
    #[error(transparent)]
    Engine(#[from] servant::Error),
    /// An error when reaching a servant.
    #[error(transparent)]
    Reach(#[from] reach::Error),
    /// A task of the daemon failed.
    #[error("internal error of the daemon while {0}; see its log")]
    Internal(&'static str),
}

/// Appends the last non-empty line of a log to `text`.
pub fn with_last_log_line(text: &str, log: &[String]) -> String {
    match log.iter().rev().find(|line| !line.trim().is_empty()) {
        Some(line) => format!("{text}; its log ends with: {line}"),
        None => text.to_owned(),
    }
}
