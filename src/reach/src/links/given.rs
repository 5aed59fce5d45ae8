//! Inputs that the node was given: which one an output answers, how long it waited for the node, and which ones the
//! node has left out.
//!
//! ROS calls a subscriber's callback for one message after the other. So an input that was given to the node while it
//! was at an earlier one has waited until that was answered:
//! ```text
//!  input 1    given ────────── output 1
//!  input 2       given ┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄ ────────── output 2
//!                      queue                compute
//! ```

use std::collections::VecDeque;

use super::inputs::Mark;
use link::record::Answered;

/// Inputs remembered.
const RECENT: usize = 256;
/// Inputs of which it is remembered whether the node has answered them.
const FATES: usize = 128;

/// The last inputs of one node.
#[derive(Default)]
pub(super) struct Given {
    recent: VecDeque<Input>,
    /// Inputs while somebody listened to an output, and outputs.
    flow: (u64, u64),
    /// Whether they were answered: the last ones of which that is known.
    fates: VecDeque<bool>,
    /// The `born` of the input that the node has answered last, by the same stamp.
    answered: Option<i64>,
    /// When it answered that one.
    until: i64,
    /// When it answered the one before that.
    before: i64,
}

struct Input {
    channel: u32,
    mark: Mark,
    way: Answered,
    /// It is known whether it was answered.
    over: bool,
}

impl Given {
    /// An input was given to the node; `heard`: somebody listens to what it puts out.
    pub(super) fn note(&mut self, channel: u32, mark: Mark, way: Answered, heard: bool) {
        self.flow.0 += u64::from(heard);
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(Input {
            channel,
            mark,
            way,
            over: false,
        });
    }

    /// The input that an output of this mark answers, which was published at `born`: that of the same stamp, else
    /// the newest one, perhaps.
    pub(super) fn answered_by(&mut self, mark: Mark, born: i64) -> Option<Answered> {
        self.flow.1 += 1;
        let same = |input: &Input| mark.is_some() && input.mark == mark;
        let Some(at) = self.recent.iter().rposition(same) else {
            return self.recent.back().map(|input| input.way);
        };
        let (channel, mut way) = (self.recent[at].channel, self.recent[at].way);
        if !self.recent[at].over {
            // Another input of the same stamp, a picture's camera_info, has found its way with this one.
            self.recent
                .iter_mut()
                .filter(|input| same(input))
                .for_each(|input| input.over = true);
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

    /// Inputs while somebody listened to an output, and outputs.
    pub(super) fn flow(&self) -> (u64, u64) {
        self.flow
    }

    /// Of how many of the last inputs it is known whether the node has answered them, and how many it has left out.
    pub(super) fn left_out(&self) -> (usize, usize) {
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

    fn way(given: i64) -> Answered {
        Answered {
            born: given - 10,
            serialise: 0,
            left: given - 9,
            taken: given - 1,
            given,
        }
    }

    #[test]
    fn what_waits_for_the_node_is_not_computing() {
        let mut all = Given::default();
        all.note(1, mark(1), way(100), true);
        all.note(1, mark(2), way(101), true);
        let first = all.answered_by(mark(1), 150).unwrap();
        assert_eq!(first.given, 100);
        // A second output of the first input: the node was at it until then.
        assert_eq!(all.answered_by(mark(1), 160).unwrap().given, 100);
        let second = all.answered_by(mark(2), 210).unwrap();
        assert_eq!((second.born, second.given), (91, 160));
        all.note(1, mark(3), way(500), true);
        assert_eq!(all.answered_by(mark(3), 550).unwrap().given, 500, "idle");
        assert_eq!(all.left_out(), (3, 0));
    }

    #[test]
    fn outputs_without_a_stamp_may_answer_the_newest() {
        let mut all = Given::default();
        assert!(all.answered_by(None, 5).is_none());
        all.note(1, mark(1), way(100), true);
        all.note(1, None, way(200), true);
        assert_eq!(all.answered_by(None, 300).unwrap().given, 200);
        assert_eq!(all.answered_by(mark(9), 310).unwrap().given, 200);
        assert_eq!(all.left_out(), (0, 0));
    }

    #[test]
    fn what_the_node_leaves_out_is_counted_once_and_by_topic() {
        let mut all = Given::default();
        for number in 1..=4 {
            all.note(1, mark(number), way(i64::from(number) * 100), true);
            all.note(2, mark(number), way(i64::from(number) * 100), true);
            all.note(3, mark(100 + number), way(i64::from(number) * 100), true);
        }
        all.answered_by(mark(1), 150);
        all.answered_by(mark(4), 450);
        all.answered_by(mark(4), 460);
        assert_eq!(
            all.left_out(),
            (4, 2),
            "2 and 3 of the topic that is answered"
        );
        // Late after all: what was counted stays counted.
        all.answered_by(mark(2), 470);
        assert_eq!(all.left_out(), (4, 2));
    }
}
