//! Messages that come in several, or packed in others: fragments, and pictures that hold text.

use std::sync::Arc;
use std::time::Instant;

use budget::{Budget, Exceeded, Permit};
use rosbridge::{Fragment, Fragments, Frame as Incoming, Png};

use super::Client;
use crate::shared::Shared;

/// Messages packed in pictures in fragments in pictures: nobody needs more.
const MAX_WRAPPING: usize = 4;

/// What one connection has to remember besides: messages not yet complete.
pub(crate) struct Inbox {
    fragments: Fragments,
    pictures: Fragments,
    permit: Permit,
}

impl Inbox {
    pub(crate) fn new(shared: &Shared, budget: &Budget) -> Self {
        let limits = shared.options.fragments;
        Self {
            fragments: Fragments::new(limits),
            pictures: Fragments::new(limits),
            permit: budget.permit(),
        }
    }

    /// Counts unfinished messages of the client in its budget.
    pub(crate) fn count(&mut self) -> Result<(), Exceeded> {
        let held = self.fragments.bytes() + self.pictures.bytes();
        self.permit.resize(held)
    }
}

impl Client {
    pub(super) fn fragment(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        op: &Fragment<'_>,
        wrapping: usize,
    ) -> Result<(), String> {
        let whole = inbox
            .fragments
            .add(op, Instant::now())
            .map_err(|error| error.to_string())?;
        if let Some(text) = whole {
            self.unwrapped(inbox, &text, wrapping)?;
        }
        Ok(())
    }

    pub(super) fn png(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        op: &Png<'_>,
        wrapping: usize,
    ) -> Result<(), String> {
        let whole = match op.fragment() {
            None => Some(op.data.to_string()),
            Some(part) => inbox
                .pictures
                .add(&part, Instant::now())
                .map_err(|error| error.to_string())?,
        };
        if let Some(data) = whole {
            let text = rosbridge::decode_png(&data, self.shared.options.max_png)
                .map_err(|error| error.to_string())?;
            self.unwrapped(inbox, &text, wrapping)?;
        }
        Ok(())
    }

    fn unwrapped(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        text: &str,
        wrapping: usize,
    ) -> Result<(), String> {
        if wrapping == MAX_WRAPPING {
            return Err(format!(
                "messages within messages go {MAX_WRAPPING} deep at most"
            ));
        }
        self.frame(inbox, Incoming::Text(text), None, wrapping + 1);
        Ok(())
    }
}
