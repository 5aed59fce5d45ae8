//! The command line. Launchers generate it; people only type `doctor` and `pair`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

/// Runs a robot's node in the cloud, under its own name.
#[derive(Debug, Parser)]
#[command(name = "cloudroid-stub", version, arg_required_else_help = true)]
pub struct StubArguments {
    /// Command to run.
    #[command(subcommand)]
    pub verb: StubCommand,
}

/// Commands of the stub.
#[derive(Debug, Subcommand)]
pub enum StubCommand {
    /// Run as the node: register under its name and have the real node run in the cloud.
    Run(RunArgs),
    /// Execute the original: the next executable of this name in libexec order, which is not outsourced.
    ExecOriginal(ExecOriginalArgs),
    /// Check everything that the stub needs, and show how to fix what is missing.
    Doctor(StubDoctorArgs),
    /// Pair this robot with a server: make its own key and obtain a certificate for it.
    Pair(PairRobotArgs),
}

/// Executable of a package.
#[derive(Debug, Clone, Args)]
pub struct NodeArgs {
    /// ROS package.
    #[arg(long, value_name = "PKG")]
    pub package: String,
    /// Executable below lib/PKG.
    #[arg(long, value_name = "EXE")]
    pub node: String,
    /// Directory share/PKG of the stub, which contains interface.toml and stub.toml.
    #[arg(long, value_name = "DIR")]
    pub share: PathBuf,
}

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    #[command(flatten)]
    /// Node to stand in for.
    pub node: NodeArgs,
    /// Arguments from roslaunch or rosrun: the node's own, remaps, __name:=, __log:=.
    #[arg(last = true, allow_hyphen_values = true)]
    pub argv: Vec<String>,
}

/// Arguments of `exec-original`.
#[derive(Debug, Args)]
pub struct ExecOriginalArgs {
    #[command(flatten)]
    /// Node whose original is executed.
    pub node: NodeArgs,
    /// Arguments for the original, passed on unchanged.
    #[arg(last = true, allow_hyphen_values = true)]
    pub argv: Vec<String>,
}

/// Arguments of `pair`.
#[derive(Debug, Args)]
pub struct PairRobotArgs {
    /// Line printed by cloudroidctl pair ROBOT on the server, in single quotes.
    #[arg(value_name = "LINE")]
    pub line: String,
    /// Directory of the robot's key and certificates (default: ~/.config/cloudroid).
    #[arg(long, value_name = "DIR", env = "CLOUDROID_IDENTITY")]
    pub identity: Option<PathBuf>,
}

/// Arguments of `doctor`.
#[derive(Debug, Args)]
pub struct StubDoctorArgs {
    /// Directory share/PKG of the stub, which contains interface.toml and stub.toml (default: that of this program).
    #[arg(long, value_name = "DIR")]
    pub share: Option<PathBuf>,
    /// ROS package (default: name of the share directory).
    #[arg(long, value_name = "PKG")]
    pub package: Option<String>,
    /// Run only these checks.
    #[arg(long, value_enum)]
    pub only: Option<DoctorPart>,
}

/// Groups of checks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum DoctorPart {
    /// ROS version and middleware of this robot.
    Ros,
    /// Address, token, service, clock and MTU.
    Server,
}
