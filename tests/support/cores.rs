//! Work that keeps a core busy, such as a push that compiles: as many at a time as the machine has cores. Stories mostly wait, so many of them are
//! told at a time; what they compile would take each other's time.

use std::num::NonZero;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::story;

/// After this time work begins although no core is free: a story may itself have to end what takes one up.
const LONGEST_WAIT: Duration = Duration::from_secs(90);

static TAKEN: Mutex<usize> = Mutex::new(0);
static FREED: Condvar = Condvar::new();

/// A core's worth of work, until it is dropped.
#[derive(Debug)]
pub struct CorePermit(());

/// Waits for a core that no other story's work takes up.
pub fn acquire() -> CorePermit {
    let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
    let began = Instant::now();
    let taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    let (mut taken, _) = FREED
        .wait_timeout_while(taken, LONGEST_WAIT, |taken| *taken >= cores)
        .unwrap_or_else(PoisonError::into_inner);
    *taken += 1;
    drop(taken);
    story::add_wait(began.elapsed());
    CorePermit(())
}

impl Drop for CorePermit {
    fn drop(&mut self) {
        *TAKEN.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        FREED.notify_one();
    }
}
