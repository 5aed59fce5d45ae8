//! The queue of one subscription: bounded, drops the oldest messages, never blocks the sender.

use std::fmt;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::Notify;

use super::SerializedMessage;
use crate::ring::{DropCount, Ring, RingBounds};

/// Creates the two ends of a queue for at most `capacity` messages (0 counts as 1).
///
/// Beyond that, or beyond 64 MiB, the oldest messages are dropped and counted.
pub fn message_queue(capacity: usize) -> (MessageSender, MessageReceiver) {
    let shared = Arc::new(MessageQueue {
        state: Mutex::new(State {
            ring: Ring::new(RingBounds::with_messages(capacity)),
            sender_gone: false,
            receiver_gone: false,
        }),
        ready: Notify::new(),
        dropped: Arc::default(),
    });
    (MessageSender { shared: shared.clone() }, MessageReceiver { shared, conversion: None })
}

/// Converts a message as it is read; `None` leaves it out.
type Conversion = dyn Fn(SerializedMessage) -> Option<SerializedMessage> + Send + Sync;

struct State {
    ring: Ring<SerializedMessage>,
    sender_gone: bool,
    receiver_gone: bool,
}

struct MessageQueue {
    state: Mutex<State>,
    ready: Notify,
    dropped: Arc<DropCount>,
}

/// The only sender of a queue; dropping it ends the queue once all messages have been read.
pub struct MessageSender {
    shared: Arc<MessageQueue>,
}

impl MessageSender {
    /// Queues a message; drops the oldest ones if there is no room.
    pub fn send(&self, message: SerializedMessage) {
        let lost = {
            let mut state = self.shared.state.lock();
            if state.receiver_gone {
                return;
            }
            state.ring.push(message)
        };
        self.shared.dropped.add(lost);
        self.shared.ready.notify_one();
    }

    /// Returns true if the receiver is gone.
    pub fn is_closed(&self) -> bool {
        self.shared.state.lock().receiver_gone
    }
}

impl Drop for MessageSender {
    fn drop(&mut self) {
        self.shared.state.lock().sender_gone = true;
        self.shared.ready.notify_one();
    }
}

/// The receiver of a queue; messages arrive in order per publisher.
pub struct MessageReceiver {
    shared: Arc<MessageQueue>,
    conversion: Option<Box<Conversion>>,
}

impl MessageReceiver {
    /// Makes messages pass through `convert` as they are read, so that dropped ones cost nothing; those for which it
    /// returns `None` are left out.
    #[must_use]
    pub fn with_conversion(
        mut self,
        convert: impl Fn(SerializedMessage) -> Option<SerializedMessage> + Send + Sync + 'static,
    ) -> Self {
        self.conversion = Some(match self.conversion.take() {
            Some(earlier) => Box::new(move |message| earlier(message).and_then(&convert)),
            None => Box::new(convert),
        });
        self
    }

    fn convert(&self, message: SerializedMessage) -> Option<SerializedMessage> {
        match &self.conversion {
            Some(conversion) => conversion(message),
            None => Some(message),
        }
    }

    /// Returns the next message, or `None` when the subscription has ended and everything was read. Cancel-safe.
    pub async fn recv(&mut self) -> Option<SerializedMessage> {
        loop {
            // A queue that never becomes empty must not starve other tasks.
            tokio::task::consume_budget().await;
            let (next, is_over) = {
                let mut state = self.shared.state.lock();
                (state.ring.pop(), state.sender_gone)
            };
            match next {
                Some(message) => match self.convert(message) {
                    Some(message) => return Some(message),
                    None => continue,
                },
                None if is_over => return None,
                None => {}
            }
            self.shared.ready.notified().await;
        }
    }

    /// Returns the next message if one is queued.
    pub fn try_recv(&mut self) -> Option<SerializedMessage> {
        loop {
            let next = self.shared.state.lock().ring.pop()?;
            if let Some(message) = self.convert(next) {
                return Some(message);
            }
        }
    }

    /// Returns the number of queued messages.
    pub fn len(&self) -> usize {
        self.shared.state.lock().ring.len()
    }

    /// Returns true if no message is queued.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the counter of messages dropped because the queue was full; it outlives the queue.
    pub fn drop_counter(&self) -> Arc<DropCount> {
        self.shared.dropped.clone()
    }
}

impl Drop for MessageReceiver {
    fn drop(&mut self) {
        let mut state = self.shared.state.lock();
        state.receiver_gone = true;
        state.ring.clear();
    }
}

impl fmt::Debug for MessageReceiver {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("MessageReceiver").field("waiting", &self.len()).finish_non_exhaustive()
    }
}

impl fmt::Debug for MessageSender {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("MessageSender").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::WireType;

    fn message(bytes: Bytes) -> SerializedMessage {
        let wire_type = WireType::with_name("p/T");
        SerializedMessage { bytes, wire_type: Arc::new(wire_type), publisher: "/p".into(), latching: false }
    }

    #[tokio::test]
    async fn newest_win_and_drops_are_counted() {
        let (sender, mut receiver) = message_queue(2);
        let dropped = receiver.drop_counter();
        for n in 0..5u8 {
            sender.send(message(Bytes::copy_from_slice(&[n])));
        }
        assert_eq!(dropped.get(), 3);
        assert_eq!(receiver.recv().await.unwrap().bytes[0], 3);
        assert_eq!(receiver.try_recv().unwrap().bytes[0], 4);
        assert!(receiver.try_recv().is_none());
    }

    #[tokio::test]
    async fn ends_after_everything_was_read() {
        let (sender, mut receiver) = message_queue(4);
        sender.send(message(Bytes::from_static(b"x")));
        drop(sender);
        assert!(receiver.recv().await.is_some());
        assert!(receiver.recv().await.is_none());
    }

    #[tokio::test]
    async fn messages_are_converted_as_they_are_read_and_some_are_left_out() {
        let (sender, receiver) = message_queue(8);
        let of_even = |message: SerializedMessage| (message.bytes[0] % 2 == 0).then_some(message);
        let with_tail = |message: SerializedMessage| {
            let bytes = [&message.bytes[..], b"!"].concat().into();
            Some(SerializedMessage { bytes, ..message })
        };
        let mut receiver = receiver.with_conversion(of_even).with_conversion(with_tail);
        for n in 1..=5u8 {
            sender.send(message(Bytes::copy_from_slice(&[n])));
        }
        drop(sender);
        assert_eq!(&receiver.recv().await.unwrap().bytes[..], [2, b'!']);
        assert_eq!(&receiver.try_recv().unwrap().bytes[..], [4, b'!']);
        assert!(receiver.try_recv().is_none() && receiver.recv().await.is_none());
    }

    #[tokio::test]
    async fn a_waiting_receiver_is_woken() {
        let (sender, mut receiver) = message_queue(4);
        let waiting = tokio::spawn(async move { receiver.recv().await });
        tokio::task::yield_now().await;
        sender.send(message(Bytes::from_static(b"x")));
        assert!(waiting.await.unwrap().is_some());
        assert!(sender.is_closed());
    }
}
