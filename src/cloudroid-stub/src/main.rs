//! `cloudroid-stub`: what runs on the robot in place of a package's node. The launchers of a generated package call
//! it under the original's name; it registers as that node, has the real one started in the robot's servant, and
//! carries bytes between the two.
//!
//! ```text
//!  roslaunch ─▶ lib/PKG/NODE (launcher) ─▶ cloudroid-stub run ─┬─ robot's ROS Master, TCPROS ─ the robot's nodes
//!                                                              ├─ link (WebSocket) ─ cloudroidd ─ servant ─ real node
//!                                                              └─ the local original, when the cloud is too slow
//! ```
//!
//! In: the command line as roslaunch gave it, `stub.toml` and `interface.toml` of the package's share directory, the
//! robot's parameters. Out: the node's exit status.

#![forbid(unsafe_code)]

mod arguments;
mod config;
mod doctor;
mod original;

use std::process::ExitCode;

use arguments::{Arguments, Verb};
use clap::Parser;

fn main() -> ExitCode {
    let outcome = match Arguments::parse().verb {
        Verb::Run(asked) => run(&asked),
        Verb::ExecOriginal(asked) => original::exec(&asked.node, &asked.argv),
        Verb::Doctor(asked) => doctor::examine(&asked),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("cloudroid-stub: {error:#}");
        ExitCode::FAILURE
    })
}

fn run(asked: &arguments::Run) -> anyhow::Result<ExitCode> {
    let config = config::read(&asked.node.share, std::env::vars())?;
    anyhow::bail!("the link to {} is not there yet", config.server)
}
