//! Requests that clients make by topic, if the interface names a pair: a message of its input, and the message of its
//! outputs that answers it.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use qos::{Correlation, TopicPair};
use ros::codec::{Time, header_stamp};
use ros::schema::MessageType;

/// Maximum number of inputs awaiting an answer; beyond it the oldest are dropped.
const OPEN: usize = 256;
/// Time after which an output no longer answers an input.
const INPUT_EXPIRY: Duration = Duration::from_secs(60);

/// Requests of one pair, over all clients of a bridge.
pub(crate) struct TopicRequests {
    pair: TopicPair,
    /// Unanswered requests, oldest first.
    open: Mutex<VecDeque<OpenRequest>>,
}

struct OpenRequest {
    /// Stamp that identifies the answer; `None` if the next output is the answer.
    stamp: Option<Time>,
    since: Instant,
    /// A client listened to one of the outputs: an answer would have been seen.
    heard: bool,
    /// A later request was answered: the servant has skipped this one.
    left_out: bool,
}

impl TopicRequests {
    pub(crate) fn for_pair(pair: &TopicPair) -> TopicRequests {
        TopicRequests { pair: pair.clone(), open: Mutex::default() }
    }

    pub(crate) fn is_input(&self, topic: &str) -> bool {
        self.pair.input == topic
    }

    pub(crate) fn is_output(&self, topic: &str) -> bool {
        self.pair.outputs.iter().any(|output| output == topic)
    }

    /// Returns the key by which an answer is recognised; `None` for a message without one.
    fn correlation_key(&self, of: &MessageType, bytes: &[u8]) -> Option<Option<Time>> {
        if self.pair.by != Some(Correlation::Stamp) {
            return Some(None);
        }
        let stamp = header_stamp(of, bytes)?;
        (stamp.secs != 0 || stamp.nsecs != 0).then_some(Some(stamp))
    }

    /// Records a client's message on the input. Among several with the same stamp the first is the request; without
    /// stamps, messages before the answer are no requests of their own. Returns how many earlier requests are given up
    /// that the servant has not answered: those that were `heard` and after which it has answered none.
    pub(crate) fn record_request(&self, of: &MessageType, bytes: &[u8], now: Instant, heard: bool) -> usize {
        let Some(stamp) = self.correlation_key(of, bytes) else {
            return 0;
        };
        let mut open = self.open.lock();
        let mut unanswered = 0;
        let mut forget = |open: &mut VecDeque<OpenRequest>| {
            let first = open.pop_front();
            unanswered += usize::from(first.is_some_and(|it| it.heard && heard && !it.left_out));
        };
        while open.front().is_some_and(|first| now.saturating_duration_since(first.since) >= INPUT_EXPIRY) {
            forget(&mut open);
        }
        if open.iter().all(|one| one.stamp != stamp) {
            if open.len() == OPEN {
                forget(&mut open);
            }
            open.push_back(OpenRequest { stamp, since: now, heard, left_out: false });
        }
        unanswered
    }

    /// Returns whether a client listens to an output, according to `listened`.
    pub(crate) fn has_listener(&self, listened: impl Fn(&str) -> bool) -> bool {
        self.pair.outputs.iter().any(|output| listened(output))
    }

