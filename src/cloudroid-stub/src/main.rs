//! `cloudroid-stub` runs on the robot in place of a package's node. The launchers of a generated package start it under
//! the original's name; it registers as that node, has the real one started in the robot's servant, and forwards bytes
//! between the two.
//!
//! ```text
//!  roslaunch ─▶ lib/PKG/NODE (launcher) ─▶ cloudroid-stub run ─┬─ robot's ROS Master, TCPROS ─ the robot's nodes
//!                                                              ├─ link (WebSocket) ─ cloudroidd ─ servant ─ real node
//!                                                              └─ the local original, when the cloud is too slow
//! ```
//!
//! Input: the command line as roslaunch passes it, `stub.toml` and `interface.toml` of the package's share directory,
//! and the robot's parameters. Output: the node's exit status.

#![deny(unsafe_code)]

mod address;
mod arguments;
mod config;
mod connect;
mod doctor;
mod farewell;
mod http;
mod linked;
mod local;
mod machine;
mod middleware;
mod mirror;
mod network;
mod node_interface;
mod original;
mod output;
mod pairing;
mod parameters;
mod params_file;
mod resolver;
mod revision;
mod robot;
mod run;
mod setup;
mod stream;
mod terms;
#[cfg(test)]
mod testing;

use std::process::ExitCode;

use arguments::{StubArguments, StubCommand};
use clap::Parser;
use foreign::terminal;

fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_env("CLOUDROID_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| &*output::STDERR).with_target(false).init();
    // A machine has only one clock; tests of two clocks shift it.
    if let Some(seconds) =
        std::env::var("CLOUDROID_TEST_CLOCK_SHIFT").ok().and_then(|seconds| seconds.parse::<i64>().ok())
    {
        link::clock::shift_clock(seconds.saturating_mul(1_000_000_000));
    }
    let outcome = match StubArguments::parse().verb {
        StubCommand::Run(asked) => run::run(&asked),
        StubCommand::ExecOriginal(asked) => original::exec(&asked.node, &asked.argv),
        StubCommand::Doctor(asked) => doctor::examine(&asked),
        StubCommand::Pair(asked) => pairing::pair(&asked),
    };
    let exit = outcome.unwrap_or_else(|error| {
        // The error may contain text from a server.
        let text = format!("cloudroid-stub: {error:#}");
        output::STDERR.print(format!("{}\n", terminal::escape(&text, false)));
        ExitCode::FAILURE
    });
    output::finish();
    exit
}
