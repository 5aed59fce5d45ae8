//! Where passwords wait to be hashed: each hash takes 19 MiB and some 20 ms of a core, for whoever asks. A few are made at once, in lanes of
//! which each keeps its memory; so many wait for each lane; and of these, so many are of one address and of one account.
//!
//! ```text
//!  sign in ─▶ holds a place (its address, its account) ─┬─ a name that there is ─▶ lane of accounts ──▶ hash
//!                                                        └─ any other name ───────▶ lane of made-up ──▶ hash, in vain
//! ```
//!
//! Names that nobody has are hashed, too, or it would be seen by the time that they are nobody's. But they wait for each other alone: whoever
//! makes them up, from however many addresses, holds up nobody who has an account.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;

use access::Host;
use argon2::Block;
use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::errors::Error;

/// Passwords of one address, and of one account, that are hashed or wait for it.
pub const OF_EACH: usize = 4;

/// Hashes that are made one beside the other, and those that wait.
pub struct Lane {
    /// Those that are made.
    working: Arc<Semaphore>,
    /// Those that are made or wait.
    room: Arc<Semaphore>,
    /// Memory of those that have been made: malloc would keep as much for each thread on which one ever was.
    memory: Arc<Mutex<Vec<Vec<Block>>>>,
}

/// A password's turn. Whoever does not wait for its hash any more does not make room for another before that is made.
pub struct Turn {
    _place: OwnedSemaphorePermit,
    _working: OwnedSemaphorePermit,
    memory: Arc<Mutex<Vec<Vec<Block>>>>,
}

impl Lane {
    pub fn new(at_once: usize, waiting: usize) -> Lane {
        Lane {
            working: Arc::new(Semaphore::new(at_once)),
            room: Arc::new(Semaphore::new(at_once + waiting)),
            memory: Arc::default(),
        }
    }

    /// Waits for a turn, where not too many do already.
    pub async fn turn(&self) -> Result<Turn, Error> {
        let place = Arc::clone(&self.room).try_acquire_owned();
        let place = place.map_err(|_| Error::SignInBusy)?;
        let working = Arc::clone(&self.working).acquire_owned().await;
        Ok(Turn {
            _place: place,
            // It is never closed.
            _working: working.map_err(|_| Error::SignInBusy)?,
            memory: Arc::clone(&self.memory),
        })
    }

    #[cfg(test)]
    pub fn is_empty(&self, all: usize) -> bool {
        self.room.available_permits() == all
    }
}

impl Turn {
    /// Calls `work` with so many blocks of memory. Nothing is promised of what stands in them.
    pub fn work<T>(self, blocks: usize, work: impl FnOnce(&mut [Block]) -> T) -> T {
        let kept = self.memory.lock().pop();
        let mut memory = kept.unwrap_or_default();
        memory.resize(blocks, Block::new());
        let worked = work(&mut memory);
        self.memory.lock().push(memory);
        worked
    }
}

/// For whom passwords are hashed now, or wait for it.
#[derive(Default)]
pub struct Holders {
    counts: Arc<Mutex<HashMap<Holder, usize>>>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Holder {
    Host(Host),
    Account(String),
}

/// One place of an address and of an account.
#[derive(Debug)]
pub struct Held {
    counts: Arc<Mutex<HashMap<Holder, usize>>>,
    holders: [Holder; 2],
}

impl Holders {
    /// A place for a password that came from an address for an account, which need not exist.
    pub fn hold(&self, from: IpAddr, account: &str) -> Result<Held, Error> {
        let holders = [
            Holder::Host(from.into()),
            Holder::Account(account.to_owned()),
        ];
        let mut counts = self.counts.lock();
        let is_full = |holder| counts.get(holder).is_some_and(|count| *count >= OF_EACH);
        if holders.iter().any(is_full) {
            return Err(Error::SignInBusy);
        }
        for holder in &holders {
            *counts.entry(holder.clone()).or_default() += 1;
        }
        Ok(Held {
            counts: Arc::clone(&self.counts),
            holders,
        })
    }

    #[cfg(test)]
    pub fn is_empty(&self) -> bool {
        self.counts.lock().is_empty()
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        let mut counts = self.counts.lock();
        for holder in &self.holders {
            if let Some(count) = counts.get_mut(holder) {
                *count -= 1;
                if *count == 0 {
                    counts.remove(holder);
                }
            }
        }
    }
}
