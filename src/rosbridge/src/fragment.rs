//! `fragment`: parts of a message that was too long for one frame, and their bounded reassembly.

use std::borrow::Cow;
use std::collections::HashMap;
use std::time::{Duration, Instant};

use crate::Id;
use crate::field_kinds::{Count, Data, RequiredId};
use crate::message::message;

message! {
    /// One fragment of a message.
    Fragment "fragment"
    /// Id of the message it belongs to.
    id: Id<'a> = RequiredId("the id common to all fragments of the message"),
    /// A piece of that message's JSON text.
    data: Cow<'a, str> = "data" Data("a piece of the message's text"),
    /// Index of the fragment, from 0.
    num: u64 = "num" Count((0, "the fragment's index, from 0,")),
    /// Total number of fragments.
    total: u64 = "total" Count((1, "the number of fragments, 1 or more,")),
}

/// Limits of one client's incomplete messages.
#[derive(Debug, Clone, Copy)]
pub struct FragmentLimits {
    /// Maximum number of incomplete messages.
    pub messages: usize,
    /// Maximum number of fragments of one message.
    pub parts: usize,
    /// Maximum bytes of all incomplete messages together.
    pub bytes: usize,
    /// Maximum time since the last fragment of a message.
    pub age: Duration,
}

impl Default for FragmentLimits {
    fn default() -> Self {
        Self { messages: 16, parts: 65_536, bytes: 64 << 20, age: Duration::from_secs(60) }
    }
}

/// Reason why a fragment was dropped.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FragmentError {
    /// `num` is not below `total`.
    #[error("fragment {num} of {total}: \"num\" must be below \"total\"")]
    Index {
        /// Index as sent.
        num: u64,
        /// Total as sent.
        total: u64,
    },
    /// `total` differs from the earlier fragments'.
    #[error("\"total\" is {total}, the earlier fragments said {earlier}; the message is dropped")]
    Total {
        /// Total as sent.
        total: u64,
        /// Total of the earlier fragments.
        earlier: usize,
    },
    /// A fragment was sent again with different data.
    #[error("fragment {0} came twice with different data; the message is dropped")]
    Doubled(u64),
    /// There are too many fragments.
    #[error("\"total\" is {total}, at most {limit} fragments are allowed")]
    Parts {
        /// Total as sent.
        total: u64,
        /// Maximum number of fragments.
        limit: usize,
    },
    /// There are too many bytes.
    #[error("unfinished messages hold more than {0} bytes; the message is dropped")]
    Bytes(usize),
}

struct PartialMessage {
    parts: Vec<Option<Box<str>>>,
    missing: usize,
    bytes: usize,
    touched: Instant,
}

/// The incomplete messages of one client.
pub struct Fragments {
    limits: FragmentLimits,
    partial: HashMap<Id<'static>, PartialMessage>,
    bytes: usize,
}

impl Fragments {
    /// Creates an empty set.
    pub fn new(limits: FragmentLimits) -> Self {
        Self { limits, partial: HashMap::new(), bytes: 0 }
    }

    /// Adds a fragment; returns the message when it is complete. The order of fragments does not matter.
    ///
    /// # Errors
    /// Returns the reason why the fragment was dropped. If fragments contradict each other the whole message is
    /// dropped.
    pub fn add(&mut self, fragment: &Fragment<'_>, now: Instant) -> Result<Option<String>, FragmentError> {
        let Fragment { num, total, .. } = *fragment;
        if num >= total {
            return Err(FragmentError::Index { num, total });
        }
        if total > self.limits.parts as u64 {
            return Err(FragmentError::Parts { total, limit: self.limits.parts });
        }
        if total == 1 {
            return Ok(Some(fragment.data.to_string()));
        }
        self.forget_old(now);
        let id = fragment.id.clone().into_owned();
        if !self.partial.contains_key(&id) {
            self.make_room();
        }
        // An empty slot uses as much memory as a filled one.
        let slots = total as usize * size_of::<Option<Box<str>>>();
        let mut begun = 0;
        let partial = self.partial.entry(id.clone()).or_insert_with(|| {
            begun = slots;
            PartialMessage { parts: vec![None; total as usize], missing: total as usize, bytes: slots, touched: now }
        });
        self.bytes += begun;
        partial.touched = now;
        let earlier = partial.parts.len();
        if earlier as u64 != total {
            self.forget(&id);
            return Err(FragmentError::Total { total, earlier });
        }
        let slot = &mut partial.parts[num as usize];
        match slot {
            Some(data) if **data == *fragment.data => return Ok(None),
            Some(_) => {
                self.forget(&id);
                return Err(FragmentError::Doubled(num));
            }
            None => {}
        }
        if self.bytes + fragment.data.len() > self.limits.bytes {
            self.forget(&id);
            return Err(FragmentError::Bytes(self.limits.bytes));
        }
        *slot = Some(fragment.data.as_ref().into());
        partial.missing -= 1;
        partial.bytes += fragment.data.len();
        self.bytes += fragment.data.len();
        if partial.missing > 0 {
            return Ok(None);
        }
        let whole = partial.parts.iter().flatten().map(AsRef::as_ref).collect();
        self.forget(&id);
        Ok(Some(whole))
    }

    /// Returns the bytes held now.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Drops messages whose last fragment is too old; returns their number.
    pub fn forget_old(&mut self, now: Instant) -> usize {
        let age = self.limits.age;
        let old = |partial: &PartialMessage| now.saturating_duration_since(partial.touched) > age;
        let ids: Vec<_> = self.partial.iter().filter(|(_, partial)| old(partial)).map(|(id, _)| id.clone()).collect();
        for id in &ids {
            self.forget(id);
        }
        ids.len()
    }

    fn make_room(&mut self) {
        while self.partial.len() >= self.limits.messages.max(1) {
            let oldest = self.partial.iter().min_by_key(|(_, partial)| partial.touched).map(|(id, _)| id.clone());
            match oldest {
                Some(id) => self.forget(&id),
                None => return,
            }
        }
    }

    fn forget(&mut self, id: &Id<'static>) {
        if let Some(partial) = self.partial.remove(id) {
            self.bytes -= partial.bytes;
        }
    }
}

/// Splits a text into pieces of at most `size` bytes (a wider character is a piece of its own).
pub fn split_text(text: &str, size: usize) -> impl Iterator<Item = &str> {
    let mut rest = text;
    std::iter::from_fn(move || {
        let first = rest.chars().next()?;
        let mut at = size.max(first.len_utf8()).min(rest.len());
        while !rest.is_char_boundary(at) {
            at -= 1;
        }
        let (piece, tail) = rest.split_at(at);
        rest = tail;
        Some(piece)
    })
}

#[cfg(test)]
#[path = "fragment_tests.rs"]
mod tests;
