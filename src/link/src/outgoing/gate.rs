//! Decides which record may be sent while others are in flight.

use super::Outgoing;
use super::lanes::RecordLane;
use super::outgoing_record::OutgoingRecord;

/// Streams reserved for control records and calls, which messages and long responses may not use.
const RESERVED_STREAMS: usize = 2;

impl Outgoing {
    /// Returns whether a record may be sent: it overtakes none that it must not overtake, and the peer accepts one
    /// more.
    pub(super) fn allows(&self, out: &OutgoingRecord) -> bool {
        self.started_records().all(|other| out.may_overtake(other)) && self.is_open(out) && self.has_room(out)
    }

    /// Returns the records of which a part has been sent.
    fn started_records(&self) -> impl Iterator<Item = &OutgoingRecord> {
        self.sending.iter().map(|sending| &sending.out)
    }

    /// Returns the records of a lane that have not been sent completely, in order.
    fn unsent_records(&self, lane: RecordLane) -> impl Iterator<Item = &OutgoingRecord> {
        self.started_records().filter(move |out| out.lane == lane).chain(self.lanes.records_of(lane))
    }

    /// Returns whether the channel has been announced to the peer; a channel is closed after its goals.
    fn is_open(&self, out: &OutgoingRecord) -> bool {
        let Some(channel) = out.channel else {
            return true;
        };
        let untold = self.unsent_records(RecordLane::Control).next();
        let opening = self.openings.get(&channel);
        let is_told = opening.is_none_or(|at| untold.is_none_or(|untold| untold.order > *at));
        let has_goal = || self.unsent_records(RecordLane::Calls).any(|goal| goal.channel == Some(channel));
        is_told && !(out.closes && has_goal())
    }

    /// Returns whether the peer accepts the record in addition to those in flight; one is always accepted.
    fn has_room(&self, out: &OutgoingRecord) -> bool {
        if self.fits_one_frame(out) || self.sending.is_empty() {
            return true;
        }
        let reserved = match out.lane {
            RecordLane::Control | RecordLane::Calls => 0,
            _ => RESERVED_STREAMS,
        };
        let bytes = self.started_records().map(OutgoingRecord::len).sum::<usize>() + out.len();
        self.sending.len() + reserved < self.peer.under_way && bytes <= self.peer.under_way_bytes
    }
}
