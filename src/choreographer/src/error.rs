use api::Size;

use crate::decide::admission::Refused;
use crate::decide::terms::Untenable;

/// Nodes of one robot whose stubs may state something: what they say is kept, and written down, for as long as the servant lives.
pub(crate) const STATING: usize = 64;

/// Why a servant is not resized.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Unchanged {
    /// On no terms.
    #[error(transparent)]
    Untenable(Untenable),
    /// There is no room for more.
    #[error(transparent)]
    Full(Refused),
    /// It would be killed for want of memory.
    #[error("it uses {used} of memory, which is more than the {wanted} that it would have")]
    Used {
        /// What it uses.
        used: Size,
        /// What it would have.
        wanted: Size,
    },
    /// Too many clients of one robot state something.
    #[error("{STATING} nodes of its robot have stated something already")]
    Many,
}

/// Why a servant cannot be had, used or changed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No such servant.
    #[error("there is no servant {id:?}")]
    UnknownServant {
        /// Asked for.
        id: String,
        /// Names that exist.
        exists: Vec<String>,
    },
    /// There is no room.
    #[error(transparent)]
    Full(#[from] Refused),
    /// What the robot states cannot be had.
    #[error(transparent)]
    Terms(#[from] Untenable),
    /// What the robot states anew cannot be had by the servant that it has, which stays as it is.
    #[error("servant {servant} of {service} cannot be resized for {stated}: {reason}")]
    NotResized {
        /// Its id.
        servant: String,
        /// Its service.
        service: String,
        /// What was stated.
        stated: String,
        /// What stood against it.
        reason: Box<Unchanged>,
    },
    /// It has no container of its own.
    #[error(
        "{id} is the place of robot {robot} at {service}, which robots share: it has no container, and what it uses is its servants'"
    )]
    Place {
        /// Its id.
        id: String,
        /// The service.
        service: String,
        /// The robot.
        robot: String,
    },
    /// The servant could not be started, or ended.
    #[error("the servant of {service} for robot {robot} {reason}")]
    Servant {
        /// Its service.
        service: String,
        /// Its robot.
        robot: String,
        /// What happened, beginning with a verb.
        reason: String,
        /// Last lines of its log.
        log: Vec<String>,
    },
    /// Its servants have failed again and again.
    #[error(
        "servants of {service} for robot {robot} have failed {failures} times in a row (the last one {reason}); the next is started in {} s at the earliest",
        crate::decide::back_off::seconds(*again)
    )]
    BackOff {
        /// The service.
        service: String,
        /// The robot.
        robot: String,
        /// How often.
        failures: u32,
        /// What happened last, beginning with a verb.
        reason: String,
        /// After this time it may ask again.
        again: std::time::Duration,
    },
    /// The service was never on its way to another revision.
    #[error("{0} is on its way to no other revision, nor was it")]
    NoRollout(String),
    /// A rollout cannot be begun or changed so.
    #[error("{0}")]
    Rollout(String),
    /// The daemon is ending.
    #[error("the daemon is ending")]
    Ending,
    /// A service cannot be calibrated so.
    #[error("{0}")]
    Calibration(String),
    /// A servant that is measured needed more memory than it was to be measured with.
    #[error(
        "{service} needs more than {memory} of memory: the kernel has ended it{}",
        if *ready { " at its requests" } else { " while it started" }
    )]
    OutOfMemory {
        /// The service.
        service: String,
        /// What it may use.
        memory: api::Size,
        /// It had started.
        ready: bool,
    },
    /// A revision cannot be compared so with what a robot uses.
    #[error("{0}")]
    Shadow(String),
    /// What is published.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// The state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// The engine.
    #[error(transparent)]
    Engine(#[from] servant::Error),
    /// Reaching a servant.
    #[error(transparent)]
    Reach(#[from] reach::Error),
    /// A task of the daemon broke.
    #[error("the daemon failed at {0}; its log says more")]
    Internal(&'static str),
}

/// `text` and the last line of a log that says something.
pub fn with_last_words(text: &str, log: &[String]) -> String {
    match log.iter().rev().find(|line| !line.trim().is_empty()) {
        Some(line) => format!("{text}; its log ends with: {line}"),
        None => text.to_owned(),
    }
}
