//! Small stories with known results, for tests of the runner itself (`stories/telling.rs`).

use std::time::Duration;

use anyhow::bail;
use support::cable::Cable;
use support::world::{GREETER, world};
use support::{Verdict, story};

use crate::runner::RunnableStory;

/// Environment variable that selects these stories; its value is the number of seconds after which a story counts as
/// hanging.
pub const VARIABLE: &str = "CLOUDROID_REHEARSAL";

/// Begin of the line that says that a servant is at work; the path of a network namespace follows.
pub const AT_WORK: &str = "rehearsal: a servant is at work, and the network ";

/// Returns that time, if these stories are selected.
pub fn limit() -> Option<Duration> {
    let seconds = std::env::var(VARIABLE).ok()?;
    Some(Duration::from_secs(seconds.parse().unwrap_or(1200)))
}

/// Returns all of these stories.
pub fn stories() -> Vec<RunnableStory> {
    vec![
        crate::story("rehearsal::passes", || Ok(())),
        crate::story("rehearsal::fails", || bail!("it always fails")),
        crate::story("rehearsal::fails_once", fail_once_with_a_daemon),
        crate::story("rehearsal::panics_once", panic_once),
        crate::story("rehearsal::is_missed_once", fail_once),
        crate::story("rehearsal::times_out_once", fail_once),
        crate::story("rehearsal::waits", wait_with_a_servant),
        crate::story("rehearsal::has_no_end", || {
            loop {
                std::thread::sleep(Duration::from_secs(3600));
            }
        }),
    ]
}

fn is_first() -> bool {
    story::current().is_some_and(|telling| telling.attempt == 1)
}

fn fail_once() -> Verdict {
    if is_first() {
        bail!("it fails the first time");
    }
    Ok(())
}

fn fail_once_with_a_daemon() -> Verdict {
    let daemon = world().setup("rehearsal").start()?;
    GREETER.push_to(&daemon)?;
    let directory = world().directory("rehearsed")?;
    std::fs::write(directory.path().join("note"), "kept")?;
    fail_once()?;
    daemon.stop().map(drop)
}

fn panic_once() -> Verdict {
    assert!(!is_first(), "it panics the first time");
    Ok(())
}

/// Keeps a servant and a network working until the run is killed.
fn wait_with_a_servant() -> Verdict {
    let daemon = world().setup("rehearsal-waits").start()?;
    GREETER.push_to(&daemon)?;
    let _robot = daemon.robot("greeter_cpp?robot=r1")?;
    let cable = Cable::new(&daemon.address)?;
    println!("{AT_WORK}{}", cable.namespace().display());
    loop {
        std::thread::sleep(Duration::from_secs(3600));
    }
}
