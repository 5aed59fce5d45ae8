//! History of writers, and what newer samples replace.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;

use super::world::{HERE, NetworkWorld, SECOND, best_effort_qos, keep_last_qos, transient_local_qos};
use crate::qos::{EndpointQos, HistoryKind};
use crate::sequence::SequenceSet;
use crate::wire::{self, DatagramWriter};
use crate::{EntityId, FragmentSet, Guid, GuidPrefix, SequenceNumber};

#[test]
fn newcomers_are_given_what_is_kept_for_them_and_nothing_else() {
    let mut world = NetworkWorld::with_participants(2);
    let (kept, _) = world.writer(0, transient_local_qos(2));
    (1..=5).for_each(|mark| world.write(kept, mark, 8));
    world.advance(SECOND);
    let (_, _, wants_past) = world.reader(1, transient_local_qos(10));
    let (_, _, wants_none) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    assert_eq!(wants_past.marks(), [4, 5]);
    assert_eq!(wants_none.marks(), []);
    world.write(kept, 6, 8);
    world.advance(SECOND);
    assert_eq!(wants_past.marks(), [4, 5, 6]);
    assert_eq!(wants_none.marks(), [6]);
}

#[test]
fn a_reader_knows_how_many_samples_are_kept_for_newcomers() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, transient_local_qos(3));
    let (_, ends, _) = world.reader(1, transient_local_qos(10));
    let (_, current, _) = world.reader(1, keep_last_qos(10));
    for (mark, kept) in [(1, 1), (2, 2), (3, 3), (4, 3), (5, 3)] {
        world.write(writer, mark, 8);
        world.advance(SECOND);
        assert_eq!(ends.borrow().kept_samples(writer), Some(kept), "after {mark}");
        assert_eq!(current.borrow().kept_samples(writer), None, "it wants none of them");
    }
}

#[test]
fn newcomers_are_given_less_than_slow_readers() {
    let mut world = NetworkWorld::with_participants(3);
    let (writer, _) = world.writer(0, transient_local_qos(100));
    world.engines[0].set_kept(writer.entity, 2);
    let (_, _, slow) = world.reader(1, transient_local_qos(100));
    world.advance(SECOND);
    // The reader of the second participant receives nothing for a while.
    world.loses = Box::new(|_, bytes| bytes.starts_with(b"RTPS") && bytes[8..20] == [1; 12]);
    (1..=5).for_each(|mark| world.write(writer, mark, 8));
    world.carry();
    world.loses = Box::new(|_, _| false);
    let (_, _, late) = world.reader(2, transient_local_qos(100));
    world.advance(SECOND);
    assert_eq!(slow.marks(), [1, 2, 3, 4, 5]);
    assert_eq!(late.marks(), [4, 5]);
    // More are given when more are kept where they come from.
    world.engines[0].set_kept(writer.entity, 3);
    let (_, _, later) = world.reader(2, transient_local_qos(100));
    world.advance(SECOND);
    assert_eq!(later.marks(), [3, 4, 5]);
    // Large ones that all readers have are dropped, except those that are given.
    for mark in 6..=9 {
        world.write(writer, mark, 500_000);
        world.advance(SECOND);
    }
    let history = &world.engines[0].writers[&writer.entity].state;
    let is_there = |number: i64| history.change(SequenceNumber(number)).is_some();
    assert!(!is_there(6) && (7..=9).all(is_there));
    assert_eq!(slow.marks(), [1, 2, 3, 4, 5, 6, 7, 8, 9]);
}

#[test]
fn no_more_is_begun_to_a_reader_than_it_acknowledges() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(1));
    let (_, _, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    // The reader's messages are lost for a while: the first two samples fill the window, and later ones replace each
    // other.
    world.loses = Box::new(|_, bytes| bytes.starts_with(b"RTPS") && bytes[8..20] == [2; 12]);
    for mark in 1..=40 {
        world.write(writer, mark, 5 << 20);
        world.advance(Duration::from_millis(2));
    }
    world.loses = Box::new(|_, _| false);
    world.advance(SECOND * 2);
    assert_eq!(read.marks(), [1, 2, 40]);
}

#[test]
fn a_sample_on_its_way_is_not_said_to_be_gone() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(1));
    let (_, _, read) = world.reader(1, keep_last_qos(1));
    world.advance(SECOND);
    // Two of seven fragments were sent when the next sample replaces it; the receiver asks for the rest.
    world.room = Some(33_000);
    world.write(writer, 1, 100_000);
    world.carry();
    world.write(writer, 2, 8);
    let ask = wire::NackFrag {
        reader: EntityId::user_reader(1),
        writer: writer.entity,
        number: SequenceNumber(1),
        set: {
            let mut set = FragmentSet::empty(3);
            set.insert(3);
            set
        },
        count: 1,
    };
    let mut datagram = DatagramWriter::new(GuidPrefix([2; 12]));
    datagram.destination(GuidPrefix([1; 12]));
    datagram.nack_frag(&ask);
    let now = world.now;
    world.engines[0].receive(now, HERE, &datagram.finish().into());
    // Nor by a heartbeat that arrives before the rest of the sample.
    world.engines[0].tick(now + SECOND);
    world.room = None;
    world.advance(SECOND);
    assert_eq!(read.marks(), [1, 2]);
}

