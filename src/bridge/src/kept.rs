//! What a client sends before there is a servant to take it.

use std::collections::VecDeque;

use budget::{Budget, Permit};
use rosbridge::Frame as Incoming;
use ws::Message;

/// Most messages that are kept, and their bytes beyond which no more is.
const MESSAGES: usize = 10_000;
const BYTES: usize = 16 << 20;

/// Messages in the order they came.
pub(crate) struct Kept {
    messages: VecDeque<Message>,
    bytes: usize,
    permit: Permit,
    /// Publications that were left out.
    left_out: u64,
}

/// What became of a message.
pub(crate) enum Taken {
    Kept,
    /// It is a publication for which there is no room; the first such, or another.
    LeftOut {
        first: bool,
    },
    /// It is something else for which there is no room; the reason.
    Refused(String),
}

impl Kept {
    /// Nothing yet; what comes counts in `budget`.
    pub(crate) fn within(budget: &Budget) -> Self {
        Self {
            messages: VecDeque::new(),
            bytes: 0,
            permit: budget.permit(),
            left_out: 0,
        }
    }

    /// Takes a message. Beyond the limits publications are left out, as a queue that is full leaves them out later; without
    /// the rest the session would be another one than the client has asked for.
    pub(crate) fn take(&mut self, message: Message) -> Taken {
        let (Message::Text(bytes) | Message::Binary(bytes)) = &message else {
            return Taken::Kept;
        };
        let length = bytes.len();
        let full = if self.messages.len() >= MESSAGES || self.bytes >= BYTES {
            format!(
                "{} messages of {} bytes wait for the servant to start, no more are kept; send what follows when it answers",
                self.messages.len(),
                self.bytes
            )
        } else {
            match self.permit.count(self.bytes + length) {
                Ok(()) => {
                    self.bytes += length;
                    self.messages.push_back(message);
                    return Taken::Kept;
                }
                Err(full) => full.to_string(),
            }
        };
        if is_publication(&message) {
            self.left_out += 1;
            return Taken::LeftOut {
                first: self.left_out == 1,
            };
        }
        Taken::Refused(full)
    }

    /// The oldest.
    pub(crate) fn pop(&mut self) -> Option<Message> {
        let message = self.messages.pop_front()?;
        if let Message::Text(bytes) | Message::Binary(bytes) = &message {
            self.bytes -= bytes.len();
        }
        // Less always fits.
        let _ = self.permit.count(self.bytes);
        Some(message)
    }
}

fn is_publication(message: &Message) -> bool {
    let frame = match message {
        Message::Text(bytes) => match std::str::from_utf8(bytes) {
            Ok(text) => Incoming::Text(text),
            Err(_) => return false,
        },
        Message::Binary(bytes) => Incoming::Binary(bytes),
        _ => return false,
    };
    rosbridge::text_field(frame, "op").as_deref() == Some("publish")
}
