//! Inputs that may be asked for again: until they are answered, or late, the other side may still be given them. With a long T_max that is
//! many pictures, so what they take is bounded, and the oldest give way. Goals of ROS 1 are small, few and open for as long as they take:
//! they do not give way to pictures.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::Message;
use ros::ros1::actions;

/// Bytes of the messages of one node.
const MOST: usize = 64 << 20;
/// So many that may have been dropped meanwhile are not looked through.
const FEW: usize = 64;

/// An input for as long as somebody holds it, or without its message from when newer ones needed the memory.
#[derive(Debug)]
pub struct KeptInput {
    /// Both sides have it since it came.
    pub(super) is_latched: bool,
    bytes: usize,
    message: Mutex<Option<Message>>,
}

impl KeptInput {
    /// The message, unless it has given way.
    pub(super) fn message(&self) -> Option<Message> {
        self.message.lock().clone()
    }
}

/// Those that are kept, the oldest first.
#[derive(Debug)]
pub(super) struct KeptInputs {
    most: usize,
    inputs: VecDeque<Weak<KeptInput>>,
    /// Bytes of them, those included that nobody holds any more.
    bytes: usize,
    /// As many were held when they were looked through last.
    held: usize,
}

impl Default for KeptInputs {
    fn default() -> Self {
        Self {
            most: MOST,
            inputs: VecDeque::new(),
            bytes: 0,
            held: 0,
        }
    }
}

impl KeptInputs {
    /// Keeps one more, whatever its size.
    pub(super) fn keep(&mut self, message: Message) -> Arc<KeptInput> {
        let bytes = message.bytes.len();
        let is_goal = actions::carries_goal_id(&message.wire_type.name);
        let input = Arc::new(KeptInput {
            is_latched: message.latching,
            bytes,
            message: Mutex::new(Some(message)),
        });
        if is_goal {
            return input;
        }
        if self.bytes + bytes > self.most || self.inputs.len() > 2 * self.held + FEW {
            self.forget_unheld();
        }
        while self.bytes + bytes > self.most {
            let Some(oldest) = self.inputs.pop_front() else {
                break;
            };
            if let Some(oldest) = oldest.upgrade() {
                self.bytes -= oldest.bytes;
                *oldest.message.lock() = None;
                tracing::debug!(
                    bytes = oldest.bytes,
                    "an input that waited for its answer has given way to newer ones"
                );
            }
        }
        self.bytes += bytes;
        self.inputs.push_back(Arc::downgrade(&input));
        input
    }

    fn forget_unheld(&mut self) {
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

    fn message(size: usize) -> Message {
        Message {
            bytes: Bytes::from(vec![0; size]),
            wire_type: Arc::new(WireType::named("sensor_msgs/Image")),
            publisher: "/camera".into(),
            latching: false,
        }
    }

    #[test]
    fn goals_do_not_give_way_to_pictures() {
        let mut kept = KeptInputs {
            most: 100,
            ..KeptInputs::default()
        };
        let mut goal = message(30);
        goal.wire_type = Arc::new(WireType::named("move_base_msgs/MoveBaseActionGoal"));
        let goal = kept.keep(goal);
        let pictures: Vec<_> = (0..9).map(|_| kept.keep(message(30))).collect();
        assert!(goal.message().is_some() && pictures[0].message().is_none());
    }

    #[test]
    fn the_oldest_give_way_and_what_is_answered_takes_nothing() {
        let mut kept = KeptInputs {
            most: 100,
            ..KeptInputs::default()
        };
        let there = |inputs: &[Arc<KeptInput>]| {
            let there = inputs.iter().map(|input| input.message().is_some());
            there.collect::<Vec<_>>()
        };
        let mut inputs: Vec<_> = (0..4).map(|_| kept.keep(message(30))).collect();
        assert_eq!(there(&inputs), [false, true, true, true]);
        // The third one is answered: there is room for another.
        inputs.remove(2);
        inputs.push(kept.keep(message(30)));
        assert_eq!(there(&inputs), [false, true, true, true]);
        inputs.push(kept.keep(message(1000)));
        assert_eq!(there(&inputs), [false, false, false, false, true]);
        inputs.push(kept.keep(message(1)));
        assert_eq!(there(&inputs[4..]), [false, true]);
        for _ in 0..1000 {
            kept.keep(message(1));
        }
        assert!(kept.inputs.len() <= 2 * FEW + 2, "{}", kept.inputs.len());
    }
}
