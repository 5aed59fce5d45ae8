//! Permits for work that keeps a core busy, such as a push that compiles: there are as many as the machine has cores.
//! Many stories run at a time because they mostly wait, but concurrent compilations would slow each other down.

use std::num::NonZero;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::story;

/// Time after which work starts even if no core is free, because a story may have to end the work that occupies one.
const LONGEST_WAIT: Duration = Duration::from_secs(90);

static CORES_TAKEN: Mutex<usize> = Mutex::new(0);
static FREED: Condvar = Condvar::new();

/// A permit to keep one core busy, until drop.
#[derive(Debug)]
pub struct CorePermit(());

/// Waits for a core that is not used by another story's work.
pub fn acquire() -> CorePermit {
    let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
    let began = Instant::now();
    let taken = CORES_TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    let (mut taken, _) =
        FREED.wait_timeout_while(taken, LONGEST_WAIT, |taken| *taken >= cores).unwrap_or_else(PoisonError::into_inner);
    *taken += 1;
    drop(taken);
    story::add_wait(began.elapsed());
    CorePermit(())
}

impl Drop for CorePermit {
    fn drop(&mut self) {
        *CORES_TAKEN.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        FREED.notify_one();
    }
}
