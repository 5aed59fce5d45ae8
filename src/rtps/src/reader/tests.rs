//! Limits on what a reader keeps of misbehaving writers: samples and fragments waiting for others that never arrive.

use budget::Budget;
use bytes::Bytes;

use super::proxy::{ASK_AGAIN, KEEPING};
use super::*;
use crate::EntityId;
use crate::qos::{EndpointQos, HistoryKind};
use crate::sequence::{FragmentNumber, SequenceSet};

const UNFINISHED: Duration = Duration::from_secs(30);

struct ReaderHarness {
    now: Instant,
    state: ReaderState,
    budget: Budget,
    out: Vec<ReceivedSample>,
    answers: Vec<AckResponse>,
}

fn endpoint(guid: Guid, durability: DurabilityKind) -> EndpointData {
    EndpointData {
        guid,
        topic: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        qos: EndpointQos { history: HistoryKind::KeepAll, durability, ..EndpointQos::default() },
        user_data: Bytes::new(),
        unicast: Vec::new(),
        expects_inline_qos: false,
    }
}

fn writer(number: u8) -> Guid {
    Guid::new(GuidPrefix([number; 12]), EntityId::user_writer(1))
}

impl ReaderHarness {
    /// Creates a reader with a budget of this many bytes and this many writers.
    fn with_limit(limit: usize, writers: u8) -> Self {
        let budget = Budget::new("samples", limit);
        let own = Guid::new(GuidPrefix([99; 12]), EntityId::user_reader(1));
        let bounds = ReaderLimits { max_sample: 16 << 20, budget: budget.clone(), unfinished: UNFINISHED };
        let now = Instant::now();
        let mut state = ReaderState::new(endpoint(own, DurabilityKind::TransientLocal), bounds);
        for number in 1..=writers {
            let data = Arc::new(endpoint(writer(number), DurabilityKind::TransientLocal));
            let address = SocketAddr::from(([127, 0, 0, 1], 7411));
            state.add_writer(now, data, address, VendorId::OURS);
        }
        Self { now, state, budget, out: Vec::new(), answers: Vec::new() }
    }

    fn data(&mut self, of: u8, number: i64, payload: Bytes) {
        let sample = ReceivedSample {
            payload,
            writer: writer(of),
            number: SequenceNumber(number),
            related: None,
            written: None,
            withdrawn: None,
        };
        self.state.on_data(self.now, writer(of), sample, &mut self.out);
    }

    fn fragment(&mut self, of: u8, number: i64, size: u32, first: FragmentNumber) {
        let frag = DataFrag {
            reader: EntityId::UNKNOWN,
            writer: writer(of).entity,
            number: SequenceNumber(number),
            inline: wire::InlineQos::default(),
            first,
            count: 1,
            fragment_size: 1000,
            sample_size: size,
            payload: vec![0; 1000].into(),
            key_only: false,
        };
        self.state.on_data_frag(self.now, writer(of), &frag, None, &mut self.out);
    }

    fn heartbeat(&mut self, of: u8, first: i64, last: i64, count: u32) {
        let beat = wire::Heartbeat {
            reader: EntityId::UNKNOWN,
            writer: writer(of).entity,
            first: SequenceNumber(first),
            last: SequenceNumber(last),
            count,
            is_final: false,
            liveliness: false,
        };
        self.state.on_heartbeat(self.now, writer(of), &beat, &mut self.out);
    }

    /// Returns the numbers requested after this time.
    fn requested_after(&mut self, duration: Duration) -> Vec<i64> {
        self.now += duration;
        self.answers.clear();
        self.state.tick(self.now, &mut self.answers, &mut self.out);
        let sets = self.answers.iter().map(|answer| &answer.acknack.set);
        sets.flat_map(SequenceSet::iter).map(|number| number.0).collect()
    }

    fn numbers(&self) -> Vec<i64> {
        self.out.iter().map(|sample| sample.number.0).collect()
    }
}

#[test]
fn samples_that_wait_count_in_the_budget_whoever_wrote_them() {
    let mut read = ReaderHarness::with_limit(1 << 20, 40);
    for of in 1..=40 {
        // Half of the writers never announce their first number, half leave a gap.
        if of % 2 == 0 {
            read.heartbeat(of, 1, 1000, 1);
        }
        for number in 2..=200 {
            read.data(of, number, vec![0; 60_000].into());
        }
    }
    let one = 60_000 + KEEPING;
    assert_eq!(read.budget.used_bytes(), (1 << 20) / one * one);
    assert_eq!(read.state.refused, 40 * 199 - (1 << 20) / one as u64);
    assert!(read.out.is_empty());
    (1..=40).for_each(|of| assert!(read.state.remove_writer(writer(of))));
    assert_eq!(read.budget.used_bytes(), 0);
}

