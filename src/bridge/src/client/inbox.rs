//! Messages in several parts or wrapped in others: fragments, and PNG images that contain text.

use std::sync::Arc;
use std::time::Instant;

use budget::{Budget, Exceeded, Permit};
use rosbridge::{Fragment, Fragments, Png, ProtocolFrame as Incoming};

use super::BridgeClient;
use crate::shared::BridgeShared;

/// Maximum nesting of fragments and PNG images.
const MAX_WRAPPING: usize = 4;

/// Incomplete messages of one connection.
pub(crate) struct Inbox {
    fragments: Fragments,
    pictures: Fragments,
    permit: Permit,
}

impl Inbox {
    pub(crate) fn new(shared: &BridgeShared, budget: &Budget) -> Self {
        let limits = shared.options.fragments;
        Self {
            fragments: Fragments::new(limits),
            pictures: Fragments::new(limits),
            permit: budget.permit(),
        }
    }

    /// Counts the client's incomplete messages in its budget.
    pub(crate) fn count(&mut self) -> Result<(), Exceeded> {
        let held = self.fragments.bytes() + self.pictures.bytes();
        self.permit.resize(held)
    }
}

impl BridgeClient {
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
            self.handle_unwrapped(inbox, &text, wrapping)?;
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
            self.handle_unwrapped(inbox, &text, wrapping)?;
        }
        Ok(())
    }

    fn handle_unwrapped(
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
        self.handle_frame(inbox, Incoming::Text(text), None, wrapping + 1);
        Ok(())
    }
}
