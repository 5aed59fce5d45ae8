//! Messages that a client sends before the servant is ready.

use std::collections::VecDeque;

use budget::{Budget, Permit};
use rosbridge::ProtocolFrame as Incoming;
use ws::WsMessage;

/// Maximum number of messages kept, and bytes above which no more are.
const MESSAGES: usize = 10_000;
const BYTES: usize = 16 << 20;

/// Messages in the order of arrival.
pub(crate) struct EarlyMessages {
    messages: VecDeque<WsMessage>,
    bytes: usize,
    permit: Permit,
    /// Number of publications dropped.
    left_out: u64,
}

/// Result of adding a message.
pub(crate) enum EarlyMessageOutcome {
    Kept,
    /// A publication was dropped for lack of room; `first` if it is the first one.
    LeftOut {
        first: bool,
    },
    /// The message was refused for lack of room; contains the reason.
    Refused(String),
}

impl EarlyMessages {
    /// Creates an empty queue; messages count in `budget`.
    pub(crate) fn with_budget(budget: &Budget) -> Self {
        Self { messages: VecDeque::new(), bytes: 0, permit: budget.permit(), left_out: 0 }
    }

    /// Adds a message. Beyond the limits publications are dropped, as a full queue drops them later; without other
    /// messages the session would differ from what the client has asked for, so they are refused.
    pub(crate) fn push(&mut self, message: WsMessage) -> EarlyMessageOutcome {
        let (WsMessage::Text(bytes) | WsMessage::Binary(bytes)) = &message else {
            return EarlyMessageOutcome::Kept;
        };
        let length = bytes.len();
        let full = if self.messages.len() >= MESSAGES || self.bytes >= BYTES {
            format!(
                "{} messages of {} bytes wait for the servant to start, which is the limit; send more when it answers",
                self.messages.len(),
                self.bytes
            )
        } else {
            match self.permit.count(self.bytes + length) {
                Ok(()) => {
                    self.bytes += length;
                    self.messages.push_back(message);
                    return EarlyMessageOutcome::Kept;
                }
                Err(full) => full.to_string(),
            }
        };
        if is_publication(&message) {
            self.left_out += 1;
            return EarlyMessageOutcome::LeftOut { first: self.left_out == 1 };
        }
        EarlyMessageOutcome::Refused(full)
    }

    /// Takes the oldest message.
    pub(crate) fn pop(&mut self) -> Option<WsMessage> {
        let message = self.messages.pop_front()?;
        if let WsMessage::Text(bytes) | WsMessage::Binary(bytes) = &message {
            self.bytes -= bytes.len();
        }
        // Shrinking always succeeds.
        let _ = self.permit.count(self.bytes);
        Some(message)
    }
}

fn is_publication(message: &WsMessage) -> bool {
    let frame = match message {
        WsMessage::Text(bytes) => match std::str::from_utf8(bytes) {
            Ok(text) => Incoming::Text(text),
            Err(_) => return false,
        },
        WsMessage::Binary(bytes) => Incoming::from_binary(bytes),
        _ => return false,
    };
    rosbridge::text_field(frame, "op").as_deref() == Some("publish")
}
