//! Record of the messages of outputs: which outputs are latched, which grow, and whose stamps they carry.

use std::collections::{BTreeMap, BTreeSet};

use package::requests::ObservedAnswer;
use ros::bus::SerializedMessage;

/// Number of messages longer than their predecessor from which on an output counts as growing.
const LONGER: u32 = 3;

/// Seconds and nanoseconds of a header in serialized form.
pub(super) type Stamp = [u8; 8];

/// Reads the stamp of a message that begins with a header: after `seq` in ROS 1, after the encapsulation header in ROS
/// 2, both of which are four bytes long.
pub(super) fn read_stamp(message: &[u8]) -> Option<Stamp> {
    message.get(4..12)?.try_into().ok()
}

/// Record of all messages of outputs so far.
#[derive(Default)]
pub(super) struct OutputRecord {
    pub(super) latched: BTreeSet<String>,
    lengths: BTreeMap<String, LengthTrend>,
    /// Stamps of each output's messages, read as if all of them had one.
    stamps: BTreeMap<String, BTreeSet<Stamp>>,
}

impl OutputRecord {
    pub(super) fn record(&mut self, topic: &str, message: &SerializedMessage) {
        if message.latching {
            self.latched.insert(topic.to_owned());
        }
        let lengths = self.lengths.entry(topic.to_owned()).or_default();
        lengths.record_length(message.bytes.len());
        let stamps = self.stamps.entry(topic.to_owned()).or_default();
        stamps.extend(read_stamp(&message.bytes));
    }

    /// Returns the outputs whose messages grew steadily.
    pub(super) fn growing_outputs(&self) -> Vec<String> {
        let grown = self.lengths.iter().filter(|(_, of)| of.is_growth());
        grown.map(|(topic, _)| topic.clone()).collect()
    }

    /// Returns the outputs that carried the stamp of a message that was `given` to an input.
    pub(super) fn observed_answers<'a>(
        &self,
        given: impl Fn(&Stamp) -> Option<&'a String>,
    ) -> BTreeSet<ObservedAnswer> {
        let mut answers = BTreeSet::new();
        for (output, stamps) in &self.stamps {
            answers.extend(
                stamps
                    .iter()
                    .filter_map(&given)
                    .map(|input| ObservedAnswer { input: input.clone(), output: output.clone() }),
            );
        }
        answers
    }
}

/// Trend of the length of a topic's messages.
#[derive(Debug, Clone, Copy, Default)]
struct LengthTrend {
    last: Option<usize>,
    grown: u32,
    shrunk: bool,
}

impl LengthTrend {
    fn record_length(&mut self, length: usize) {
        if let Some(last) = self.last.replace(length) {
            self.grown += u32::from(length > last);
            self.shrunk |= length < last;
        }
    }

    /// Returns whether messages grow steadily, as accumulated data do; a counter in a text grows only now and then.
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
            let mut seen = LengthTrend::default();
            for length in &lengths {
                seen.record_length(*length);
            }
            assert_eq!(seen.is_growth(), grows, "{lengths:?}");
        }
    }
}
