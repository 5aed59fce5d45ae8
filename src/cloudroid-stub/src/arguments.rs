//! The command line. Launchers write it, people only type `doctor` and `pair`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

/// Runs a robot's node in the cloud, under its own name.
#[derive(Debug, Parser)]
#[command(name = "cloudroid-stub", version, arg_required_else_help = true)]
pub struct Arguments {
    /// The command.
    #[command(subcommand)]
    pub verb: Verb,
}

/// What can be done.
#[derive(Debug, Subcommand)]
pub enum Verb {
    /// Be the node: register under its name, have the real one run in the cloud.
    Run(Run),
    /// Become the next executable of this name in libexec order: one that is not outsourced.
    ExecOriginal(ExecOriginal),
    /// Say of each thing the stub needs whether it is there.
    Doctor(Doctor),
    /// Pair this robot with a server: make its own key, and have a certificate of it.
    Pair(Pair),
}

/// Which executable is meant.
#[derive(Debug, Clone, Args)]
pub struct Node {
    /// The ROS package.
    #[arg(long, value_name = "PKG")]
    pub package: String,
    /// The executable below lib/PKG.
    #[arg(long, value_name = "EXE")]
    pub node: String,
    /// The stub's share/PKG, where interface.toml and stub.toml are.
    #[arg(long, value_name = "DIR")]
    pub share: PathBuf,
}

/// Be the node.
#[derive(Debug, Args)]
pub struct Run {
    #[command(flatten)]
    /// The node to stand in for.
    pub node: Node,
    /// As roslaunch or rosrun gave it: arguments, remaps, __name:=, __log:=.
    #[arg(last = true, allow_hyphen_values = true)]
    pub argv: Vec<String>,
}

/// Become the original.
#[derive(Debug, Args)]
pub struct ExecOriginal {
    #[command(flatten)]
    /// The node whose original is executed.
    pub node: Node,
    /// Passed on as it is.
    #[arg(last = true, allow_hyphen_values = true)]
    pub argv: Vec<String>,
}

/// Pair.
#[derive(Debug, Args)]
pub struct Pair {
    /// What cloudroidctl pair ROBOT printed on the server, between single quotes.
    #[arg(value_name = "LINE")]
    pub line: String,
    /// Directory of the robot's key and certificates; ~/.config/cloudroid by default.
    #[arg(long, value_name = "DIR", env = "CLOUDROID_IDENTITY")]
    pub identity: Option<PathBuf>,
}

/// Check.
#[derive(Debug, Args)]
pub struct Doctor {
    /// The stub's share/PKG, where interface.toml and stub.toml are; by default that of this very program.
    #[arg(long, value_name = "DIR")]
    pub share: Option<PathBuf>,
    /// The ROS package; by default the share directory's name.
    #[arg(long, value_name = "PKG")]
    pub package: Option<String>,
    /// Only this part.
    #[arg(long, value_enum)]
    pub only: Option<Part>,
}

/// A part of what is checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Part {
    /// Address, token, service, clock and MTU.
    Server,
}
