//! Reassembly of records from frames: joins pieces, drops duplicates and tracks what was received. No I/O.

use std::collections::hash_map::Entry;
use std::collections::{BTreeSet, HashMap};

use budget::{Budget, Permit};
use bytes::{Bytes, BytesMut};

use crate::frame::ReceiveProgress;
use crate::record::is_control;
use crate::{Error, LinkLimits, MAX_FRAME};

/// Bytes allocated for a record before its bytes arrive; the buffer doubles as they do.
const READ_AHEAD: usize = 1 << 20;

/// Receive state of a session.
#[derive(Debug, Default)]
pub(crate) struct Incoming {
    /// Budget for incomplete records; `None`: without a limit.
    pub(crate) budget: Option<Budget>,
    number: u64,
    ahead: BTreeSet<u64>,
    /// The first number on this connection, until the peer uses it and thereby shows that it knows what was received.
    next: Option<u64>,
    bytes: u64,
    pub(crate) streams: HashMap<u32, Partial>,
    /// Total length of the incomplete records.
    pub(crate) partial: usize,
    pub(crate) limits: LinkLimits,
}

#[derive(Debug)]
pub(crate) struct Partial {
    number: u64,
    total: usize,
    bytes: BytesMut,
    permit: Option<Permit>,
}

impl Incoming {
    /// Returns the number up to which all records have been received, and the received numbers beyond it.
    pub(crate) fn received_numbers(&self) -> (u64, Vec<u64>) {
        (self.number, self.ahead.iter().copied().collect())
    }

    pub(crate) fn progress(&self) -> ReceiveProgress {
        ReceiveProgress { number: self.number, bytes: self.bytes }
    }

    /// Returns whether a record is incomplete.
    pub(crate) fn is_receiving(&self) -> bool {
        !self.streams.is_empty()
    }

    /// Begins a new connection on which the peer's numbers start at `next`. Incomplete records must be sent again: the
    /// peer does so under new numbers once it knows what was received. Because the connection may be lost before that,
    /// the received numbers are not forgotten yet.
    pub(crate) fn reconnect(&mut self, next: u64) {
        self.streams.clear();
        self.partial = 0;
        self.next = Some(next);
    }

    /// Receives a record in one piece. Returns `None` for a duplicate.
    pub(crate) fn receive_whole(&mut self, number: u64, record: Bytes) -> Result<Option<Bytes>, Error> {
        self.bytes += record.len() as u64;
        Ok(self.note_number(number)?.then_some(record))
    }

    /// Receives the beginning of a record in several pieces.
    pub(crate) fn receive_begin(
        &mut self,
        stream: u32,
        number: u64,
        total: u32,
        bytes: &[u8],
    ) -> Result<Option<Bytes>, Error> {
        let total = total as usize;
        let limits = self.limits;
        check_limit("a record", total, limits.record)?;
        if is_control(bytes) {
            check_limit("a control record", total, MAX_FRAME)?;
        }
        check_limit("records under way", self.streams.len() + 1, limits.under_way)?;
        if bytes.len() > total || self.streams.contains_key(&stream) {
            return Err(Error::Protocol("a record that begins twice or is too long"));
        }
        self.partial += total;
        check_limit("records under way", self.partial, limits.under_way_bytes)?;
        let partial =
            Partial { number, total, bytes: BytesMut::new(), permit: self.budget.as_ref().map(Budget::permit) };
        self.streams.insert(stream, partial);
        self.receive_more(stream, bytes)
    }

    /// Receives the next piece; returns the record once it is complete.
    pub(crate) fn receive_more(&mut self, stream: u32, bytes: &[u8]) -> Result<Option<Bytes>, Error> {
        let Entry::Occupied(mut entry) = self.streams.entry(stream) else {
            return Err(Error::Protocol("more of a record that did not begin"));
        };
        let partial = entry.get_mut();
        self.bytes += bytes.len() as u64;
        if partial.bytes.len() + bytes.len() > partial.total {
            return Err(Error::Protocol("a record longer than it said"));
        }
        let missing = partial.total - partial.bytes.len();
        if partial.bytes.capacity() - partial.bytes.len() < bytes.len() {
            // Memory grows with what is received, not with the announced length.
            let room = partial.bytes.len().max(READ_AHEAD).max(bytes.len());
            let room = room.min(missing);
            partial.permit.as_mut().map_or(Ok(()), |permit| permit.grow_to(partial.bytes.len() + room))?;
            partial.bytes.reserve(room);
        }
        partial.bytes.extend_from_slice(bytes);
        if partial.bytes.len() < partial.total {
            return Ok(None);
        }
        let whole = entry.remove();
        self.partial -= whole.total;
        Ok(self.note_number(whole.number)?.then(|| whole.bytes.freeze()))
    }

    /// Records a received number and returns whether it is new.
    fn note_number(&mut self, number: u64) -> Result<bool, Error> {
        if number == 0 {
            return Ok(true);
        }
        if let Some(next) = self.next.take() {
            self.ahead.clear();
            self.number = next.wrapping_sub(1);
        }
        if number <= self.number || self.ahead.contains(&number) {
            return Ok(false);
        }
        if number == self.number.wrapping_add(1) {
            self.number = number;
        } else {
            check_limit("numbers ahead", self.ahead.len() + 1, self.limits.ahead)?;
            self.ahead.insert(number);
        }
        while self.ahead.remove(&self.number.wrapping_add(1)) {
            self.number = self.number.wrapping_add(1);
        }
        Ok(true)
    }
}

pub(crate) fn check_limit(what: &'static str, bytes: usize, limit: usize) -> Result<(), Error> {
    if bytes > limit {
        return Err(Error::TooMuch { what, bytes: bytes as u64, limit: limit as u64 });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn incomplete_records_stay_within_their_budget() {
        let budget = Budget::new("servant x", 4 << 20);
        let mut incoming = Incoming { budget: Some(budget.clone()), ..Incoming::default() };
        // Announced lengths cost little memory.
        for stream in 0..2 {
            let begun = incoming.receive_begin(stream, u64::from(stream) + 1, 100 << 20, b"x");
            assert!(begun.expect("there is room").is_none());
        }
        assert_eq!(budget.used_bytes(), 2 * READ_AHEAD);
        let more = vec![7; 2 * READ_AHEAD];
        let refused = incoming.receive_more(0, &more).and_then(|_| incoming.receive_more(1, &more));
        let refused = refused.expect_err("both cannot grow");
        assert!(refused.to_string().contains("the memory for servant x"), "{refused}");
        incoming.reconnect(1);
        assert_eq!(budget.used_bytes(), 0);
    }

    #[test]
    fn a_complete_record_releases_its_budget() {
        let budget = Budget::new("servant x", 3 << 20);
        let mut incoming = Incoming { budget: Some(budget.clone()), ..Incoming::default() };
        let begun = incoming.receive_begin(1, 1, 1000, &[7; 400]).expect("there is room");
        assert!(begun.is_none() && budget.used_bytes() == 1000);
        let whole = incoming.receive_more(1, &[7; 600]).expect("there is room");
        assert_eq!(whole, Some(vec![7; 1000].into()));
        assert_eq!(budget.used_bytes(), 0);
    }
}
