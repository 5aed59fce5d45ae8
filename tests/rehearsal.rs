//! Small stories with known ends, by which the runner itself is tested (`stories/telling.rs`).

use std::time::Duration;

use anyhow::bail;
use support::world::{GREETER, world};
use support::{Verdict, story};

use crate::runner::Story;

/// The variable that asks for them; its value is the time after which one of them has no end, in seconds.
pub const VARIABLE: &str = "CLOUDROID_REHEARSAL";

/// Returns that time, if they are asked for.
pub fn limit() -> Option<Duration> {
    let seconds = std::env::var(VARIABLE).ok()?;
    Some(Duration::from_secs(seconds.parse().unwrap_or(1200)))
}

/// All of them.
pub fn stories() -> Vec<Story> {
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
    let daemon = world().own("rehearsal").start()?;
    GREETER.push_to(&daemon)?;
    let directory = world().directory("rehearsed")?;
    std::fs::write(directory.path().join("note"), "kept")?;
    fail_once()?;
    daemon.ends().map(drop)
}

fn panic_once() -> Verdict {
    assert!(!is_first(), "it panics the first time");
    Ok(())
}

/// Stays until the run is killed, with a servant at work.
fn wait_with_a_servant() -> Verdict {
    let daemon = world().own("rehearsal-waits").start()?;
    GREETER.push_to(&daemon)?;
    let _robot = daemon.robot("greeter_cpp?robot=r1")?;
    println!("rehearsal: a servant is at work");
    loop {
        std::thread::sleep(Duration::from_secs(3600));
    }
}
