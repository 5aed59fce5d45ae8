//! Which messages of two sequences belong together.

use std::collections::VecDeque;

/// So far is looked ahead for where two sequences go on alike.
pub(crate) const WINDOW: usize = 8;
/// So many messages at the end of one sequence, without a counterpart, may be on their way on the other side.
const EDGE: usize = 2;

/// The servant that an answer is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    /// The robot's servant.
    Present,
    /// The candidate.
    Candidate,
}

/// What becomes of messages of two sequences.
#[derive(Debug, PartialEq)]
pub(crate) enum Paired<T> {
    /// These belong together, and are equal or not.
    Both(T, T, bool),
    /// The candidate has none that belongs to it.
    Missing(T),
    /// The robot's servant has none.
    Surplus(T),
    /// It was the last, or nearly so: its counterpart may have been on its way.
    Edge,
}

/// Two sequences of messages that should be equal. Where they are not, the next place within [`WINDOW`] is looked for at which they
/// go on alike, so that one that was lost makes none of those after it differ.
#[derive(Debug)]
pub(crate) struct Pairing<T> {
    present: VecDeque<T>,
    candidate: VecDeque<T>,
    paired: bool,
}

impl<T> Default for Pairing<T> {
    fn default() -> Self {
        Pairing {
            present: VecDeque::new(),
            candidate: VecDeque::new(),
            paired: false,
        }
    }
}

impl<T> Pairing<T> {
    /// The next message of a side.
    pub(crate) fn push(&mut self, side: Side, message: T) {
        match side {
            Side::Present => self.present.push_back(message),
            Side::Candidate => self.candidate.push_back(message),
        }
    }

    /// Whether as many have come on one side as on the other.
    pub(crate) fn is_even(&self) -> bool {
        self.present.len() == self.candidate.len()
    }

    /// How many messages wait on the side that has more of them.
    pub(crate) fn waiting(&self) -> usize {
        self.present.len().max(self.candidate.len())
    }

    /// Pairs what can be paired; all of it where there comes no more.
    pub(crate) fn settle(&mut self, last: bool, equal: impl Fn(&T, &T) -> bool) -> Vec<Paired<T>> {
        let mut settled = Vec::new();
        while let (Some(one), Some(other)) = (self.present.front(), self.candidate.front()) {
            let gap = match equal(one, other) {
                true => Some((0, 0)),
                // What comes next may show more.
                false if !last && self.shorter() <= WINDOW => break,
                false => self.gap(&equal),
            };
            let (lost, more) = gap.unwrap_or((1, 1));
            for _ in 0..lost.min(more) {
                settled.extend(self.pair(false));
            }
            for _ in more..lost {
                settled.extend(self.present.pop_front().map(Paired::Missing));
            }
            for _ in lost..more {
                settled.extend(self.candidate.pop_front().map(Paired::Surplus));
            }
            if gap.is_some() {
                settled.extend(self.pair(true));
            }
        }
        if last {
            // One that has answered until now goes on to do so.
            let edge = self.paired && self.waiting() <= EDGE;
            let missing = self.present.drain(..).map(Paired::Missing);
            let surplus = self.candidate.drain(..).map(Paired::Surplus);
            let left = missing.chain(surplus);
            match edge {
                true => settled.extend(left.map(|_| Paired::Edge)),
                false => settled.extend(left),
            }
        }
        settled
    }

    fn pair(&mut self, equal: bool) -> Option<Paired<T>> {
        self.paired = true;
        let one = self.present.pop_front()?;
        Some(Paired::Both(one, self.candidate.pop_front()?, equal))
    }

    fn shorter(&self) -> usize {
        self.present.len().min(self.candidate.len())
    }

    /// How many are skipped on each side until both go on alike, as few as possible.
    fn gap(&self, equal: &impl Fn(&T, &T) -> bool) -> Option<(usize, usize)> {
        let at = |lost: usize, more: usize| {
            let pair = self.present.get(lost).zip(self.candidate.get(more));
            pair.is_some_and(|(one, other)| equal(one, other))
        };
        (1..=WINDOW)
            .flat_map(|both| (0..=both).map(move |lost| (lost, both - lost)))
            .find(|(lost, more)| at(*lost, *more))
    }
}