    /// Records a message of the servant on one of the outputs; returns how long its request took if it answers one. The
    /// first output is the answer.
    pub(crate) fn record_answer(&self, of: &MessageType, bytes: &[u8], now: Instant) -> Option<Duration> {
        let stamp = self.correlation_key(of, bytes)?;
        let mut open = self.open.lock();
        let at = open.iter().position(|one| one.stamp == stamp)?;
        let took = now.saturating_duration_since(open.remove(at)?.since);
        open.iter_mut().take(at).for_each(|one| one.left_out = true);
        (took < INPUT_EXPIRY).then_some(took)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ros::schema::Registry;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn pair(by: Correlation) -> TopicRequests {
        TopicRequests::for_pair(&TopicPair {
            input: "/in".to_owned(),
            outputs: vec!["/out".to_owned(), "/view".to_owned()],
            by: Some(by),
        })
    }

    fn of_type(name: &str, text: &str) -> Arc<MessageType> {
        let registry = Registry::new();
        registry.insert(&format!("x/msg/{name}"), text).expect("a type");
        registry.message(&format!("x/{name}")).expect("it is known")
    }

    /// A message of a type that begins with a header.
    fn stamped_message(secs: u32, nsecs: u32) -> Vec<u8> {
        let words = [7, secs, nsecs, 0];
        words.into_iter().flat_map(u32::to_le_bytes).collect()
    }

    #[test]
    fn an_output_answers_the_input_of_its_stamp() {
        let requests = pair(Correlation::Stamp);
        let of = of_type("Stamped", "std_msgs/Header header\n");
        let began = Instant::now();
        requests.record_request(&of, &stamped_message(1, 0), began, true);
        requests.record_request(&of, &stamped_message(0, 2), began + SECOND, true);
        // A duplicate, and one without a stamp.
        requests.record_request(&of, &stamped_message(1, 0), began + SECOND, true);
        requests.record_request(&of, &stamped_message(0, 0), began, true);
        let answered = |secs, nsecs, after: u32| {
            requests.record_answer(&of, &stamped_message(secs, nsecs), began + SECOND * after)
        };
        assert_eq!(answered(0, 0, 2), None);
        assert_eq!(answered(9, 9, 2), None, "nobody asked");
        assert_eq!(answered(0, 2, 2), Some(SECOND));
        assert_eq!(answered(1, 0, 3), Some(SECOND * 3));
        assert_eq!(answered(1, 0, 3), None, "it is answered");
        requests.record_request(&of, &stamped_message(1, 1), began, true);
        assert_eq!(answered(1, 1, 60), None, "that is no answer any more");
        // Too short to have a stamp.
        requests.record_request(&of, &stamped_message(1, 2)[..11], began, true);
        assert!(requests.open.lock().is_empty());
        assert!(requests.is_input("/in") && !requests.is_input("/out"));
        assert!(requests.is_output("/view") && !requests.is_output("/in"));
    }

    #[test]
    fn without_stamps_the_next_output_answers_the_first_input_that_waits() {
        let requests = pair(Correlation::Arrival);
        let of = of_type("Text", "string data\n");
        let began = Instant::now();
        assert_eq!(requests.record_answer(&of, b"", began), None);
        requests.record_request(&of, b"", began, true);
        requests.record_request(&of, b"", began + SECOND, true);
        assert_eq!(requests.record_answer(&of, b"", began + SECOND * 2), Some(SECOND * 2));
        assert_eq!(requests.record_answer(&of, b"", began + SECOND * 2), None);
        // A request that is never answered does not block others forever.
        requests.record_request(&of, b"", began, true);
        requests.record_request(&of, b"", began + INPUT_EXPIRY, true);
        assert_eq!(requests.record_answer(&of, b"", began + INPUT_EXPIRY + SECOND), Some(SECOND));
    }

    #[test]
    fn inputs_that_nothing_answers_take_no_more_than_their_place() {
        let requests = pair(Correlation::Stamp);
        let of = of_type("Stamped", "std_msgs/Header header\n");
        let began = Instant::now();
        for number in 1..=10 * OPEN as u32 {
            requests.record_request(&of, &stamped_message(number, 0), began, true);
        }
        assert_eq!(requests.open.lock().len(), OPEN);
        let last = stamped_message(10 * OPEN as u32, 0);
        assert_eq!(requests.record_answer(&of, &last, began), Some(Duration::ZERO));
        assert_eq!(requests.record_answer(&of, &stamped_message(1, 0), began), None);
    }

    #[test]
    fn requests_that_are_not_answered_are_told_and_those_left_out_are_not() {
        let requests = pair(Correlation::Stamp);
        let of = of_type("Stamped", "std_msgs/Header header\n");
        let began = Instant::now();
        let asked = |secs, after: u32, heard| {
            let now = began + SECOND * after;
            requests.record_request(&of, &stamped_message(secs, 0), now, heard)
        };
        for secs in 1..=4 {
            assert_eq!(asked(secs, 0, true), 0);
        }
        assert_eq!(asked(5, 0, false), 0, "nobody would see its answer");
        // The servant takes the newest, and skips those before.
        assert!(requests.record_answer(&of, &stamped_message(3, 0), began).is_some());
        assert_eq!(asked(6, 60, true), 1, "the fourth alone");
        assert_eq!(asked(7, 120, false), 0, "nobody listens any more");
        // One after the other, too fast to be answered in time.
        let all = (10..10 + OPEN as u32 + 9).map(|secs| asked(secs, 200, true));
        assert_eq!(all.sum::<usize>(), 9);
    }
}
