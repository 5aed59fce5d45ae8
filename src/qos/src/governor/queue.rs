//! The outstanding inputs of one side of a pair, in the order in which they were published.

use std::collections::VecDeque;
use std::time::Instant;

use crate::request::RequestId;

/// Number of answers in a row without a skipped input after which a node is assumed to answer every input.
const ALL_TAKEN: u32 = 100;

/// Inputs that were sent to a side and not answered, oldest first.
///
/// A node may skip inputs: one with a short queue takes the newest when it is done. Only a later answer shows that;
/// until it comes, an input that arrived while the node was busy looks like one that will never be answered.
#[derive(Debug, Default)]
pub(super) struct OutstandingInputs {
    pub(super) waiting: VecDeque<RequestId>,
    /// Time of the side's last answer.
    pub(super) heard: Option<Instant>,
    /// Number of answers in a row without a skipped input.
    all_taken: u32,
}

impl OutstandingInputs {
    /// Adds an input that was sent to the side, possibly after later ones.
    pub(super) fn add(&mut self, id: RequestId) {
        let place = self.waiting.partition_point(|earlier| *earlier < id);
        self.waiting.insert(place, id);
    }

    /// Records that the side has answered this input. Returns the earlier inputs, which it skipped.
    pub(super) fn on_answer(&mut self, now: Instant, id: RequestId) -> Vec<RequestId> {
        self.heard = Some(now);
        let Some(place) = self.waiting.iter().position(|waiting| *waiting == id) else {
            return Vec::new();
        };
        let mut done: Vec<_> = self.waiting.drain(..=place).collect();
        done.pop();
        done
    }

    /// Records whether the side skipped an input that it could have answered in time.
    pub(super) fn note_left_out(&mut self, left_out: bool) {
        let in_a_row = self.all_taken.saturating_add(1);
        self.all_taken = if left_out { 0 } else { in_a_row };
    }

    /// Returns the time since which the side may be working on a later input: this one was sent before the side's last
    /// answer. For a node that answers every input, the oldest one is never considered skipped.
    pub(super) fn passed_over_since(&self, id: RequestId, asked_at: Instant) -> Option<Instant> {
        let heard = self.heard.filter(|heard| asked_at <= *heard)?;
        let is_next = self.waiting.front() == Some(&id);
        let waits = is_next && self.all_taken < ALL_TAKEN || !is_next && self.waiting.contains(&id);
        waits.then_some(heard)
    }
}
