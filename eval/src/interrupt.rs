//! An evaluation that is asked to end (Ctrl-C, SIGTERM): nothing more is measured, places are taken down, and the report is written of what
//! was measured until then. Asked again, it ends at once; what it leaves then, the next one takes away.

use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, ensure};
use tokio::signal::unix::{SignalKind, signal};

static ASKED: AtomicBool = AtomicBool::new(false);
/// As a shell says it of a program that Ctrl-C has ended.
const AT_ONCE: i32 = 130;

/// Begins to listen for signals.
pub fn listen() -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (mut interrupt, mut terminate) = {
        let _inside = runtime.enter();
        (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
        )
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
                eprintln!(
                    "ending: the report is written of what was measured; once more ends it at once"
                );
            }
        });
    });
    Ok(())
}

/// Whether it was asked to end.
pub fn asked() -> bool {
    ASKED.load(Ordering::Relaxed)
}

/// That it was not.
///
/// # Errors
/// It was: nothing more is to be measured.
pub fn none() -> Result<()> {
    ensure!(
        !asked(),
        "the evaluation was asked to end before this was measured"
    );
    Ok(())
}
