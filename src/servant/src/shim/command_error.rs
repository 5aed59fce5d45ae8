//! Reasons why the shim does not carry out a command; the daemon gets their texts.

use std::io;

use init::StartStage;

use super::execs::ExecTableError;
use super::link::LinkError;
use super::nodes::NodeTableError;
use crate::Error;

/// Reason why a command is not carried out.
#[derive(Debug, thiserror::Error)]
pub(super) enum CommandError {
    /// The servant is being stopped, or has no init yet.
    #[error("it is ending")]
    Ending,
    #[error(transparent)]
    Node(#[from] NodeTableError),
    #[error(transparent)]
    Exec(#[from] ExecTableError),
    #[error(transparent)]
    Start(#[from] StartError),
    /// The request could not be sent to init.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// These limits could not be set.
    #[error("cannot be set: {}", .0.join(", "))]
    Limits(Vec<String>),
}

/// Reason why a node, or the program of an exec session, could not be started.
#[derive(Debug, thiserror::Error)]
pub(super) enum StartError {
    /// It cannot have its standard streams.
    #[error(transparent)]
    Streams(#[from] Error),
    /// The request could not be sent to init.
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error("its program could not be executed: {0}")]
    Execute(io::Error),
    #[error("its working directory could not be entered: {0}")]
    Directory(io::Error),
    #[error("fork: {0}")]
    Fork(io::Error),
    #[error("init could not prepare it: {0}")]
    Prepare(io::Error),
    #[error("its init ended before it was executed")]
    InitEnded,
}

impl StartError {
    /// Returns the error that init reports for a step of the start.
    pub(super) fn from_init(errno: i32, stage: StartStage) -> Self {
        let error = io::Error::from_raw_os_error(errno);
        match stage {
            StartStage::Execute => Self::Execute(error),
            StartStage::Directory => Self::Directory(error),
            StartStage::Fork => Self::Fork(error),
            StartStage::Request | StartStage::Prepare => Self::Prepare(error),
        }
    }
}
