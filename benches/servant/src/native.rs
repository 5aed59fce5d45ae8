//! The node alone: executed in a chroot of the same layers, in a network namespace that is there already, until it has
//! registered with the same Master that servants have.

#![allow(unsafe_code)]

use std::ffi::CString;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use async_trait::async_trait;
use nix::sched::{CloneFlags, setns};
use ros::net::Sockets;
use ros::ros1::master::{Master, MasterOptions};
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;

use crate::image::Image;
use crate::root::Root;

/// Where every servant's Master listens.
const MASTER: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 11311);
/// How long the node may take.
const PATIENCE: Duration = Duration::from_secs(60);

/// Everything that is ready before the node starts.
pub(crate) struct Native<'a> {
    image: &'a Image,
    root: Root,
    network: Arc<NetNs>,
    runtime: &'a Handle,
}

struct Inside(Arc<NetNs>);

#[async_trait]
impl Sockets for Inside {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.0.listen(address).await
    }
}

impl<'a> Native<'a> {
    /// Mounts the image below `place`.
    pub(crate) fn prepare(place: &Path, image: &'a Image, runtime: &'a Handle) -> Result<Self> {
        let root = Root::mount(place, &image.spec)?;
        root.furnish()?;
        Ok(Self {
            image,
            root,
            network: Arc::new(NetNs::create()?),
            runtime,
        })
    }

    /// From exec to registered.
    pub(crate) fn time(&self) -> Result<Duration> {
        let listener = self.runtime.block_on(self.network.listen(MASTER))?;
        let master = Master::new(MasterOptions::default());
        let sockets = Arc::new(Inside(self.network.clone()));
        let serving = {
            let master = master.clone();
            self.runtime
                .spawn(async move { master.serve(listener, sockets).await })
        };
        let begun = Instant::now();
        let mut child = self.spawn()?;
        let outcome = self.runtime.block_on(async {
            let registered = async {
                let mut changes = master.generation();
                while !self.image.registered(&master.graph()) {
                    changes.changed().await?;
                }
                anyhow::Ok(begun.elapsed())
            };
            tokio::time::timeout(PATIENCE, registered)
                .await
                .context("the node did not register")?
        });
        let _ = child.kill();
        child.wait()?;
        serving.abort();
        // Its end frees the port for the next.
        let _ = self.runtime.block_on(serving);
        outcome
    }

    fn spawn(&self) -> Result<Child> {
        let node = self.image.node()?;
        let (program, arguments) = node.argv.split_first().context("a program")?;
        let mut command = Command::new(program);
        command
            .args(arguments)
            .env_clear()
            .envs(&self.image.spec.environment)
            .envs(&node.environment);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let network = self.network.as_fd().try_clone_to_owned()?;
        let root = CString::new(self.root.path().to_str().context("UTF-8")?)?;
        let directory = CString::new(if node.directory.is_empty() {
            "/"
        } else {
            node.directory.as_str()
        })?;
        let enter = move || {
            setns(&network, CloneFlags::CLONE_NEWNET)?;
            nix::unistd::chroot(root.as_c_str())?;
            nix::unistd::chdir(directory.as_c_str())?;
            Ok(())
        };
        // SAFETY: between fork and exec it makes three system calls and allocates nothing.
        unsafe { command.pre_exec(enter) };
        command
            .spawn()
            .with_context(|| format!("executing {program}"))
    }
}
