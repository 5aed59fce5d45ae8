use api::Size;
use api::limits::UnusableLimits;
use api::push::ParsePairError;
use api::sla::Unstatable;

use crate::supplement::SupplementError;

/// Errors of pushing, rolling back and removing services.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The name belongs to a service of another package.
    #[error("the service name {name} is taken: its package is {package}, not {newcomer}")]
    NameTaken {
        /// Name of the service.
        name: String,
        /// Package of the existing service.
        package: String,
        /// Package that was pushed.
        newcomer: String,
    },
    /// The deployer is not allowed to publish the service.
    #[error("{0}")]
    NotAllowed(String),
    /// Invalid options.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The push failed.
    #[error("{message}")]
    Failed {
        /// Description of the failure.
        message: String,
        /// Suggested next step.
        next: Option<String>,
        /// Log lines that explain the failure.
        log: Vec<String>,
    },
    /// The base does not exist.
    #[error("there is no base {name:?}")]
    UnknownBase {
        /// Name that was requested.
        name: String,
        /// Names of existing bases.
        exists: Vec<String>,
    },
    /// The underlay does not exist, as far as the caller may know.
    #[error("there is no underlay {name:?}")]
    UnknownUnderlay {
        /// Name that was requested.
        name: String,
        /// Names of existing ones that the caller may see.
        exists: Vec<String>,
    },
    /// Services stand on the underlay.
    #[error("{services} stand on underlay {name}: without it they cannot be pushed again")]
    UnderlayInUse {
        /// Name of the underlay.
        name: String,
        /// Services that stand on it.
        services: String,
    },
    /// The record of an underlay cannot be read.
    #[error("the record of underlay {name} cannot be read: {source}")]
    UnderlayRecord {
        /// Name of the underlay.
        name: String,
        /// Reason.
        source: serde_json::Error,
    },
    /// The base has not been set up, so there is nothing to export.
    #[error("{0}")]
    BaseNotSetUp(String),
    /// The base was not imported.
    #[error("{0}")]
    BaseNotImported(String),
    /// The name of a new base is taken.
    #[error("{0}")]
    BaseExists(String),
    /// The archive is too large.
    #[error("the archive is larger than {limit}")]
    TooLarge {
        /// Maximum size.
        limit: api::Size,
    },
    /// Somebody cancelled the push.
    #[error("the push was cancelled; nothing was published")]
    Cancelled,
    /// The daemon is shutting down.
    #[error("the daemon is shutting down")]
    Ending,
    /// Error of the choreographer.
    #[error(transparent)]
    Choreographer(#[from] choreographer::Error),
    /// Error of the catalogue.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// Error of the state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// Error of the image store.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// Error of the container engine.
    #[error(transparent)]
    Engine(#[from] servant::Error),
    /// A task of the daemon panicked.
    #[error("internal error of the daemon while {0}; see its log")]
    Internal(&'static str),
}

/// Options of a push that are invalid or exclude each other.
#[derive(Debug, thiserror::Error)]
pub enum OptionsError {
    /// Invalid limits.
    #[error(transparent)]
    Limits(#[from] UnusableLimits),
    /// Invalid upper limits on what robots may request.
    #[error("max_{0}")]
    Caps(UnusableLimits),
    /// The cores are more than robots may request.
    #[error("--cpus {cpus} is more than --max-cpus {most}; lower it, or raise --max-cpus")]
    CpusAboveCap {
        /// Number of cores.
        cpus: f64,
        /// Upper limit.
        most: f64,
    },
    /// The memory is more than robots may request.
    #[error("--memory {memory} is more than --max-memory {most}; lower it, or raise --max-memory")]
    MemoryAboveCap {
        /// Amount of memory.
        memory: Size,
        /// Upper limit.
        most: Size,
    },
    /// Contradictory default SLA.
    #[error("--{0}")]
    Sla(Unstatable),
    /// The default SLA has measures that no push can set.
    #[error("sla may have only rrt and max_rrt; the robot sets rates and ages in its stub.toml")]
    SlaMeasures,
    /// Malformed request pair.
    #[error("--request {0}")]
    RequestPair(ParsePairError),
    /// Request pairs that do not fit the interface.
    #[error("--request: {0}")]
    Requests(package::Error),
    /// Invalid additions to the interface.
    #[error("the interface supplement: {0}")]
    Supplement(Box<SupplementError>),
    /// A key of a parameter or launch argument that is no name.
    #[error("{what} {name:?} is no name; write the name alone as the key, such as {:?}", suggest_name(name))]
    ParameterName {
        /// `parameter` or `launch argument`.
        what: &'static str,
        /// The key.
        name: String,
    },
    /// A value of `--packages-up-to` or `--packages-skip` that is no name of a package.
    #[error("{option}: {name:?} is not a package name: a letter, then letters, digits, _ and -")]
    PackageName {
        /// The option.
        option: &'static str,
        /// The value.
        name: String,
    },
    /// A name of an underlay that is none.
    #[error("{option}: {problem}")]
    UnderlayName {
        /// The option.
        option: &'static str,
        /// Reason.
        problem: catalogue::names::NameError,
    },
    /// Options that are about a service.
    #[error(
        "--as-underlay takes only what is about building: --on, --base, --map, --with, --packages-up-to, \
         --packages-skip and --cmake-args; nothing of an underlay is run"
    )]
    AsUnderlay,
    /// Too many values of an option.
    #[error("{option} may be given at most {most} times")]
    TooMany {
        /// The option.
        option: &'static str,
        /// Maximum number.
        most: usize,
    },
    /// An argument that cannot be passed to CMake.
    #[error("--cmake-args {argument:?}: {problem}")]
    CmakeArgument {
        /// The argument.
        argument: String,
        /// Description of the problem.
        problem: &'static str,
    },
    /// A stateful service cannot be shared.
    #[error(
        "--stateful and --shared exclude each other: in a shared servant, answers would depend on other robots' \
            earlier requests"
    )]
    StatefulShared,
    /// Invalid number of servants to begin with.
    #[error("--replicas {replicas} should be between 1 and --max, which is {max}")]
    Replicas {
        /// Number of servants.
        replicas: u32,
        /// Maximum number of servants.
        max: u32,
    },
    /// Invalid range of the number of servants.
    #[error("--min {min} and --max {max} should satisfy 1 <= MIN <= MAX <= {most}")]
    ServantRange {
        /// Minimum number of servants.
        min: u32,
        /// Maximum number of servants.
        max: u32,
        /// Upper limit of both.
        most: u32,
    },
    /// Invalid number of concurrent calls.
    #[error("--calls {calls} should be between 1 and {most}")]
    Calls {
        /// Number of concurrent calls of a servant.
        calls: u32,
        /// Upper limit.
        most: u32,
    },
    /// Options that an exported service determines.
    #[error(
        "an exported service includes its start commands and limits; only its name and the rollout options can be given"
    )]
    Exported,
}

/// Returns the part of a key that may be meant as the name: `rate` of `rate:` and of `rate:=1`.
fn suggest_name(key: &str) -> &str {
    let end = key.find(|c: char| c == ':' || c == '=' || c.is_whitespace());
    match &key[..end.unwrap_or(key.len())] {
        "" => "rate",
        name => name,
    }
}

#[cfg(test)]
impl Error {
    /// Returns the message and the advice of a failed push.
    pub(crate) fn message_and_advice(self) -> String {
        let Error::Failed { message, next, .. } = self else {
            panic!("{self} is not a failed push");
        };
        format!("{message}; {}", next.unwrap_or_default())
    }
}
