//! Translation of time stamps between the clocks of robot and cloud, by the measured difference: incoming stamps are
//! converted to the local clock, outgoing stamps to the robot's. See docs/adr/011.
//!
//! ```text
//!  robot: stamp s ──in──▶ s − difference ──▶ node ──▶ s − difference ──out──▶ s, exactly
//! ```
//! Conversions are remembered for a while, so that a stamp that a node copies from its input to its output is restored
//! exactly, even if the difference was measured anew in between.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicI64, Ordering};

use bytes::{Bytes, BytesMut};
use parking_lot::Mutex;

use crate::clock::ClockSample;
use ros::codec::{Stamps, Time};

/// Differences smaller than this, beyond the error of the measurement, are ignored: 1 ms.
const MIN_DIFFERENCE: i64 = 1_000_000;
/// Number of stamps remembered in each direction.
const MAX_STAMPS: usize = 4096;
const SECOND: i64 = 1_000_000_000;

/// Direction of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Messages from the robot to the node.
    In,
    /// Messages from the node to the robot.
    Out,
}

/// The difference between a robot's clock and the local clock, and the stamps converted with it.
#[derive(Debug, Default)]
pub struct Skew {
    /// Robot's clock minus local clock in nanoseconds; 0: no significant difference.
    difference: AtomicI64,
    /// Local stamp → robot's stamp, and robot's stamp → local stamp.
    known: Mutex<[StampMap; 2]>,
}

impl Skew {
    /// Handles a new measurement of the robot's clock against the local clock.
    pub fn on_clock_sample(&self, sample: ClockSample) {
        let now = self.difference.load(Ordering::Relaxed);
        // The offset is uncertain within half of the delay (RFC 5905, section 8).
        let unsure = sample.delay / 2 + MIN_DIFFERENCE;
        if sample.offset.saturating_sub(now).saturating_abs() > unsure {
            self.difference.store(sample.offset, Ordering::Relaxed);
        }
    }

    /// Returns the nanoseconds to add to local time to obtain the robot's time.
    pub fn difference(&self) -> i64 {
        self.difference.load(Ordering::Relaxed)
    }

    /// Converts the stamps of a message to the time of the other side. Zero stamps, and values that are not times of a
    /// clock, stay unchanged.
    pub fn apply(&self, direction: Direction, stamps: &Stamps, message: Bytes) -> Bytes {
        let difference = self.difference();
        if difference == 0 || stamps.is_empty() {
            return message;
        }
        let Some(found) = stamps.find(&message).filter(|found| !found.is_empty()) else {
            return message;
        };
        let mut message = BytesMut::from(message);
        let [robots, ours] = &mut *self.known.lock();
        let (change, there, back) = match direction {
            Direction::In => (-difference, ours, robots),
            Direction::Out => (difference, robots, ours),
        };
        for at in found {
            let Some(stamp) = stamps.read(&message, at) else {
                continue;
            };
            let changed = there.found.get(&stamp).copied().or_else(|| shift_stamp(stamp, change)).unwrap_or(stamp);
            if changed != stamp {
                back.insert(changed, stamp);
                stamps.write(&mut message, at, changed);
            }
        }
        message.freeze()
    }
}

/// Returns `None` for a value that is not a time of a clock.
fn shift_stamp(stamp: Time, by: i64) -> Option<Time> {
    let nanoseconds = i64::from(stamp.nsecs);
    if stamp == Time::default() || nanoseconds >= SECOND {
        return None;
    }
    let total = (i64::from(stamp.secs) * SECOND + nanoseconds).checked_add(by)?;
    if total <= 0 {
        return None;
    }
    Some(Time { secs: u32::try_from(total / SECOND).ok()?, nsecs: u32::try_from(total % SECOND).ok()? })
}

/// The most recent conversions.
#[derive(Debug, Default)]
struct StampMap {
    found: HashMap<Time, Time>,
    order: VecDeque<Time>,
}

impl StampMap {
    fn insert(&mut self, key: Time, value: Time) {
        if self.found.insert(key, value).is_some() {
            return;
        }
        self.order.push_back(key);
        if self.order.len() > MAX_STAMPS {
            if let Some(oldest) = self.order.pop_front() {
                self.found.remove(&oldest);
            }
        }
    }
}

#[cfg(test)]
mod tests;
