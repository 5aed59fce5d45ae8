//! Decides which record may be sent while others are in flight.

use std::collections::{BTreeMap, VecDeque};

use super::lanes::{RecordLane, RecordLanes};
use super::out::{InFlightRecord, OutgoingRecord, SMALL};
use crate::limits::LinkLimits;

/// Streams reserved for control records and calls, which messages and long responses may not use.
const RESERVED: usize = 2;

/// The records in flight and queued for which others must wait.
pub(super) struct Gate<'a> {
    sending: &'a VecDeque<InFlightRecord>,
    lanes: &'a RecordLanes,
    /// By channel: the last control record that was pushed before its first message.
    openings: &'a BTreeMap<u32, u64>,
    /// The first control record that has not been sent completely.
    untold: Option<u64>,
    peer: LinkLimits,
}

impl<'a> Gate<'a> {
    pub(super) fn new(
        sending: &'a VecDeque<InFlightRecord>,
        lanes: &'a RecordLanes,
        openings: &'a BTreeMap<u32, u64>,
        peer: LinkLimits,
    ) -> Self {
        let started = sending.iter().map(|sending| &sending.out);
        let started = started.filter(|out| out.lane == RecordLane::Control);
        let untold = started.map(|out| out.order).chain(lanes.next_control());
        Self { sending, lanes, openings, untold: untold.min(), peer }
    }

    /// Returns whether a record may be sent: it overtakes none that it must not overtake, and the peer accepts one
    /// more.
    pub(super) fn allows(&self, out: &OutgoingRecord) -> bool {
        let mut started = self.sending.iter().map(|sending| &sending.out);
        started.all(|other| out.may_overtake(other)) && self.is_open(out) && self.has_room(out)
    }

    /// Returns whether the channel has been announced to the peer; a channel is closed after its goals.
    fn is_open(&self, out: &OutgoingRecord) -> bool {
        let Some(channel) = out.channel else {
            return true;
        };
        let opening = self.openings.get(&channel);
        let is_told = opening.is_none_or(|at| self.untold.is_none_or(|untold| untold > *at));
        is_told && !(out.closes && self.has_goal(channel))
    }

    fn has_goal(&self, channel: u32) -> bool {
        let mut started = self.sending.iter().map(|sending| &sending.out);
        let is_goal = |out: &OutgoingRecord| out.lane == RecordLane::Calls && out.channel == Some(channel);
        started.any(is_goal) || self.lanes.has_goal(channel)
    }

    /// Returns whether the peer accepts the record in addition to those in flight; one is always accepted.
    fn has_room(&self, out: &OutgoingRecord) -> bool {
        if out.len() <= SMALL || self.sending.is_empty() {
            return true;
        }
        let reserved = match out.lane {
            RecordLane::Control | RecordLane::Calls => 0,
            _ => RESERVED,
        };
        let lengths = self.sending.iter().map(|sending| sending.out.len());
        let bytes = lengths.sum::<usize>() + out.len();
        self.sending.len() + reserved < self.peer.under_way && bytes <= self.peer.under_way_bytes
    }
}
