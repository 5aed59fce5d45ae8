//! Inputs that are matched by arrival, in the order in which they came.
//!
//! Nothing says which of them an output answers. It is none that its node had not been given yet, and, of a node that
//! skips inputs while it is busy, possibly the newest one at its previous output. The local original is assumed to
//! take an input when it has none, else the newest one once it has answered (the next one, if its node skips none).
//! An output is taken for a repetition if the other side has delivered an answer to an input at or after the oldest
//! one that it may answer.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::OutputAge;
use crate::request::Responder;

/// Number of inputs whose times are kept: 17 s of a camera at 30 Hz.
const KEPT: usize = 512;

/// Weight of an output in the average number of inputs per output.
const WEIGHT: f64 = 0.1;
/// Averages above which a node answers an input at most once, and above which it skips some.
const AT_MOST_ONCE: f64 = 0.9;
const SKIPPING: f64 = 1.2;

/// The inputs that an output may answer, by number.
#[derive(Debug, Clone, Copy)]
pub(super) struct AnsweredInputs {
    pub(super) oldest: u64,
    pub(super) newest: u64,
}

/// Numbers of the inputs of a pair, from 1 on; 0 is none.
#[derive(Debug, Default)]
pub(super) struct InputSequence {
    /// Times of the last inputs, oldest first.
    times: VecDeque<Instant>,
    /// Number of the input before them.
    before: u64,
    /// The newest input that the local original was given.
    given_locally: u64,
    /// The input that the local original works on, and when that was given.
    taken_locally: Option<(u64, Instant)>,
    /// The newest input that the node in the cloud had been given at its last output.
    at_last_output: u64,
    /// Average number of inputs per output of the cloud.
    inputs_per_output: f64,
    /// By side, the newest input that a delivered output may answer.
    delivered: [u64; 2],
}

impl InputSequence {
    /// Adds an input.
    pub(super) fn add(&mut self, now: Instant) {
        self.times.push_back(now);
        if self.times.len() > KEPT {
            self.times.pop_front();
            self.before += 1;
        }
    }

    /// Returns the number of the newest input at this time.
    pub(super) fn number_at(&self, at: Instant) -> u64 {
        self.before + self.times.partition_point(|time| *time <= at) as u64
    }

    /// Records that the local original was given the input of time `at`. What it was given more than `t_max` before
    /// will not be answered any more.
    pub(super) fn note_given_locally(&mut self, now: Instant, at: Instant, t_max: Duration) {
        let number = self.number_at(at);
        self.given_locally = self.given_locally.max(number);
        let taken = self.taken_locally.filter(|(_, given)| now < *given + t_max);
        self.taken_locally = taken.or(Some((number, now)));
    }

    /// Returns the inputs that an output may answer, if that is known.
    pub(super) fn answered_inputs(&mut self, now: Instant, side: Responder, age: OutputAge) -> Option<AnsweredInputs> {
        if side == Responder::Local {
            // Without an input it answers none: it publishes by itself, which the robot must not miss.
            let (oldest, _) = self.taken_locally.take()?;
            let newest = self.given_locally;
            let next = if self.skips_inputs() { newest } else { oldest + 1 };
            self.taken_locally = (newest > oldest).then_some((next, now));
            return Some(AnsweredInputs { oldest, newest });
        }
        let newest = self.number_at(now.checked_sub(age.since_input?)?);
        let before = std::mem::replace(&mut self.at_last_output, newest);
        // At most two, or the inputs of one outage would look like those of a node that skips many.
        let since = newest.saturating_sub(before).min(2) as f64;
        self.inputs_per_output += WEIGHT * (since - self.inputs_per_output);
        let oldest = if self.skips_inputs() { before.min(newest) } else { newest };
        Some(AnsweredInputs { oldest, newest })
    }

    fn skips_inputs(&self) -> bool {
        self.inputs_per_output > SKIPPING
    }

    /// Returns whether an output of this side is a repetition. A node that answers an input several times, or publishes
    /// without inputs, repeats nothing.
    pub(super) fn is_repetition(&self, side: Responder, inputs: AnsweredInputs) -> bool {
        let other = match side {
            Responder::Cloud => Responder::Local,
            Responder::Local => Responder::Cloud,
        };
        self.inputs_per_output > AT_MOST_ONCE && inputs.oldest <= self.delivered[other.index()]
    }

    /// Records that an output was delivered.
    pub(super) fn note_delivered(&mut self, side: Responder, inputs: AnsweredInputs) {
        let newest = &mut self.delivered[side.index()];
        *newest = inputs.newest.max(*newest);
    }
}
