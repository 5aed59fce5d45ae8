//! Startup of a servant: its resident, its container, its init, its nodes.

use std::io;
use std::os::fd::OwnedFd;
use std::time::Duration;

use init::InitReply;
use tokio::io::AsyncReadExt;
use tokio::net::unix::pipe;

use super::Driver;
use crate::engine::ContainerState;
use crate::shim::create::{CreationError, Creator};
use crate::shim::input::ShimEvent;
use crate::shim::nodes::NodeTableError;
use crate::shim::{ResidentContext, ResidentError, privileges};
use crate::{Error, sys};

/// Time for libcontainer and init. Generous, since a loaded machine is no failure.
const CREATION: Duration = Duration::from_secs(60);

/// Reason why a servant did not start.
#[derive(Debug, thiserror::Error)]
pub(super) enum BringUpError {
    #[error(transparent)]
    Creation(#[from] CreationError),
    /// The creator's report cannot be read.
    #[error(transparent)]
    Report(io::Error),
    /// The creator's report cannot be read without waiting.
    #[error(transparent)]
    ReportFlags(nix::Error),
    #[error("it was not created within {} s", CREATION.as_secs())]
    CreationLate,
    #[error("pidfd of init: {0}")]
    Pidfd(io::Error),
    #[error("its resident did not start: {0}")]
    Resident(ResidentError),
    /// The shim could not give up its privileges.
    #[error(transparent)]
    Confinement(Error),
    #[error("init did not come up but said {0:?}")]
    InitReply(Option<(InitReply, Option<OwnedFd>)>),
    #[error("init did not come up: {0}")]
    Init(io::Error),
    #[error("init did not come up within {} s", CREATION.as_secs())]
    InitLate,
    #[error(transparent)]
    Node(#[from] NodeTableError),
}

impl Driver {
    /// Starts resident, container and nodes.
    pub(super) async fn bring_up(&mut self) -> Result<(), BringUpError> {
        let context = ResidentContext {
            id: self.begun.launch.spec.id.clone(),
            config: self.begun.launch.spec.resident.clone(),
            directory: self.begun.directory.clone(),
        };
        // The creator works meanwhile, in its own process.
        let resident = self.resident.start(&context).await;
        let created = self.wait_for_creator().await;
        if let Ok(pid) = created {
            // Our child, not reaped yet, so the pid is certainly its own.
            let pidfd = sys::pidfd_open(pid).map_err(BringUpError::Pidfd)?;
            self.init = Some((pid, pidfd));
        }
        created?;
        resident.map_err(BringUpError::Resident)?;
        let cgroups = [&self.begun.cgroup, &self.begun.shim_cgroup];
        privileges::confine(&self.begun.directory, cgroups).map_err(BringUpError::Confinement)?;
        let ready = tokio::time::timeout(CREATION, self.link.receive()).await;
        match ready {
            Ok(Ok(Some((InitReply::Ready, _)))) => {}
            Ok(Ok(other)) => return Err(BringUpError::InitReply(other)),
            Ok(Err(error)) => return Err(BringUpError::Init(error)),
            Err(_) => return Err(BringUpError::InitLate),
        }
        self.listen_to_init();
        self.set_state(ContainerState::Running);
        for node in self.begun.launch.spec.nodes.clone() {
            let name = node.name.clone();
            self.nodes.add(node)?;
            self.start_node(&name).await;
        }
        // Only needed for the startup.
        self.begun.launch.spec.layers = Vec::new();
        self.begun.launch.spec.nodes = Vec::new();
        self.begun.launch.spec.resident = serde_json::Value::Null;
        sys::trim_heap();
        Ok(())
    }

    /// Waits for the creator; returns the host pid of init.
    pub(super) async fn wait_for_creator(&mut self) -> Result<i32, BringUpError> {
        let report = &self.begun.creator.report;
        let report = report.try_clone().map_err(BringUpError::Report)?;
        let set = nix::fcntl::FcntlArg::F_SETFL(nix::fcntl::OFlag::O_NONBLOCK);
        nix::fcntl::fcntl(&report, set).map_err(BringUpError::ReportFlags)?;
        let mut report = pipe::Receiver::from_owned_fd(report).map_err(BringUpError::Report)?;
        let mut text = Vec::new();
        let read = async {
            // An error may be followed by others until the end of the report; success is reported once.
            while !Creator::has_succeeded(&text) && report.read_buf(&mut text).await.is_ok_and(|length| length > 0) {}
        };
        let in_time = tokio::time::timeout(CREATION, read).await.is_ok();
        match Creator::outcome(&String::from_utf8_lossy(&text)) {
            Err(_) if !in_time && text.is_empty() => Err(BringUpError::CreationLate),
            outcome => Ok(outcome?),
        }
    }

    pub(super) fn listen_to_init(&self) {
        let (link, inputs) = (self.link.clone(), self.inputs.clone());
        tokio::task::spawn_local(async move {
            // The end of init is reported by the kernel, as that of a child.
            while let Ok(Some((reply, fd))) = link.receive().await {
                if inputs.send(ShimEvent::Init(reply, fd)).is_err() {
                    return;
                }
            }
        });
    }
}
