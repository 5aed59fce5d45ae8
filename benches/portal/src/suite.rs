//! rosbridge_suite in the servant next to the node, if `CLOUDROID_ROSBRIDGE_SUITE` names its sources and rosauth's.

use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use bench_report::BenchDaemon;
use ros::net::Sockets;

use crate::line::BenchConnection;
use crate::node::{MeterNode, open_sockets};
use crate::setup::{fixture_path, push_meter};

/// Name in reports.
pub(crate) const NAME: &str = "rosbridge_suite";
const SOURCES: &str = "CLOUDROID_ROSBRIDGE_SUITE";
/// Address of its server, inside the servant.
const ADDRESS: &str = "127.0.0.1:9090";
/// Command of the server; it unregisters publishers as soon as their clients have left.
const SERVER: &str = "rosbridge_server/rosbridge_websocket.py _port:=9090 _address:=127.0.0.1 _unregister_timeout:=0.1";

/// Publishes the fixture's node and the server as one service; the error says why that is not possible.
pub(crate) fn push_with_fixture(daemon: &BenchDaemon) -> Result<()> {
    let sources = std::env::var_os(SOURCES).map(PathBuf::from);
    let advice = "may name a directory with its sources for ROS 1 and those of rosauth";
    let sources = sources.with_context(|| format!("Debian does not package it; {SOURCES} {advice}"))?;
    let workspace = daemon.directory().join("with_suite");
    let packages = workspace.join("src");
    std::fs::create_dir_all(&packages)?;
    for from in [&fixture_path().join("src"), &sources] {
        // Copies the directory's content without the directory itself.
        let status = Command::new("cp").arg("-rT").args([from, &packages]).status()?;
        ensure!(status.success(), "{} cannot be copied", from.display());
    }
    push_meter(daemon, &workspace, &["--node", SERVER])
}

/// Connects a client to the server.
pub(crate) fn connect_client(node: &MeterNode) -> Result<BenchConnection> {
    let inside = open_sockets(node.pid)?;
    let address: SocketAddr = ADDRESS.parse()?;
    let stream = node.runtime.block_on(async {
        let stream: TcpStream = inside.connect(address).await?.into_std()?;
        stream.set_nonblocking(false)?;
        std::io::Result::Ok(stream)
    })?;
    BenchConnection::upgrade(stream, ADDRESS, "")
}
