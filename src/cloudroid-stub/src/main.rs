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
mod mirror;
mod network;
mod original;
mod output;
mod pairing;
mod parameters;
mod params_file;
mod resolver;
mod revision;
mod robot;
mod run;
mod seen;
mod stream;
mod terms;
#[cfg(test)]
mod testing;

use std::process::ExitCode;

use arguments::{Arguments, Verb};
use clap::Parser;
use foreign::terminal;

fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_env("CLOUDROID_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(|| &*output::STDERR)
        .with_target(false)
        .init();
    // One machine has one clock: tests of two need this.
    if let Some(seconds) = std::env::var("CLOUDROID_TEST_CLOCK_SHIFT")
        .ok()
        .and_then(|seconds| seconds.parse::<i64>().ok())
    {
        link::clock::shift(seconds.saturating_mul(1_000_000_000));
    }
    let outcome = match Arguments::parse().verb {
        Verb::Run(asked) => run::run(&asked),
        Verb::ExecOriginal(asked) => original::exec(&asked.node, &asked.argv),
        Verb::Doctor(asked) => doctor::examine(&asked),
        Verb::Pair(asked) => pairing::pair(&asked),
    };
    let exit = outcome.unwrap_or_else(|error| {
        // It may have words of a server.
        let text = format!("cloudroid-stub: {error:#}");
        output::STDERR.print(format!("{}\n", terminal::escape(&text, false)));
        ExitCode::FAILURE
    });
    output::finish();
    exit
}
