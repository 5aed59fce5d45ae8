//! One time on both sides: stamps of the robot's clock become stamps of this machine's on their way in, and the other
//! way round on their way out, by the difference that the link has measured. See docs/adr/011.
//!
//! ```text
//!  robot: stamp s ──in──▶ s − difference ──▶ node ──▶ s − difference ──out──▶ s, the very same
//! ```
//! What was changed is remembered for a while, so that a stamp that a node copies from its input to its output comes
//! back as it was, even when the difference has been measured anew meanwhile.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};

use bytes::{Bytes, BytesMut};
use parking_lot::Mutex;

use crate::clock::Sample;
use ros::codec::Stamps;

/// A difference smaller than this, beyond what the measurement leaves open, is none: 1 ms.
const NOTICED: i64 = 1_000_000;
/// Stamps remembered each way.
const REMEMBERED: usize = 4096;
const SECOND: i64 = 1_000_000_000;

/// The way of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the robot to the node.
    In,
    /// From the node to the robot.
    Out,
}

/// The difference between a robot's clock and ours, and what was changed by it.
#[derive(Debug, Default)]
pub struct Skew {
    /// Robot's clock minus ours, in nanoseconds; 0: none that counts.
    difference: AtomicI64,
    /// Stamps are none of a wall clock, or the robot wants them as they are.
    off: AtomicBool,
    known: Mutex<Known>,
}

#[derive(Debug, Default)]
struct Known {
    /// Stamp of ours → the robot's.
    robots: Pairs,
    /// Stamp of the robot → ours.
    ours: Pairs,
}

impl Skew {
    /// The clocks were compared: `sample` is the robot's against ours.
    pub fn measured(&self, sample: Sample) {
        let now = self.difference.load(Ordering::Relaxed);
        // Within half of the delay nobody can tell (RFC 5905, section 8).
        let unsure = sample.delay / 2 + NOTICED;
        if sample.offset.saturating_sub(now).saturating_abs() > unsure {
            self.difference.store(sample.offset, Ordering::Relaxed);
        }
    }

    /// Whether stamps go as they are: they are simulated time, or nobody wants them changed.
    pub fn leave(&self, off: bool) {
        self.off.store(off, Ordering::Relaxed);
    }

    /// What is added to our time to have the robot's, in nanoseconds.
    pub fn difference(&self) -> i64 {
        if self.off.load(Ordering::Relaxed) {
            0
        } else {
            self.difference.load(Ordering::Relaxed)
        }
    }

    /// The message with its stamps in the other side's time. Stamps of zero stay zero, and so does what no clock shows.
    pub fn apply(&self, direction: Direction, stamps: &Stamps, message: Bytes) -> Bytes {
        let difference = self.difference();
        if difference == 0 || stamps.is_empty() {
            return message;
        }
        let Some(found) = stamps.find(&message).filter(|found| !found.is_empty()) else {
            return message;
        };
        let mut message = message.try_into_mut().unwrap_or_else(|shared| {
            let mut own = BytesMut::with_capacity(shared.len());
            own.extend_from_slice(&shared);
            own
        });
        let mut known = self.known.lock();
        let Known { robots, ours } = &mut *known;
        let (change, there, back) = match direction {
            Direction::In => (-difference, ours, robots),
            Direction::Out => (difference, robots, ours),
        };
        for at in found {
            let Some(bytes) = message.get_mut(at..at + 8) else {
                continue;
            };
            let stamp = u64::from_le_bytes([
                bytes[0], bytes[1], bytes[2], bytes[3], bytes[4], bytes[5], bytes[6], bytes[7],
            ]);
            let changed = there
                .get(stamp)
                .or_else(|| shifted(stamp, change))
                .unwrap_or(stamp);
            if changed != stamp {
                back.note(changed, stamp);
                bytes.copy_from_slice(&changed.to_le_bytes());
            }
        }
        message.freeze()
    }
}

/// A stamp as on the wire: seconds in the lower half, nanoseconds in the upper. None for what is no time of a clock.
fn shifted(stamp: u64, by: i64) -> Option<u64> {
    let seconds = i64::from(stamp as u32);
    let nanoseconds = i64::from((stamp >> 32) as u32);
    if stamp == 0 || nanoseconds >= SECOND {
        return None;
    }
    let total = (seconds * SECOND + nanoseconds).checked_add(by)?;
    if total <= 0 {
        return None;
    }
    let seconds = u64::from(u32::try_from(total / SECOND).ok()?);
    let nanoseconds = u64::try_from(total % SECOND).ok()?;
    Some(seconds | nanoseconds << 32)
}

/// The last of them.
#[derive(Debug, Default)]
struct Pairs {
    found: HashMap<u64, u64>,
    order: VecDeque<u64>,
}

impl Pairs {
    fn get(&self, key: u64) -> Option<u64> {
        self.found.get(&key).copied()
    }

    fn note(&mut self, key: u64, value: u64) {
        if self.found.insert(key, value).is_some() {
            return;
        }
        self.order.push_back(key);
        if self.order.len() > REMEMBERED {
            if let Some(oldest) = self.order.pop_front() {
                self.found.remove(&oldest);
            }
        }
    }
}

#[cfg(test)]
mod tests;
