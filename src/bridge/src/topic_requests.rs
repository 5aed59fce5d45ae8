//! Requests that clients make by topic, where the interface names one pair: a message of its input, and the message of its
//! outputs that answers it.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use qos::{Correlation, Pair};
use ros::codec::{Time, header_stamp};
use ros::schema::MessageType;

/// Inputs whose answers are awaited at most; of more the oldest are forgotten.
const OPEN: usize = 256;
/// What comes so long after an input does not answer it.
const FORGOTTEN: Duration = Duration::from_secs(60);

/// The requests of one pair, over all clients of a bridge.
pub(crate) struct TopicRequests {
    pair: Pair,
    /// The oldest first.
    open: Mutex<VecDeque<Open>>,
}

struct Open {
    /// By which the answer is recognised; none where the next output answers.
    stamp: Option<Time>,
    since: Instant,
    /// A client listened to one of the outputs: an answer would have been seen.
    heard: bool,
    /// A later one was answered: the servant has left it out.
    left_out: bool,
}

impl TopicRequests {
    pub(crate) fn of(pair: &Pair) -> TopicRequests {
        TopicRequests {
            pair: pair.clone(),
            open: Mutex::default(),
        }
    }

    pub(crate) fn is_input(&self, topic: &str) -> bool {
        self.pair.input == topic
    }

    pub(crate) fn is_output(&self, topic: &str) -> bool {
        self.pair.outputs.iter().any(|output| output == topic)
    }

    /// By what an answer is recognised; nothing of a message that cannot be recognised.
    fn key(&self, of: &MessageType, bytes: &[u8]) -> Option<Option<Time>> {
        if self.pair.by != Some(Correlation::Stamp) {
            return Some(None);
        }
        let stamp = header_stamp(of, bytes)?;
        (stamp.secs != 0 || stamp.nsecs != 0).then_some(Some(stamp))
    }

    /// A client's message on the input goes to the servant. Of several with one stamp the first is the request; without stamps
    /// what comes before the answer is none. Returns how many earlier requests are given up that the servant has not answered:
    /// those that were `heard`, and after which it has answered none.
    pub(crate) fn asked(&self, of: &MessageType, bytes: &[u8], now: Instant, heard: bool) -> usize {
        let Some(stamp) = self.key(of, bytes) else {
            return 0;
        };
        let mut open = self.open.lock();
        let mut unanswered = 0;
        let mut forget = |open: &mut VecDeque<Open>| {
            let first = open.pop_front();
            unanswered += usize::from(first.is_some_and(|it| it.heard && heard && !it.left_out));
        };
        while open
            .front()
            .is_some_and(|first| now.saturating_duration_since(first.since) >= FORGOTTEN)
        {
            forget(&mut open);
        }
        if open.iter().all(|one| one.stamp != stamp) {
            if open.len() == OPEN {
                forget(&mut open);
            }
            open.push_back(Open {
                stamp,
                since: now,
                heard,
                left_out: false,
            });
        }
        unanswered
    }

    /// Whether a client listens to an output, as far as `listened` knows of topics.
    pub(crate) fn is_heard(&self, listened: impl Fn(&str) -> bool) -> bool {
        self.pair.outputs.iter().any(|output| listened(output))
    }

