//! Queues for hashing passwords. Each hash takes 19 MiB and about 20 ms of a core, whoever asks. A few are computed
//! at once, in lanes that each reuse their memory; the number waiting for a lane is limited, and so is each address's
//! and each account's share of it.
//!
//! ```text
//!  sign-in ─▶ acquires a slot (per address and account) ─┬─ existing account ─▶ lane of accounts ──────▶ hash
//!                                                        └─ unknown name ─────▶ lane of unknown names ─▶ hash
//! ```
//!
//! Unknown names are hashed, too, so that the timing does not reveal that they are unknown. But they wait only for
//! each other: inventing names, from however many addresses, delays nobody who has an account.

use std::net::IpAddr;
use std::sync::Arc;

use access::Host;
use argon2::Block;
use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::errors::Error;
use crate::slots::{Slot, Slots};

/// Limit on the passwords of one address, and of one account, that are being hashed or waiting.
pub const OF_EACH: usize = 4;

/// A lane: hashes computed in parallel, and those waiting.
pub struct HashLane {
    /// Hashes being computed.
    working: Arc<Semaphore>,
    /// Hashes being computed or waiting.
    room: Arc<Semaphore>,
    /// Reusable memory of finished hashes; malloc would otherwise keep as much for every thread that ever computed
    /// one.
    memory: Arc<Mutex<Vec<Vec<Block>>>>,
}

/// Turn to compute a hash. If the caller stops waiting, the turn is still held until the hash is finished.
pub struct HashTurn {
    _place: OwnedSemaphorePermit,
    _working: OwnedSemaphorePermit,
    memory: Arc<Mutex<Vec<Vec<Block>>>>,
}

impl HashLane {
    pub fn new(at_once: usize, waiting: usize) -> HashLane {
        HashLane {
            working: Arc::new(Semaphore::new(at_once)),
            room: Arc::new(Semaphore::new(at_once + waiting)),
            memory: Arc::default(),
        }
    }

    /// Waits for a turn; fails if too many are waiting already.
    pub async fn acquire(&self) -> Result<HashTurn, Error> {
        let place = Arc::clone(&self.room).try_acquire_owned();
        let place = place.map_err(|_| Error::SignInBusy)?;
        let working = Arc::clone(&self.working).acquire_owned().await;
        Ok(HashTurn {
            _place: place,
            // The semaphore is never closed.
            _working: working.map_err(|_| Error::SignInBusy)?,
            memory: Arc::clone(&self.memory),
        })
    }

    #[cfg(test)]
    pub fn is_empty(&self, all: usize) -> bool {
        self.room.available_permits() == all
    }
}

impl HashTurn {
    /// Calls `work` with this many memory blocks, whose content is unspecified.
    pub fn work<T>(self, blocks: usize, work: impl FnOnce(&mut [Block]) -> T) -> T {
        let kept = self.memory.lock().pop();
        let mut memory = kept.unwrap_or_default();
        memory.resize(blocks, Block::new());
        let worked = work(&mut memory);
        self.memory.lock().push(memory);
        worked
    }
}

/// Addresses and accounts whose passwords are being hashed or waiting.
#[derive(Default)]
pub struct HashSlots(Slots<SlotOwner>);

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum SlotOwner {
    Host(Host),
    Account(String),
}

/// Slots of one address and one account; released when dropped.
#[derive(Debug)]
pub struct HashSlot {
    _held: [Slot<SlotOwner>; 2],
}

impl HashSlots {
    /// Acquires a slot for a password that came from an address for an account, which need not exist.
    pub fn acquire(&self, from: IpAddr, account: &str) -> Result<HashSlot, Error> {
        let acquire = |owner| self.0.acquire(owner, OF_EACH).ok_or(Error::SignInBusy);
        let held = [acquire(SlotOwner::Host(from.into()))?, acquire(SlotOwner::Account(account.to_owned()))?];
        Ok(HashSlot { _held: held })
    }

    #[cfg(test)]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}
