//! A request, and how far each side is with it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::channel::Channel;
use crate::request::{Key, Leg, Side, Sides};

/// What kind of request it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A service call: exactly one result.
    Call,
    /// A goal of an action, by calls (ROS 2) or on topics: exactly one result. It may take long, and whoever has taken it carries
    /// it out while the way there is lost.
    Goal,
    /// An input of the pair with this index.
    Input(usize),
}

#[derive(Debug)]
pub(crate) struct Record<P> {
    pub(crate) kind: Kind,
    pub(crate) channel: Channel,
    /// By what its answers are recognised, with the name of its channel.
    pub(crate) key: Option<(Arc<str>, Key)>,
    /// Until it is answered, failed, or, for inputs, too old to be asked anew.
    pub(crate) payload: Option<P>,
    pub(crate) asked_at: Instant,
    pub(crate) deadline: Instant,
    /// When it is looked at again.
    pub(super) timer: Instant,
    pub(crate) cloud: Leg,
    pub(crate) local: Leg,
    /// Whose answer was taken, per output; the first one is the answer.
    pub(super) owners: Vec<Option<Side>>,
    /// The application was told that there will be no answer.
    pub(crate) failed: bool,
    /// T_max has passed, and nobody is known to have left it out.
    pub(crate) overdue: bool,
    /// When T_max passed, neither it nor a later one was answered.
    pub(crate) missed: bool,
    /// A goal: a side has accepted it, or said how far it is.
    pub(crate) taken: bool,
    /// The cloud's time has counted, or that it had none.
    pub(crate) judged: bool,
    /// When the local original was asked.
    pub(crate) local_asked: Option<Instant>,
    /// The cloud's time, once it has answered.
    pub(crate) cloud_time: Option<Duration>,
    /// The time of the first answer.
    pub(crate) answer_time: Option<Duration>,
}

impl<P> Record<P> {
    pub(crate) fn leg(&mut self, side: Side) -> &mut Leg {
        match side {
            Side::Cloud => &mut self.cloud,
            Side::Local => &mut self.local,
        }
    }

    pub(crate) fn answered(&self) -> Option<Side> {
        self.owners[0]
    }

    /// Neither answered nor failed.
    pub(crate) fn is_open(&self) -> bool {
        self.answered().is_none() && !self.failed
    }

    pub(crate) fn is_call(&self) -> bool {
        !matches!(self.kind, Kind::Input(_))
    }

    /// Somebody waits for the result as long as it takes.
    pub(crate) fn has_caller(&self) -> bool {
        matches!(self.channel, Channel::Call(_))
    }

    /// The first answer of either side came by T_max.
    pub(crate) fn is_in_time(&self) -> bool {
        let took = self.answer_time;
        took.is_some_and(|took| self.asked_at + took <= self.deadline)
    }

    pub(super) fn awaits_nobody(&self) -> bool {
        let awaited = |leg: &Leg| matches!(leg, Leg::Asked | Leg::Lost);
        !awaited(&self.cloud) && !awaited(&self.local)
    }

    /// `side` has gone on to a later request, or was not free for this one. True where it was within T_max.
    pub(crate) fn note_left_out(&mut self, side: Side) -> bool {
        if *self.leg(side) != Leg::Answered {
            *self.leg(side) = Leg::LeftOut;
        }
        !self.overdue
    }

    /// `side` says something of a goal beside its result. False where that is not for the application: the other side speaks for the
    /// node. Whoever was first goes on as long as it is among the `sides` that are there.
    pub(crate) fn hears(&mut self, side: Side, output: usize, sides: Sides) -> bool {
        if self.kind != Kind::Goal || output == 0 {
            return true;
        }
        self.taken = true;
        if let Some(owner) = self.owners.get_mut(output) {
            *owner = owner.filter(|side| sides.has(*side));
        }
        sides.has(side) || sides == Sides::default()
    }
}
