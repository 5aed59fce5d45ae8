//! One time on both sides: stamps of the robot's clock become stamps of this machine's on their way in, and the other
//! way round on their way out, by the difference that the link has measured. See docs/adr/011.
//!
//! ```text
//!  robot: stamp s ──in──▶ s − difference ──▶ node ──▶ s − difference ──out──▶ s, the very same
//! ```
//! What was changed is remembered for a while, so that a stamp that a node copies from its input to its output comes
//! back as it was, even when the difference has been measured anew meanwhile.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicI64, Ordering};

use bytes::{Bytes, BytesMut};
use parking_lot::Mutex;

use crate::clock::Sample;
use ros::codec::{Stamps, Time};

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

    /// What is added to our time to have the robot's, in nanoseconds.
    pub fn difference(&self) -> i64 {
        self.difference.load(Ordering::Relaxed)
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
            let Some(stamp) = stamps.read(&message, at) else {
                continue;
            };
            let changed = there
                .get(stamp)
                .or_else(|| shifted(stamp, change))
                .unwrap_or(stamp);
            if changed != stamp {
                back.note(changed, stamp);
                stamps.write(&mut message, at, changed);
            }
        }
        message.freeze()
    }
}

/// None for what is no time of a clock.
fn shifted(stamp: Time, by: i64) -> Option<Time> {
    let nanoseconds = i64::from(stamp.nsecs);
    if stamp == Time::default() || nanoseconds >= SECOND {
        return None;
    }
    let total = (i64::from(stamp.secs) * SECOND + nanoseconds).checked_add(by)?;
    if total <= 0 {
        return None;
    }
    Some(Time {
        secs: u32::try_from(total / SECOND).ok()?,
        nsecs: u32::try_from(total % SECOND).ok()?,
    })
}

/// The last of them.
#[derive(Debug, Default)]
struct Pairs {
    found: HashMap<Time, Time>,
    order: VecDeque<Time>,
}

impl Pairs {
    fn get(&self, key: Time) -> Option<Time> {
        self.found.get(&key).copied()
    }

    fn note(&mut self, key: Time, value: Time) {
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
