//! Reasons why resources of this host are not granted.

use std::io;
use std::path::PathBuf;

/// Reason why something is not granted.
#[derive(Debug, thiserror::Error)]
pub enum GrantError {
    /// The configuration does not allow it.
    #[error("{kind} {name} is not allowed here; the operator can add it to {kind}s in [allow] of the configuration")]
    NotAllowed {
        /// `device` or `volume`.
        kind: &'static str,
        /// Name of the device or volume.
        name: String,
    },
    /// Egress was refused.
    #[error(transparent)]
    Egress(Box<dyn std::error::Error + Send + Sync>),
    /// A volume does not exist or cannot be opened.
    #[error("volume {path} cannot be used: {source}")]
    Volume {
        /// Path on the host.
        path: String,
        /// Error of the system.
        source: io::Error,
    },
    /// No CDI specification names the device.
    #[error("no CDI specification in {directories} names the device {name}; there are: {known}")]
    UnknownDevice {
        /// Name that was asked for.
        name: String,
        /// Directories that were searched.
        directories: String,
        /// Known names, for people.
        known: String,
    },
    /// A CDI specification cannot be used.
    #[error("the CDI specification {path}: {reason}")]
    Specification {
        /// File of the specification.
        path: PathBuf,
        /// Description of the fault.
        reason: CdiError,
    },
}

/// Reason why a specification cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CdiError {
    /// The file cannot be read.
    #[error(transparent)]
    Unreadable(io::Error),
    /// The file is neither JSON nor YAML of a specification.
    #[error(transparent)]
    Malformed(serde_norway::Error),
    /// Malformed environment variable.
    #[error("{0:?} is not NAME=VALUE")]
    Variable(String),
    /// The device node cannot be examined.
    #[error("{}: {error}", .path.display())]
    Device {
        /// Path on the host.
        path: PathBuf,
        /// Error of the system.
        error: io::Error,
    },
    /// The file is no device node.
    #[error("{} is not a device node", .0.display())]
    NotADevice(PathBuf),
}
