//! Interruption of an evaluation (Ctrl-C, SIGTERM): nothing more is measured, the sandboxes are removed, and the report
//! is written with the results so far. A second signal ends the evaluation at once; the next one removes what it
//! leaves.

use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, ensure};
use tokio::signal::unix::{SignalKind, signal};

static ASKED: AtomicBool = AtomicBool::new(false);
/// Exit status of a program that was ended by Ctrl-C, as shells report it.
const AT_ONCE: i32 = 130;

/// Installs the signal handlers.
pub fn listen() -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (mut interrupt, mut terminate) = {
        let _inside = runtime.enter();
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
    };
    std::thread::spawn(move || {
        runtime.block_on(async {
            loop {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                }
                if ASKED.swap(true, Ordering::Relaxed) {
                    std::process::exit(AT_ONCE);
                }
                eprintln!("ending: the report is written of what was measured; once more ends it at once");
            }
        });
    });
    Ok(())
}

/// Returns whether the evaluation was interrupted.
pub fn is_requested() -> bool {
    ASKED.load(Ordering::Relaxed)
}

/// Checks that the evaluation was not interrupted.
///
/// # Errors
/// If it was: nothing more is to be measured.
pub fn ensure_not_requested() -> Result<()> {
    ensure!(!is_requested(), "the evaluation was asked to end before this was measured");
    Ok(())
}
