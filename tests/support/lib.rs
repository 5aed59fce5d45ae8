//! Tools of the stories: a daemon of their own or the shared one, a deployer who runs commands, a robot on a WebSocket,
//! and checks for leftovers.

pub mod acme;
pub mod binaries;
pub mod burglar;
pub mod burglary;
pub mod cable;
pub mod claim;
pub mod cores;
pub mod cutter;
pub mod daemon;
pub mod deployer;
pub mod disk;
pub mod evidence;
pub mod freezer;
pub mod grants;
mod layer_pool;
pub mod layout;
pub mod leftovers;
pub mod machine;
pub mod patience;
pub mod people;
pub mod procfs;
pub mod provider;
pub mod robot;
pub mod robot_network;
pub mod ros_system;
pub mod shaper;
pub mod site;
pub mod small_disk;
pub mod story;
pub mod tls;
pub mod twins;
pub mod wire;
pub mod world;

use std::time::Duration;

use anyhow::bail;

use crate::patience::{Deadline, describe_slowness};

/// Polling interval.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Result of a story; an error is printed with all its causes.
pub type Verdict = anyhow::Result<()>;

/// Polls `look` until it returns a value. What it returned instead becomes the story's error after
/// [`patience::patience`].
///
/// # Errors
/// If `look` fails, or if the time is up.
pub fn wait_until<T>(what: &str, mut look: impl FnMut() -> anyhow::Result<Result<T, String>>) -> anyhow::Result<T> {
    let deadline = Deadline::begin();
    loop {
        match look()? {
            Ok(found) => return Ok(found),
            Err(instead) if deadline.is_over() => {
                evidence::note_machine();
                bail!("{what} did not come about; instead: {instead}\n{}", describe_slowness())
            }
            Err(_) => std::thread::sleep(LOOK_EVERY),
        }
    }
}
