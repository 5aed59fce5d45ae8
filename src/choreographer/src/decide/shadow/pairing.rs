//! Pairs the messages of two sequences.

use std::collections::VecDeque;

/// Number of messages to look ahead for the point at which two sequences agree again.
pub(crate) const WINDOW: usize = 8;
/// Number of unpaired messages at the end of one sequence that may still be in flight on the other side.
const EDGE: usize = 2;

/// The servant that gave an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ShadowSide {
    /// The robot's servant.
    Present,
    /// The candidate.
    Candidate,
}

/// Result of pairing messages of two sequences.
#[derive(Debug, PartialEq)]
pub(crate) enum PairingResult<T> {
    /// These belong together; the flag says whether they are equal.
    Both(T, T, bool),
    /// The candidate has no counterpart.
    Missing(T),
    /// The robot's servant has no counterpart.
    Surplus(T),
    /// It was among the last: its counterpart may have been in flight.
    Edge,
}

/// Two sequences of messages that should be equal. When they differ, the next point within [`WINDOW`] at which they
/// agree again is searched for, so that a lost message does not make all later ones differ.
#[derive(Debug)]
pub(crate) struct Pairing<T> {
    present: VecDeque<T>,
    candidate: VecDeque<T>,
    paired: bool,
}

impl<T> Default for Pairing<T> {
    fn default() -> Self {
        Pairing { present: VecDeque::new(), candidate: VecDeque::new(), paired: false }
    }
}

impl<T> Pairing<T> {
    /// Appends the next message of a side.
    pub(crate) fn push(&mut self, side: ShadowSide, message: T) {
        match side {
            ShadowSide::Present => self.present.push_back(message),
            ShadowSide::Candidate => self.candidate.push_back(message),
        }
    }

    /// Returns true if both sides have the same number of waiting messages.
    pub(crate) fn is_even(&self) -> bool {
        self.present.len() == self.candidate.len()
    }

    /// Returns the number of waiting messages on the side that has more.
    pub(crate) fn waiting(&self) -> usize {
        self.present.len().max(self.candidate.len())
    }

    /// Pairs what can be paired; everything, if `last` says that no more comes.
    pub(crate) fn settle(&mut self, last: bool, equal: impl Fn(&T, &T) -> bool) -> Vec<PairingResult<T>> {
        let mut settled = Vec::new();
        while let (Some(one), Some(other)) = (self.present.front(), self.candidate.front()) {
            let gap = if equal(one, other) {
                Some((0, 0))
            } else if !last && self.shorter() <= WINDOW {
                // Later messages may show more.
                break;
            } else {
                self.gap(&equal)
            };
            let (lost, more) = gap.unwrap_or((1, 1));
            for _ in 0..lost.min(more) {
                settled.extend(self.pair(false));
            }
            for _ in more..lost {
                settled.extend(self.present.pop_front().map(PairingResult::Missing));
            }
            for _ in lost..more {
                settled.extend(self.candidate.pop_front().map(PairingResult::Surplus));
            }
            if gap.is_some() {
                settled.extend(self.pair(true));
            }
        }
        if last {
            // A side that has answered so far will continue to.
            let edge = self.paired && self.waiting() <= EDGE;
            let missing = self.present.drain(..).map(PairingResult::Missing);
            let surplus = self.candidate.drain(..).map(PairingResult::Surplus);
            let left = missing.chain(surplus);
            if edge { settled.extend(left.map(|_| PairingResult::Edge)) } else { settled.extend(left) }
        }
        settled
    }

    fn pair(&mut self, equal: bool) -> Option<PairingResult<T>> {
        self.paired = true;
        let one = self.present.pop_front()?;
        Some(PairingResult::Both(one, self.candidate.pop_front()?, equal))
    }

    fn shorter(&self) -> usize {
        self.present.len().min(self.candidate.len())
    }

    /// Returns how many messages to skip on each side until both agree, as few as possible.
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
