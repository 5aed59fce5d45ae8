//! Inputs given to the node: matches them with outputs, and computes how long they waited for the node and which ones
//! the node has skipped.
//!
//! ROS calls a subscriber's callback for one message after the other. So an input given to the node during an earlier
//! one has waited until that was answered:
//! ```text
//!  input 1    given ────────── output 1
//!  input 2       given ┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄ ────────── output 2
//!                      queue                compute
//! ```

use std::collections::VecDeque;

use link::record::InputTiming;

/// Number of inputs remembered.
const RECENT: usize = 256;
/// Number of inputs for which it is remembered whether the node has answered them.
const FATES: usize = 128;

/// Stamp of a message whose type begins with a header. Other types have other data there, which identifies the input
/// that an output answers no worse than nothing. In ROS 1 the stamp follows the header's sequence number, in ROS 2 the
/// four bytes of the CDR header, so seconds and nanoseconds are at the same place.
pub(super) type Mark = Option<[u8; 8]>;

/// Returns the mark of a message as the node sees it.
pub(super) fn stamp_mark(message: &[u8]) -> Mark {
    let mark = message.get(4..12)?.try_into().ok()?;
    (mark != [0; 8]).then_some(mark)
}

/// The last inputs of one node.
#[derive(Default)]
pub(super) struct GivenInputs {
    recent: VecDeque<GivenInput>,
    /// Number of inputs while somebody subscribed to an output, and number of outputs.
    flow: (u64, u64),
    /// Answered (`true`) or skipped: the last inputs for which that is known.
    fates: VecDeque<bool>,
    /// Value of `born` of the last input that was answered by an output with the same stamp.
    answered: Option<i64>,
    /// Time at which that input was answered.
    until: i64,
    /// Time at which the input before it was answered.
    before: i64,
}

struct GivenInput {
    channel: u32,
    mark: Mark,
    way: InputTiming,
    /// The fate of the input is known.
    over: bool,
}

impl GivenInputs {
    /// Records an input given to the node; `heard`: somebody subscribes to an output.
    pub(super) fn record(&mut self, channel: u32, mark: Mark, way: InputTiming, heard: bool) {
        self.flow.0 += u64::from(heard);
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(GivenInput { channel, mark, way, over: false });
    }

    /// Returns the input answered by an output with this mark that was published at `born`: the one with the same
    /// stamp, otherwise possibly the newest.
    pub(super) fn match_output(&mut self, mark: Mark, born: i64) -> Option<InputTiming> {
        self.flow.1 += 1;
        let same = |input: &GivenInput| mark.is_some() && input.mark == mark;
        let Some(at) = self.recent.iter().rposition(same) else {
            return self.recent.back().map(|input| input.way);
        };
        let (channel, mut way) = (self.recent[at].channel, self.recent[at].way);
        if !self.recent[at].over {
            // Another input with the same stamp, such as the camera_info of an image, was answered with this one.
            self.recent.iter_mut().filter(|input| same(input)).for_each(|input| input.over = true);
            let earlier = self.recent.iter_mut().take(at);
            let left_out = earlier.filter(|input| input.channel == channel && !input.over);
            for input in left_out {
                input.over = true;
                self.fates.push_back(false);
            }
            self.fates.push_back(true);
            let surplus = self.fates.len().saturating_sub(FATES);
            self.fates.drain(..surplus);
        }
        // One input may have several outputs.
        if self.answered != Some(way.born) {
            self.before = self.until;
            self.answered = Some(way.born);
        }
        self.until = born;
        way.given = way.given.max(self.before);
        Some(way)
    }

    /// Returns the number of inputs while somebody subscribed to an output, and the number of outputs.
    pub(super) fn flow(&self) -> (u64, u64) {
        self.flow
    }

    /// Returns the number of recent inputs whose fate is known, and how many of them the node has skipped.
    pub(super) fn skipped_inputs(&self) -> (usize, usize) {
        let left_out = self.fates.iter().filter(|answered| !**answered).count();
        (self.fates.len(), left_out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(number: u8) -> Mark {
        Some([number; 8])
    }

    fn way(given: i64) -> InputTiming {
        InputTiming { born: given - 10, serialise: 0, left: given - 9, taken: given - 1, given }
    }

    #[test]
    fn what_waits_for_the_node_is_not_computing() {
        let mut all = GivenInputs::default();
        all.record(1, mark(1), way(100), true);
        all.record(1, mark(2), way(101), true);
        let first = all.match_output(mark(1), 150).unwrap();
        assert_eq!(first.given, 100);
        // A second output for the first input: the node was busy with it until then.
        assert_eq!(all.match_output(mark(1), 160).unwrap().given, 100);
        let second = all.match_output(mark(2), 210).unwrap();
        assert_eq!((second.born, second.given), (91, 160));
        all.record(1, mark(3), way(500), true);
        assert_eq!(all.match_output(mark(3), 550).unwrap().given, 500, "idle");
        assert_eq!(all.skipped_inputs(), (3, 0));
    }

    #[test]
    fn outputs_without_a_stamp_may_answer_the_newest() {
        let mut all = GivenInputs::default();
        assert!(all.match_output(None, 5).is_none());
        all.record(1, mark(1), way(100), true);
        all.record(1, None, way(200), true);
        assert_eq!(all.match_output(None, 300).unwrap().given, 200);
        assert_eq!(all.match_output(mark(9), 310).unwrap().given, 200);
        assert_eq!(all.skipped_inputs(), (0, 0));
    }

    #[test]
    fn what_the_node_leaves_out_is_counted_once_and_by_topic() {
        let mut all = GivenInputs::default();
        for number in 1..=4 {
            all.record(1, mark(number), way(i64::from(number) * 100), true);
            all.record(2, mark(number), way(i64::from(number) * 100), true);
            all.record(3, mark(100 + number), way(i64::from(number) * 100), true);
        }
        all.match_output(mark(1), 150);
        all.match_output(mark(4), 450);
        all.match_output(mark(4), 460);
        assert_eq!(all.skipped_inputs(), (4, 2), "2 and 3 of the topic that is answered");
        // A late answer does not change what was counted.
        all.match_output(mark(2), 470);
        assert_eq!(all.skipped_inputs(), (4, 2));
    }
}
