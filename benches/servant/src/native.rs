//! The node alone: executed in a chroot of the same layers and an existing network, until it has registered.

#![allow(unsafe_code)]

use std::ffi::CString;
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::sched::{CloneFlags, setns};
use reach::ServantSockets;
use ros::ros1::master::{Master, MasterOptions};
use ros::ros1::process::MASTER;
use servant::netns::NetNs;
use tokio::runtime::Handle;

use crate::image::ServiceImage;
use crate::root::ImageRoot;

/// Maximum time until the node has registered.
const PATIENCE: Duration = Duration::from_secs(60);

/// Everything that exists before the node starts.
pub(crate) struct NativeNode<'a> {
    image: &'a ServiceImage,
    root: ImageRoot,
    network: Arc<NetNs>,
    runtime: &'a Handle,
}

impl<'a> NativeNode<'a> {
    /// Mounts the image below `place`.
    pub(crate) fn prepare(place: &Path, image: &'a ServiceImage, runtime: &'a Handle) -> Result<Self> {
        let root = ImageRoot::mount(place, &image.spec)?;
        root.mount_system()?;
        Ok(Self { image, root, network: Arc::new(NetNs::create()?), runtime })
    }

    /// Measures the time from exec until the node has registered.
    pub(crate) fn time_start(&self) -> Result<Duration> {
        let listener = self.runtime.block_on(self.network.listen(MASTER))?;
        let master = Master::new(MasterOptions::default());
        let sockets = Arc::new(ServantSockets::new(&self.network));
        let serving = {
            let master = master.clone();
            self.runtime.spawn(async move { master.serve(listener, sockets).await })
        };
        let begun = Instant::now();
        let mut child = self.spawn()?;
        let outcome = self.runtime.block_on(async {
            let registered = async {
                let mut changes = master.generation();
                while !self.image.is_registered(&master.graph()) {
                    changes.changed().await?;
                }
                anyhow::Ok(begun.elapsed())
            };
            tokio::time::timeout(PATIENCE, registered).await.context("the node did not register")?
        });
        let _ = child.kill();
        child.wait()?;
        serving.abort();
        // Frees the port for the next run.
        let _ = self.runtime.block_on(serving);
        outcome
    }

    fn spawn(&self) -> Result<Child> {
        let node = self.image.node()?;
        let (program, arguments) = node.argv.split_first().context("a program")?;
        let mut command = Command::new(program);
        command.args(arguments).env_clear().envs(&self.image.spec.environment).envs(&node.environment);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let network = self.network.as_fd().try_clone_to_owned()?;
        let root = CString::new(self.root.path().to_str().context("UTF-8")?)?;
        let directory = CString::new(if node.directory.is_empty() { "/" } else { node.directory.as_str() })?;
        let enter = move || {
            setns(&network, CloneFlags::CLONE_NEWNET)?;
            nix::unistd::chroot(root.as_c_str())?;
            nix::unistd::chdir(directory.as_c_str())?;
            Ok(())
        };
        // SAFETY: between fork and exec it makes three system calls and does not allocate.
        unsafe { command.pre_exec(enter) };
        command.spawn().with_context(|| format!("executing {program}"))
    }
}
