//! Which record may leave beside those that are under way.

use std::collections::{BTreeMap, VecDeque};

use super::lanes::{Lane, Lanes};
use super::out::Out;
use super::{SMALL, Sending};
use crate::limits::Limits;

/// Streams that messages and long answers leave to control and calls.
const RESERVED: usize = 2;

/// What is under way and waits, as far as others must wait for it.
pub(super) struct Gate<'a> {
    sending: &'a VecDeque<Sending>,
    lanes: &'a Lanes,
    /// By channel: the last order that was told before its first message.
    openings: &'a BTreeMap<u32, u64>,
    /// The first order that has not left as a whole.
    untold: Option<u64>,
    peer: Limits,
}

impl<'a> Gate<'a> {
    pub(super) fn new(
        sending: &'a VecDeque<Sending>,
        lanes: &'a Lanes,
        openings: &'a BTreeMap<u32, u64>,
        peer: Limits,
    ) -> Self {
        let started = sending.iter().map(|sending| &sending.out);
        let started = started.filter(|out| out.lane == Lane::Control);
        let untold = started.map(|out| out.order).chain(lanes.next_control());
        Self {
            sending,
            lanes,
            openings,
            untold: untold.min(),
            peer,
        }
    }

    /// Whether a record may leave: it overtakes none that it may not, and the peer takes one more.
    pub(super) fn lets(&self, out: &Out) -> bool {
        let mut started = self.sending.iter().map(|sending| &sending.out);
        started.all(|other| out.passes(other)) && self.is_open(out) && self.has_room(out)
    }

    /// Whether the peer has been told of its channel before; a channel is closed after its goals.
    fn is_open(&self, out: &Out) -> bool {
        let Some(channel) = out.channel else {
            return true;
        };
        let opening = self.openings.get(&channel);
        let is_told = opening.is_none_or(|at| self.untold.is_none_or(|untold| untold > *at));
        is_told && !(out.closes && self.has_goal(channel))
    }

    fn has_goal(&self, channel: u32) -> bool {
        let mut started = self.sending.iter().map(|sending| &sending.out);
        let is_goal = |out: &Out| out.lane == Lane::Calls && out.channel == Some(channel);
        started.any(is_goal) || self.lanes.has_goal(channel)
    }

    /// Whether the peer takes it beside what is under way: one always.
    fn has_room(&self, out: &Out) -> bool {
        if out.len() <= SMALL || self.sending.is_empty() {
            return true;
        }
        let reserved = match out.lane {
            Lane::Control | Lane::Calls => 0,
            _ => RESERVED,
        };
        let lengths = self.sending.iter().map(|sending| sending.out.len());
        let bytes = lengths.sum::<usize>() + out.len();
        self.sending.len() + reserved < self.peer.under_way && bytes <= self.peer.under_way_bytes
    }
}
