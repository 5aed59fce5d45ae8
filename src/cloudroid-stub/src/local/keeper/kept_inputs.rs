//! Inputs that may be needed again: until they are answered or late, they may still be given to the other side. With a
//! long T_max these are many images, so their memory is limited, and the oldest are dropped. Goals of ROS 1 are small,
//! few and open for a long time: they are not dropped for images.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::SerializedMessage;
use ros::ros1::actions;

/// Memory for the messages of one node, in bytes.
const MAX_BYTES: usize = 64 << 20;
/// Number of entries that may have been released without a search for them.
const SEARCH_FROM: usize = 64;

/// An input that is retained while somebody holds it; its message is dropped when newer ones need the memory.
#[derive(Debug)]
pub struct RetainedInput {
    /// Set if both sides have received it already.
    pub(super) is_latched: bool,
    bytes: usize,
    message: Mutex<Option<SerializedMessage>>,
}

impl RetainedInput {
    /// Returns the message, unless it was dropped.
    pub(super) fn message(&self) -> Option<SerializedMessage> {
        self.message.lock().clone()
    }
}

/// The retained inputs, oldest first.
#[derive(Debug)]
pub(super) struct RetainedInputs {
    most: usize,
    inputs: VecDeque<Weak<RetainedInput>>,
    /// Size of their messages in bytes, including entries that nobody holds any more.
    bytes: usize,
    /// Number of entries that were held at the last search.
    held: usize,
}

impl Default for RetainedInputs {
    fn default() -> Self {
        Self { most: MAX_BYTES, inputs: VecDeque::new(), bytes: 0, held: 0 }
    }
}

impl RetainedInputs {
    /// Adds an input of any size.
    pub(super) fn insert(&mut self, message: SerializedMessage) -> Arc<RetainedInput> {
        let bytes = message.bytes.len();
        let is_goal = actions::carries_goal_id(&message.wire_type.name);
        let input = Arc::new(RetainedInput { is_latched: message.latching, bytes, message: Mutex::new(Some(message)) });
        if is_goal {
            return input;
        }
        if self.bytes + bytes > self.most || self.inputs.len() > 2 * self.held + SEARCH_FROM {
            self.drop_released();
        }
        while self.bytes + bytes > self.most {
            let Some(oldest) = self.inputs.pop_front() else {
                break;
            };
            if let Some(oldest) = oldest.upgrade() {
                self.bytes -= oldest.bytes;
                *oldest.message.lock() = None;
                tracing::debug!(bytes = oldest.bytes, "dropped an input without an answer in favour of newer ones");
            }
        }
        self.bytes += bytes;
        self.inputs.push_back(Arc::downgrade(&input));
        input
    }

    fn drop_released(&mut self) {
        self.inputs.retain(|input| input.strong_count() > 0);
        let held = self.inputs.iter().filter_map(Weak::upgrade);
        self.bytes = held.map(|input| input.bytes).sum();
        self.held = self.inputs.len();
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use ros::bus::WireType;

    use super::*;

    fn message(size: usize) -> SerializedMessage {
        SerializedMessage {
            bytes: Bytes::from(vec![0; size]),
            wire_type: Arc::new(WireType::with_name("sensor_msgs/Image")),
            publisher: "/camera".into(),
            latching: false,
        }
    }

    #[test]
    fn goals_do_not_give_way_to_pictures() {
        let mut kept = RetainedInputs { most: 100, ..RetainedInputs::default() };
        let mut goal = message(30);
        goal.wire_type = Arc::new(WireType::with_name("move_base_msgs/MoveBaseActionGoal"));
        let goal = kept.insert(goal);
        let pictures: Vec<_> = (0..9).map(|_| kept.insert(message(30))).collect();
        assert!(goal.message().is_some() && pictures[0].message().is_none());
    }

    #[test]
    fn the_oldest_give_way_and_what_is_answered_takes_nothing() {
        let mut kept = RetainedInputs { most: 100, ..RetainedInputs::default() };
        let there = |inputs: &[Arc<RetainedInput>]| {
            let there = inputs.iter().map(|input| input.message().is_some());
            there.collect::<Vec<_>>()
        };
        let mut inputs: Vec<_> = (0..4).map(|_| kept.insert(message(30))).collect();
        assert_eq!(there(&inputs), [false, true, true, true]);
        // The third input is answered, which makes room for another.
        inputs.remove(2);
        inputs.push(kept.insert(message(30)));
        assert_eq!(there(&inputs), [false, true, true, true]);
        inputs.push(kept.insert(message(1000)));
        assert_eq!(there(&inputs), [false, false, false, false, true]);
        inputs.push(kept.insert(message(1)));
        assert_eq!(there(&inputs[4..]), [false, true]);
        for _ in 0..1000 {
            kept.insert(message(1));
        }
        assert!(kept.inputs.len() <= 2 * SEARCH_FROM + 2, "{}", kept.inputs.len());
    }
}
