//! What one side was asked for of one pair, in the order in which it was published.

use std::collections::VecDeque;
use std::time::Instant;

use crate::request::RequestId;

/// After so many answers in a row by which nothing was left out, a node is taken for one that answers every input.
const ALL_TAKEN: u32 = 100;

/// Inputs that a side was given and has not answered, the oldest first.
///
/// A node may leave inputs out: one with a short queue takes the newest when it is done. Only a later answer shows that, and
/// until it comes an input that was given while the node was busy cannot be told from one that nobody will answer.
#[derive(Debug, Default)]
pub(super) struct Queue {
    pub(super) waiting: VecDeque<RequestId>,
    /// When the side has answered last.
    pub(super) heard: Option<Instant>,
    /// So many answers in a row left nothing out.
    all_taken: u32,
}

impl Queue {
    /// The side was given this one, perhaps after later ones.
    pub(super) fn add(&mut self, id: RequestId) {
        let place = self.waiting.partition_point(|earlier| *earlier < id);
        self.waiting.insert(place, id);
    }

    /// The side has answered this one. Gives those before it, which it left out.
    pub(super) fn answered(&mut self, now: Instant, id: RequestId) -> Vec<RequestId> {
        self.heard = Some(now);
        let Some(place) = self.waiting.iter().position(|waiting| *waiting == id) else {
            return Vec::new();
        };
        let mut done: Vec<_> = self.waiting.drain(..=place).collect();
        done.pop();
        done
    }

    /// Notes whether the side left out what it could have answered in time.
    pub(super) fn note(&mut self, left_out: bool) {
        let in_a_row = self.all_taken.saturating_add(1);
        self.all_taken = if left_out { 0 } else { in_a_row };
    }

    /// Since when the side may be at an input that came after this one: it was given this one before it was heard last. Of a node
    /// that answers every input the oldest one waits for no later one.
    pub(super) fn passed_over(&self, id: RequestId, asked_at: Instant) -> Option<Instant> {
        let heard = self.heard.filter(|heard| asked_at <= *heard)?;
        let is_next = self.waiting.front() == Some(&id);
        let waits = is_next && self.all_taken < ALL_TAKEN || !is_next && self.waiting.contains(&id);
        waits.then_some(heard)
    }
}
