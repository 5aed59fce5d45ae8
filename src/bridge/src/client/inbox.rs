//! Messages in several parts or wrapped in others: fragments, and PNG images that contain text.

use std::sync::Arc;
use std::time::Instant;

use budget::{Budget, Exceeded, Permit};
use rosbridge::{Fragment, FragmentError, Fragments, Png, PngError, ProtocolFrame as Incoming};

use super::BridgeClient;
use crate::shared::BridgeShared;

/// Maximum nesting of fragments and PNG images.
const MAX_WRAPPING: usize = 4;

/// Reasons why the message within others cannot be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum WrappedMessageError {
    #[error(transparent)]
    Fragment(#[from] FragmentError),
    #[error(transparent)]
    Png(#[from] PngError),
    #[error("messages within messages go {limit} deep at most", limit = MAX_WRAPPING)]
    TooDeep,
}

/// Incomplete messages of one connection.
pub(crate) struct Inbox {
    fragments: Fragments,
    pictures: Fragments,
    permit: Permit,
}

impl Inbox {
    pub(crate) fn new(shared: &BridgeShared, budget: &Budget) -> Self {
        let limits = shared.options.fragments;
        Self { fragments: Fragments::new(limits), pictures: Fragments::new(limits), permit: budget.permit() }
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
    ) -> Result<(), WrappedMessageError> {
        let whole = inbox.fragments.add(op, Instant::now())?;
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
    ) -> Result<(), WrappedMessageError> {
        let whole = match op.fragment() {
            None => Some(op.data.to_string()),
            Some(part) => inbox.pictures.add(&part, Instant::now())?,
        };
        if let Some(data) = whole {
            let text = rosbridge::decode_png(&data, self.shared.options.max_png)?;
            self.handle_unwrapped(inbox, &text, wrapping)?;
        }
        Ok(())
    }

    fn handle_unwrapped(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        text: &str,
        wrapping: usize,
    ) -> Result<(), WrappedMessageError> {
        if wrapping == MAX_WRAPPING {
            return Err(WrappedMessageError::TooDeep);
        }
        self.handle_frame(inbox, Incoming::Text(text), None, wrapping + 1);
        Ok(())
    }
}
