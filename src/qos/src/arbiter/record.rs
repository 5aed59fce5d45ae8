//! A request and the progress of each side on it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::channel::RequestChannel;
use crate::request::{CorrelationKey, RequestLeg, Responder, Responders};

/// The kind of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A service call, with exactly one result.
    Call,
    /// A goal of an action, sent by calls (ROS 2) or on topics, with exactly one result. It may take long, and the side
    /// that accepted it carries it out even while the link to it is down.
    Goal,
    /// An input message of the pair with this index.
    Input(usize),
}

#[derive(Debug)]
pub(crate) struct Record<P> {
    pub(crate) kind: Kind,
    pub(crate) channel: RequestChannel,
    /// Name of the channel and key that its answers carry.
    pub(crate) key: Option<(Arc<str>, CorrelationKey)>,
    /// The message; dropped once the request is answered or failed, or, for an input, too old to be sent to another
    /// side.
    pub(crate) payload: Option<P>,
    pub(crate) asked_at: Instant,
    pub(crate) deadline: Instant,
    /// Time at which the request is checked next.
    pub(super) timer: Instant,
    pub(crate) cloud: RequestLeg,
    pub(crate) local: RequestLeg,
    /// The side whose answer was taken, per output; the first output is the answer.
    pub(super) owners: Vec<Option<Responder>>,
    /// The application was told that no answer will come.
    pub(crate) failed: bool,
    /// T_max has passed, and the request is not known to have been left out.
    pub(crate) overdue: bool,
    /// When T_max passed, neither this request nor a later one had been answered.
    pub(crate) missed: bool,
    /// For a goal: a side has accepted it or reported progress.
    pub(crate) taken: bool,
    /// The cloud's time, or its absence, has counted towards Q.
    pub(crate) judged: bool,
    /// Time at which the local original was asked.
    pub(crate) local_asked: Option<Instant>,
    /// Response time of the cloud, once it has answered.
    pub(crate) cloud_time: Option<Duration>,
    /// Response time of the first answer.
    pub(crate) answer_time: Option<Duration>,
}

impl<P> Record<P> {
    pub(crate) fn leg(&mut self, side: Responder) -> &mut RequestLeg {
        match side {
            Responder::Cloud => &mut self.cloud,
            Responder::Local => &mut self.local,
        }
    }

    pub(crate) fn answered_by(&self) -> Option<Responder> {
        self.owners[0]
    }

    /// Returns true if the request is neither answered nor failed.
    pub(crate) fn is_open(&self) -> bool {
        self.answered_by().is_none() && !self.failed
    }

    pub(crate) fn is_call(&self) -> bool {
        !matches!(self.kind, Kind::Input(_))
    }

    /// Returns true if a caller waits for the result, without a time limit.
    pub(crate) fn has_caller(&self) -> bool {
        matches!(self.channel, RequestChannel::Call(_))
    }

    /// Returns true if the first answer of either side arrived by T_max.
    pub(crate) fn is_in_time(&self) -> bool {
        let took = self.answer_time;
        took.is_some_and(|took| self.asked_at + took <= self.deadline)
    }

    pub(super) fn awaits_nobody(&self) -> bool {
        let awaited = |leg: &RequestLeg| matches!(leg, RequestLeg::Asked | RequestLeg::Lost);
        !awaited(&self.cloud) && !awaited(&self.local)
    }

    /// Records that `side` skipped this request: it answered a later one, or was busy when this one arrived. Returns
    /// true if that is known within T_max.
    pub(crate) fn mark_left_out(&mut self, side: Responder) -> bool {
        if *self.leg(side) != RequestLeg::Answered {
            *self.leg(side) = RequestLeg::LeftOut;
        }
        !self.overdue
    }

    /// Records an output of `side` for a goal. Returns false if the output is not for the application, because the
    /// other side speaks for the node: the side that was first keeps speaking as long as it is among the active
    /// `sides`.
    pub(crate) fn accept_output(&mut self, side: Responder, output: usize, sides: Responders) -> bool {
        if self.kind != Kind::Goal || output == 0 {
            return true;
        }
        self.taken = true;
        if let Some(owner) = self.owners.get_mut(output) {
            *owner = owner.filter(|side| sides.contains(*side));
        }
        sides.contains(side) || sides == Responders::default()
    }
}