#[test]
fn a_short_sample_that_waits_keeps_no_datagram_and_counts_as_what_it_takes() {
    let mut read = ReaderHarness::with_limit(1 << 20, 1);
    let datagram = Bytes::from(vec![0; 60_000]);
    for number in 2..=200 {
        read.data(1, number, datagram.slice(..8));
    }
    assert!(datagram.is_unique());
    assert_eq!(read.budget.used_bytes(), 199 * (8 + KEEPING));
    // A duplicate counts once.
    read.data(1, 2, datagram.slice(..8));
    assert_eq!(read.budget.used_bytes(), 199 * (8 + KEEPING));
}

#[test]
fn a_sample_without_room_is_asked_for_again_and_comes_in_its_order() {
    let mut read = ReaderHarness::with_limit(2 * (1000 + KEEPING), 1);
    read.heartbeat(1, 1, 4, 1);
    assert_eq!(read.requested_after(Duration::ZERO), [1, 2, 3, 4]);
    for number in [2, 3, 4] {
        read.data(1, number, vec![0; 1000].into());
    }
    assert_eq!(read.state.refused, 1);
    assert_eq!(read.requested_after(Duration::from_secs(1)), [1, 4]);
    // What is delivered immediately needs no memory.
    read.data(1, 1, vec![0; 5000].into());
    assert_eq!(read.numbers(), [1, 2, 3]);
    read.data(1, 4, vec![0; 1000].into());
    assert_eq!(read.numbers(), [1, 2, 3, 4]);
    read.out.clear();
    assert_eq!(read.budget.used_bytes(), 0);
}

#[test]
fn a_refused_sample_is_asked_for_without_a_heartbeat() {
    let mut read = ReaderHarness::with_limit(1000 + KEEPING, 1);
    read.heartbeat(1, 1, 0, 1);
    read.requested_after(Duration::from_secs(1));
    read.data(1, 2, vec![0; 1000].into());
    read.data(1, 3, vec![0; 1000].into());
    assert_eq!(read.state.refused, 1);
    assert_eq!(read.requested_after(ASK_AGAIN), [1, 3]);
}

#[test]
fn what_waits_makes_room_for_the_fragments_it_waits_for() {
    let mut read = ReaderHarness::with_limit(3 * (1000 + KEEPING), 1);
    read.heartbeat(1, 1, 4, 1);
    for number in [2, 3, 4] {
        read.data(1, number, vec![0; 1000].into());
    }
    assert_eq!(read.budget.available(), 0);
    // The newest sample is dropped for the first fragment, and the one before it for the second.
    for _ in 0..3 {
        read.fragment(1, 1, 2000, 1);
        read.fragment(1, 1, 2000, 2);
    }
    assert_eq!(read.numbers(), [1, 2]);
    assert_eq!(read.requested_after(Duration::from_secs(1)), [3, 4]);
}

#[test]
fn fragments_that_stop_coming_are_given_up() {
    let mut read = ReaderHarness::with_limit(1 << 20, 2);
    read.heartbeat(1, 1, 0, 1);
    for of in [1, 2] {
        for number in 1..=4 {
            read.fragment(of, number, 5000, 1);
            read.fragment(of, number, 5000, 3);
        }
    }
    assert_eq!(read.budget.used_bytes(), 2 * 4 * (2000 + 128));
    read.requested_after(UNFINISHED - Duration::from_millis(1));
    assert_ne!(read.budget.used_bytes(), 0);
    read.requested_after(Duration::from_millis(1));
    assert_eq!(read.budget.used_bytes(), 0);
    // The time of the next call is returned.
    read.fragment(2, 5, 5000, 1);
    let again = read.state.tick(read.now, &mut read.answers, &mut read.out);
    assert!(again.is_some_and(|again| again <= read.now + UNFINISHED));
}

#[test]
fn at_its_limit_the_budget_of_fragments_refuses_and_lets_go() {
    let mut read = ReaderHarness::with_limit(3000, 1);
    read.heartbeat(1, 1, 0, 1);
    for number in 1..=3 {
        read.fragment(1, number, 5000, 1);
    }
    assert_eq!((read.budget.used_bytes(), read.state.refused), (3000, 0));
    read.fragment(1, 4, 5000, 1);
    assert_eq!((read.budget.used_bytes(), read.state.refused), (3000, 1));
    // A sample that can be delivered immediately is still accepted.
    read.heartbeat(1, 5, 5, 2);
    assert_eq!(read.budget.used_bytes(), 0);
    read.data(1, 5, vec![0; 60_000].into());
    assert_eq!(read.numbers(), [5]);
}
