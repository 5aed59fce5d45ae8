//! What is kept of the messages of outputs: which are latched, which grow, and whose stamps they carry.

use std::collections::{BTreeMap, BTreeSet};

use package::requests::Watched;
use ros::bus::Message;

/// Messages of an output that were longer than the one before, from which on it grows.
const LONGER: u32 = 3;

/// Seconds and nanoseconds of a header, as they stand in a message.
pub(super) type Stamp = [u8; 8];

/// The stamp of a message that begins with a header: behind `seq` in ROS 1, behind the mark of the encoding in ROS 2,
/// both of which are four bytes long.
pub(super) fn stamp(message: &[u8]) -> Option<Stamp> {
    message.get(4..12)?.try_into().ok()
}

/// What outputs have said so far.
#[derive(Default)]
pub(super) struct Heard {
    pub(super) latched: BTreeSet<String>,
    lengths: BTreeMap<String, Lengths>,
    /// Of each output's messages, as if all of them had one.
    stamps: BTreeMap<String, BTreeSet<Stamp>>,
}

impl Heard {
    pub(super) fn note(&mut self, topic: &str, message: &Message) {
        if message.latching {
            self.latched.insert(topic.to_owned());
        }
        let lengths = self.lengths.entry(topic.to_owned()).or_default();
        lengths.note(message.bytes.len());
        let stamps = self.stamps.entry(topic.to_owned()).or_default();
        stamps.extend(stamp(&message.bytes));
    }

    /// Outputs whose messages became longer and longer.
    pub(super) fn growing(&self) -> Vec<String> {
        let grown = self.lengths.iter().filter(|(_, of)| of.is_growth());
        grown.map(|(topic, _)| topic.clone()).collect()
    }

    /// Outputs that have carried the stamp of a message that an input was `given`.
    pub(super) fn answers<'a>(
        &self,
        given: impl Fn(&Stamp) -> Option<&'a String>,
    ) -> BTreeSet<Watched> {
        let mut answers = BTreeSet::new();
        for (output, stamps) in &self.stamps {
            answers.extend(stamps.iter().filter_map(&given).map(|input| Watched {
                input: input.clone(),
                output: output.clone(),
            }));
        }
        answers
    }
}

/// How the length of a topic's messages changes.
#[derive(Debug, Clone, Copy, Default)]
struct Lengths {
    last: Option<usize>,
    grown: u32,
    shrunk: bool,
}

impl Lengths {
    fn note(&mut self, length: usize) {
        if let Some(last) = self.last.replace(length) {
            self.grown += u32::from(length > last);
            self.shrunk |= length < last;
        }
    }

    /// A counter in a text becomes longer now and then; what gathers becomes so with each input.
    fn is_growth(&self) -> bool {
        self.grown >= LONGER && !self.shrunk
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_gathers_becomes_longer_with_each_message() {
        for (lengths, grows) in [
            (vec![], false),
            (vec![10, 10, 10, 10, 10], false),
            // "9", "10", … "99", "100": a counter in a text.
            (vec![9, 10, 10, 10, 11, 11], false),
            (vec![10, 18, 26, 34], true),
            (vec![10, 10, 18, 26, 26, 34], true),
            (vec![10, 18, 26, 34, 12], false),
        ] {
            let mut seen = Lengths::default();
            for length in &lengths {
                seen.note(*length);
            }
            assert_eq!(seen.is_growth(), grows, "{lengths:?}");
        }
    }
}
