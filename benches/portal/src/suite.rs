//! rosbridge_suite, which Debian does not package: where `CLOUDROID_ROSBRIDGE_SUITE` names a directory with the sources of its packages for ROS 1,
//! and of rosauth, which they need, its server runs in the servant beside the node.

use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use bench_servant::Daemon;
use ros::net::Sockets;

use crate::line::Line;
use crate::node::{Inside, Node};

/// What reports call it.
pub(crate) const NAME: &str = "rosbridge_suite";
const SOURCES: &str = "CLOUDROID_ROSBRIDGE_SUITE";
/// Where its server listens, inside the servant.
const ADDRESS: &str = "127.0.0.1:9090";
/// The server; publishers of clients that have left are taken back at once.
const SERVER: &str = "rosbridge_server/rosbridge_websocket.py _port:=9090 _address:=127.0.0.1 _unregister_timeout:=0.1";

/// Publishes the fixture's node and the server as one service; without the sources, says why not.
pub(crate) fn push(daemon: &Daemon, fixture: &Path) -> Result<()> {
    let sources = std::env::var_os(SOURCES).map(PathBuf::from);
    let sources = sources.with_context(|| {
        format!(
            "Debian does not package it; {SOURCES} may name a directory with its sources for ROS 1 and those of rosauth"
        )
    })?;
    eprintln!("pushing rosbridge_fixture with {NAME}: it is compiled");
    let workspace = daemon.place().join("with_suite");
    let packages = workspace.join("src");
    std::fs::create_dir_all(&packages)?;
    for from in [&fixture.join("src"), &sources] {
        // With what is in it, not with its own name.
        let status = Command::new("cp")
            .arg("-rT")
            .args([from, &packages])
            .status()?;
        ensure!(status.success(), "{} cannot be copied", from.display());
    }
    daemon.push(&[
        workspace.to_str().context("UTF-8")?,
        "--name",
        "meter",
        "--node",
        "rosbridge_fixture/meter",
        "--node",
        SERVER,
    ])?;
    Ok(())
}

/// A client of it.
pub(crate) fn client(node: &Node) -> Result<Line> {
    let inside = Inside::of(node.pid)?;
    let address: SocketAddr = ADDRESS.parse()?;
    let stream = node.runtime.block_on(async {
        let stream: TcpStream = inside.connect(address).await?.into_std()?;
        stream.set_nonblocking(false)?;
        std::io::Result::Ok(stream)
    })?;
    Line::websocket_over(stream, ADDRESS, "")
}