/// Counts the submessages of a kind in a datagram.
fn count_submessages(datagram: &[u8], kind: fn(&wire::Submessage) -> bool) -> usize {
    let parsed = wire::parse(&Bytes::copy_from_slice(datagram));
    let submessages = parsed.received.iter().map(|it| &it.submessage);
    submessages.filter(|it| kind(it)).count()
}

#[test]
fn what_is_under_way_is_not_sent_again_for_a_receiver_that_asks_in_the_middle() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(5));
    let (_, _, read) = world.reader(1, keep_last_qos(5));
    world.advance(SECOND);
    let counted = Arc::new(Mutex::new((0, 0)));
    let counts = Arc::clone(&counted);
    world.loses = Box::new(move |_, datagram| {
        let mut counts = counts.lock();
        counts.0 += count_submessages(datagram, |it| matches!(it, wire::Submessage::DataFrag(_)));
        counts.1 += count_submessages(datagram, |it| matches!(it, wire::Submessage::NackFrag(_)));
        false
    });
    // Two of seven fragments were sent when the receiver is asked, four when it answers, and six when the answer
    // arrives.
    world.room = Some(33_000);
    world.write(writer, 1, 100_000);
    world.carry();
    world.now += SECOND;
    let now = world.now;
    world.engines[0].tick(now);
    world.carry();
    world.engines[1].tick(now + SECOND);
    world.carry();
    assert_eq!(*counted.lock(), (6, 1));
    world.room = None;
    world.advance(SECOND);
    assert_eq!(read.marks(), [1]);
    assert_eq!(counted.lock().0, 7, "each fragment is sent once");
}

/// Fast DDS 2.14.5 confuses a number in the set of a GAP with the one at its base. If it has fragments of that sample,
/// it forgets it partially, and takes from that reader never return.
#[test]
fn numbers_that_will_never_come_are_told_without_a_set() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(1));
    let (_, _, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    // Samples 2 and 4 are replaced before they are started, and part of 3 was sent.
    world.room = Some(33_000);
    world.write(writer, 1, 100_000);
    world.carry();
    world.write(writer, 2, 100_000);
    world.write(writer, 3, 100_000);
    for _ in 0..4 {
        world.carry();
    }
    world.write(writer, 4, 100_000);
    world.write(writer, 5, 100_000);
    let mut set = SequenceSet::empty(SequenceNumber(2));
    set.insert(SequenceNumber(2));
    set.insert(SequenceNumber(4));
    let ask = wire::AckNack {
        reader: matched_reader(&world, writer),
        writer: writer.entity,
        set,
        count: 1000,
        is_final: true,
    };
    let mut datagram = DatagramWriter::new(GuidPrefix([2; 12]));
    datagram.destination(GuidPrefix([1; 12]));
    datagram.acknack(&ask);
    let now = world.now;
    world.engines[0].receive(now, HERE, &datagram.finish().into());
    let mut gaps = Vec::new();
    while let Some(datagram) = world.engines[0].control.pop_front() {
        let bytes: Bytes = datagram.head.into();
        for received in wire::parse(&bytes).received {
            if let wire::Submessage::Gap(gap) = received.submessage {
                assert!(gap.set.is_empty(), "{gap:?}");
                gaps.push(gap.start.0..gap.set.base.0);
            }
        }
    }
    assert_eq!(gaps, [2..3, 4..5]);
    // The counts of the reader start anew after three seconds.
    world.room = None;
    world.advance(SECOND * 4);
    assert_eq!(read.marks(), [1, 3, 5]);
}

/// Returns the reader that is matched with a writer.
fn matched_reader(world: &NetworkWorld, writer: Guid) -> EntityId {
    let ends = world.engines[0].writers[&writer.entity].ends.borrow();
    ends.matched[0].guid.entity
}

#[test]
fn a_slow_receiver_gets_whole_samples_though_newer_ones_replace_them() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, EndpointQos { history: HistoryKind::KeepLast(1), ..best_effort_qos() });
    let (_, _, read) = world.reader(1, best_effort_qos());
    world.advance(SECOND);
    // Two fragments are sent between two samples of seven.
    world.room = Some(33_000);
    for mark in 0..40 {
        world.write(writer, mark, 100_000);
        world.carry();
    }
    world.room = None;
    world.advance(SECOND);
    let marks = read.marks();
    assert!(marks.len() >= 8, "{marks:?}");
    assert_eq!(marks.last(), Some(&39));
    assert!(marks.is_sorted_by(|before, after| before < after));
}

#[test]
fn a_reader_that_never_acknowledges_costs_no_more_than_the_depth() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(4));
    let (_, _, read) = world.reader(1, keep_last_qos(4));
    world.advance(SECOND);
    world.loses = Box::new(|_, _| true);
    for mark in 0..10 {
        world.write(writer, mark, 8);
    }
    world.carry();
    assert_eq!(world.engines[0].dropped_samples(writer.entity), 6);
    world.loses = Box::new(|_, _| false);
    world.advance(SECOND);
    assert_eq!(read.marks(), [6, 7, 8, 9]);
}
