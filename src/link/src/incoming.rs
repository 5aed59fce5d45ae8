//! From frames to records: pieces put together, doubles dropped, what has come counted. No I/O.

use std::collections::{BTreeSet, HashMap};

use budget::{Budget, Permit};
use bytes::{Bytes, BytesMut};

use crate::frame::Received;
use crate::record::is_control;
use crate::{Error, Limits, MAX_FRAME};

/// Bytes allocated for a record before its bytes arrive; the buffer doubles as they do.
const READ_AHEAD: usize = 1 << 20;

/// What has come over the life of a session.
#[derive(Debug)]
pub(crate) struct Incoming {
    /// Where records under way count.
    budget: Budget,
    number: u64,
    ahead: BTreeSet<u64>,
    /// The first number on this connection, until the peer shows by using it that it knows what has come.
    next: Option<u64>,
    bytes: u64,
    streams: HashMap<u32, Partial>,
    partial: usize,
    pub(crate) limits: Limits,
}

#[derive(Debug)]
struct Partial {
    number: u64,
    total: usize,
    bytes: BytesMut,
    permit: Permit,
}

impl Default for Incoming {
    fn default() -> Self {
        Self::within(&Budget::unlimited())
    }
}

impl Incoming {
    /// An empty state, whose unfinished records count in `budget`.
    pub(crate) fn within(budget: &Budget) -> Self {
        Self {
            budget: budget.clone(),
            number: 0,
            ahead: BTreeSet::new(),
            next: None,
            bytes: 0,
            streams: HashMap::new(),
            partial: 0,
            limits: Limits::default(),
        }
    }

    /// All numbers up to this one have come, and those.
    pub(crate) fn state(&self) -> (u64, Vec<u64>) {
        (self.number, self.ahead.iter().copied().collect())
    }

    pub(crate) fn received(&self) -> Received {
        Received {
            number: self.number,
            bytes: self.bytes,
        }
    }

    /// How many records are under way, and their bytes together.
    #[cfg(test)]
    pub(crate) fn under_way(&self) -> (usize, usize) {
        (self.streams.len(), self.partial)
    }

    /// A new connection on which the peer's numbers begin with `next`. What was under way has to come again: the peer
    /// sends it under new numbers, once it has heard what came. The connection may be lost before that, so what came is
    /// not forgotten yet.
    pub(crate) fn reconnect(&mut self, next: u64) {
        self.streams.clear();
        self.partial = 0;
        self.next = Some(next);
    }

    /// Takes a record in one piece; `None` if it had come before.
    pub(crate) fn whole(&mut self, number: u64, record: Bytes) -> Result<Option<Bytes>, Error> {
        self.bytes += record.len() as u64;
        Ok(self.note(number)?.then_some(record))
    }

    /// Takes the beginning of a record in several pieces.
    pub(crate) fn begin(
        &mut self,
        stream: u32,
        number: u64,
        total: u32,
        bytes: &[u8],
    ) -> Result<Option<Bytes>, Error> {
        let total = total as usize;
        let limits = self.limits;
        if total > limits.record {
            return Err(too_much("a record", total, limits.record));
        }
        if is_control(bytes) && total > MAX_FRAME {
            return Err(too_much("a control record", total, MAX_FRAME));
        }
        let under_way = self.streams.len();
        if under_way >= limits.under_way {
            return Err(too_much("records under way", under_way, limits.under_way));
        }
        if bytes.len() > total || self.streams.contains_key(&stream) {
            return Err(Error::Protocol("a record that begins twice or is too long"));
        }
        self.partial += total;
        if self.partial > limits.under_way_bytes {
            let limit = limits.under_way_bytes;
            return Err(too_much("records under way", self.partial, limit));
        }
        let partial = Partial {
            number,
            total,
            bytes: BytesMut::new(),
            permit: self.budget.permit(),
        };
        self.streams.insert(stream, partial);
        self.more(stream, bytes)
    }

    /// Takes more of it; the record once it is whole.
    pub(crate) fn more(&mut self, stream: u32, bytes: &[u8]) -> Result<Option<Bytes>, Error> {
        let Some(partial) = self.streams.get_mut(&stream) else {
            return Err(Error::Protocol("more of a record that did not begin"));
        };
        self.bytes += bytes.len() as u64;
        if partial.bytes.len() + bytes.len() > partial.total {
            return Err(Error::Protocol("a record longer than it said"));
        }
        let missing = partial.total - partial.bytes.len();
        if partial.bytes.capacity() - partial.bytes.len() < bytes.len() {
            // It grows with what comes, not with what was promised.
            let room = partial.bytes.len().max(READ_AHEAD).max(bytes.len());
            let room = room.min(missing);
            partial.permit.grow_to(partial.bytes.len() + room)?;
            partial.bytes.reserve(room);
        }
        partial.bytes.extend_from_slice(bytes);
        if partial.bytes.len() < partial.total {
            return Ok(None);
        }
        let Some(whole) = self.streams.remove(&stream) else {
            return Ok(None);
        };
        self.partial -= whole.total;
        Ok(self.note(whole.number)?.then(|| whole.bytes.freeze()))
    }

    /// Whether a number is new.
    fn note(&mut self, number: u64) -> Result<bool, Error> {
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
            while self.ahead.remove(&self.number.wrapping_add(1)) {
                self.number = self.number.wrapping_add(1);
            }
            return Ok(true);
        }
        if self.ahead.len() >= self.limits.ahead {
            return Err(too_much(
                "numbers ahead",
                self.ahead.len(),
                self.limits.ahead,
            ));
        }
        self.ahead.insert(number);
        Ok(true)
    }
}

pub(crate) fn too_much(what: &'static str, bytes: usize, limit: usize) -> Error {
    Error::TooMuch {
        what,
        bytes: bytes as u64,
        limit: limit as u64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_under_way_take_no_more_than_their_budget() {
        let budget = Budget::new("servant x", 4 << 20);
        let mut incoming = Incoming::within(&budget);
        // Promises cost little.
        for stream in 0..2 {
            let begun = incoming.begin(stream, u64::from(stream) + 1, 100 << 20, b"x");
            assert!(begun.expect("there is room").is_none());
        }
        assert_eq!(budget.used(), 2 * READ_AHEAD);
        let more = vec![7; 2 * READ_AHEAD];
        let refused = incoming
            .more(0, &more)
            .and_then(|_| incoming.more(1, &more));
        let refused = refused.expect_err("both cannot grow");
        assert!(
            refused.to_string().contains("the memory for servant x"),
            "{refused}"
        );
        incoming.reconnect(1);
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn a_whole_record_counts_no_longer() {
        let budget = Budget::new("servant x", 3 << 20);
        let mut incoming = Incoming::within(&budget);
        let begun = incoming
            .begin(1, 1, 1000, &[7; 400])
            .expect("there is room");
        assert!(begun.is_none() && budget.used() == 1000);
        let whole = incoming.more(1, &[7; 600]).expect("there is room");
        assert_eq!(whole, Some(vec![7; 1000].into()));
        assert_eq!(budget.used(), 0);
    }
}