    /// A message of the servant on one of the outputs; how long its request took, if it answers one. The first output that
    /// comes is the answer.
    pub(crate) fn answered(
        &self,
        of: &MessageType,
        bytes: &[u8],
        now: Instant,
    ) -> Option<Duration> {
        let stamp = self.key(of, bytes)?;
        let mut open = self.open.lock();
        let at = open.iter().position(|one| one.stamp == stamp)?;
        let took = now.saturating_duration_since(open.remove(at)?.since);
        open.iter_mut().take(at).for_each(|one| one.left_out = true);
        (took < FORGOTTEN).then_some(took)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ros::schema::Registry;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn pair(by: Correlation) -> TopicRequests {
        TopicRequests::of(&Pair {
            input: "/in".to_owned(),
            outputs: vec!["/out".to_owned(), "/view".to_owned()],
            by: Some(by),
        })
    }

    fn of_type(name: &str, text: &str) -> Arc<MessageType> {
        let registry = Registry::new();
        registry
            .insert(&format!("x/msg/{name}"), text)
            .expect("a type");
        registry.message(&format!("x/{name}")).expect("it is known")
    }

    /// A message of a type that begins with a header.
    fn stamped(secs: u32, nsecs: u32) -> Vec<u8> {
        let words = [7, secs, nsecs, 0];
        words.into_iter().flat_map(u32::to_le_bytes).collect()
    }

    #[test]
    fn an_output_answers_the_input_of_its_stamp() {
        let requests = pair(Correlation::Stamp);
        let of = of_type("Stamped", "std_msgs/Header header\n");
        let began = Instant::now();
        requests.asked(&of, &stamped(1, 0), began, true);
        requests.asked(&of, &stamped(0, 2), began + SECOND, true);
        // Again, and one that nobody has stamped.
        requests.asked(&of, &stamped(1, 0), began + SECOND, true);
        requests.asked(&of, &stamped(0, 0), began, true);
        let answered = |secs, nsecs, after: u32| {
            requests.answered(&of, &stamped(secs, nsecs), began + SECOND * after)
        };
        assert_eq!(answered(0, 0, 2), None);
        assert_eq!(answered(9, 9, 2), None, "nobody asked");
        assert_eq!(answered(0, 2, 2), Some(SECOND));
        assert_eq!(answered(1, 0, 3), Some(SECOND * 3));
        assert_eq!(answered(1, 0, 3), None, "it is answered");
        requests.asked(&of, &stamped(1, 1), began, true);
        assert_eq!(answered(1, 1, 60), None, "that is no answer any more");
        // Too short to have a stamp.
        requests.asked(&of, &stamped(1, 2)[..11], began, true);
        assert!(requests.open.lock().is_empty());
        assert!(requests.is_input("/in") && !requests.is_input("/out"));
        assert!(requests.is_output("/view") && !requests.is_output("/in"));
    }

    #[test]
    fn without_stamps_the_next_output_answers_the_first_input_that_waits() {
        let requests = pair(Correlation::Arrival);
        let of = of_type("Text", "string data\n");
        let began = Instant::now();
        assert_eq!(requests.answered(&of, b"", began), None);
        requests.asked(&of, b"", began, true);
        requests.asked(&of, b"", began + SECOND, true);
        assert_eq!(
            requests.answered(&of, b"", began + SECOND * 2),
            Some(SECOND * 2)
        );
        assert_eq!(requests.answered(&of, b"", began + SECOND * 2), None);
        // One that is never answered does not stand before others for ever.
        requests.asked(&of, b"", began, true);
        requests.asked(&of, b"", began + FORGOTTEN, true);
        assert_eq!(
            requests.answered(&of, b"", began + FORGOTTEN + SECOND),
            Some(SECOND)
        );
    }

    #[test]
    fn inputs_that_nothing_answers_take_no_more_than_their_place() {
        let requests = pair(Correlation::Stamp);
        let of = of_type("Stamped", "std_msgs/Header header\n");
        let began = Instant::now();
        for number in 1..=10 * OPEN as u32 {
            requests.asked(&of, &stamped(number, 0), began, true);
        }
        assert_eq!(requests.open.lock().len(), OPEN);
        let last = stamped(10 * OPEN as u32, 0);
        assert_eq!(requests.answered(&of, &last, began), Some(Duration::ZERO));
        assert_eq!(requests.answered(&of, &stamped(1, 0), began), None);
    }

    #[test]
    fn requests_that_are_not_answered_are_told_and_those_left_out_are_not() {
        let requests = pair(Correlation::Stamp);
        let of = of_type("Stamped", "std_msgs/Header header\n");
        let began = Instant::now();
        let asked = |secs, after: u32, heard| {
            let now = began + SECOND * after;
            requests.asked(&of, &stamped(secs, 0), now, heard)
        };
        for secs in 1..=4 {
            assert_eq!(asked(secs, 0, true), 0);
        }
        assert_eq!(asked(5, 0, false), 0, "nobody would see its answer");
        // It takes the newest, and has left out those before.
        assert!(requests.answered(&of, &stamped(3, 0), began).is_some());
        assert_eq!(asked(6, 60, true), 1, "the fourth alone");
        assert_eq!(asked(7, 120, false), 0, "nobody listens any more");
        // One after the other, too fast for anybody to answer in time.
        let all = (10..10 + OPEN as u32 + 9).map(|secs| asked(secs, 200, true));
        assert_eq!(all.sum::<usize>(), 9);
    }
}
