//! What a writer keeps, and what newer samples take the place of.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;

use super::world::{HERE, SECOND, World, best_effort, keep, transient};
use crate::qos::{EndpointQos, History};
use crate::sequence::SequenceSet;
use crate::wire::{self, DatagramWriter};
use crate::{EntityId, FragmentSet, Guid, GuidPrefix, SequenceNumber};

#[test]
fn newcomers_are_given_what_is_kept_for_them_and_nothing_else() {
    let mut world = World::of(2);
    let (kept, _) = world.writer(0, transient(2));
    (1..=5).for_each(|mark| world.write(kept, mark, 8));
    world.pass(SECOND);
    let (_, _, wants_past) = world.reader(1, transient(10));
    let (_, _, wants_none) = world.reader(1, keep(10));
    world.pass(SECOND);
    assert_eq!(wants_past.marks(), [4, 5]);
    assert_eq!(wants_none.marks(), []);
    world.write(kept, 6, 8);
    world.pass(SECOND);
    assert_eq!(wants_past.marks(), [4, 5, 6]);
    assert_eq!(wants_none.marks(), [6]);
}

#[test]
fn no_more_is_begun_to_a_reader_than_it_acknowledges() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // Whatever the reader says is lost for a while: the first two samples fill the window, and others replace each other behind.
    world.loses = Box::new(|_, bytes| bytes.starts_with(b"RTPS") && bytes[8..20] == [2; 12]);
    for mark in 1..=40 {
        world.write(writer, mark, 5 << 20);
        world.pass(Duration::from_millis(2));
    }
    world.loses = Box::new(|_, _| false);
    world.pass(SECOND * 2);
    assert_eq!(read.marks(), [1, 2, 40]);
}

#[test]
fn a_sample_on_its_way_is_not_said_to_be_gone() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(1));
    world.pass(SECOND);
    // Two fragments of seven are out when the next sample takes its place; the receiver asks for the rest.
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
    // Nor by a heartbeat, which comes before the rest of it does.
    world.engines[0].tick(now + SECOND);
    world.room = None;
    world.pass(SECOND);
    assert_eq!(read.marks(), [1, 2]);
}

/// How many submessages of a kind a datagram has.
fn count(datagram: &[u8], kind: fn(&wire::Submessage) -> bool) -> usize {
    let parsed = wire::parse(&Bytes::copy_from_slice(datagram));
    let submessages = parsed.received.iter().map(|it| &it.submessage);
    submessages.filter(|it| kind(it)).count()
}

#[test]
fn what_is_under_way_is_not_sent_again_for_a_receiver_that_asks_in_the_middle() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(5));
    let (_, _, read) = world.reader(1, keep(5));
    world.pass(SECOND);
    let counted = Arc::new(Mutex::new((0, 0)));
    let counts = Arc::clone(&counted);
    world.loses = Box::new(move |_, datagram| {
        let mut counts = counts.lock();
        counts.0 += count(datagram, |it| matches!(it, wire::Submessage::DataFrag(_)));
        counts.1 += count(datagram, |it| matches!(it, wire::Submessage::NackFrag(_)));
        false
    });
    // Two fragments of seven are out when the receiver is asked what it has, four when it answers, and six when that comes.
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
    world.pass(SECOND);
    assert_eq!(read.marks(), [1]);
    assert_eq!(counted.lock().0, 7, "each fragment is sent once");
}

/// Fast DDS 2.14.5 takes a number of the set of a GAP for the one at its base: where that is a sample of which it has fragments, it forgets it
/// by half, and whoever takes from that reader then tries for ever.
#[test]
fn numbers_that_will_never_come_are_told_without_a_set() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // 2 and 4 are replaced before they are begun, and part of 3 is out.
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
        reader: read_by(&world, writer),
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
    // The reader's own words count anew after three seconds.
    world.room = None;
    world.pass(SECOND * 4);
    assert_eq!(read.marks(), [1, 3, 5]);
}

/// The reader that a writer is matched with.
fn read_by(world: &World, writer: Guid) -> EntityId {
    let ends = world.engines[0].writers[&writer.entity].ends.borrow();
    ends.matched[0].guid.entity
}

#[test]
fn a_slow_receiver_gets_whole_samples_though_newer_ones_replace_them() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(
        0,
        EndpointQos {
            history: History::KeepLast(1),
            ..best_effort()
        },
    );
    let (_, _, read) = world.reader(1, best_effort());
    world.pass(SECOND);
    // Two fragments pass between two samples of seven.
    world.room = Some(33_000);
    for mark in 0..40 {
        world.write(writer, mark, 100_000);
        world.carry();
    }
    world.room = None;
    world.pass(SECOND);
    let marks = read.marks();
    assert!(marks.len() >= 8, "{marks:?}");
    assert_eq!(marks.last(), Some(&39));
    assert!(marks.is_sorted_by(|before, after| before < after));
}

#[test]
fn a_reader_that_never_acknowledges_costs_no_more_than_the_depth() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(4));
    let (_, _, read) = world.reader(1, keep(4));
    world.pass(SECOND);
    world.loses = Box::new(|_, _| true);
    for mark in 0..10 {
        world.write(writer, mark, 8);
    }
    world.carry();
    assert_eq!(world.engines[0].dropped(writer.entity), 6);
    world.loses = Box::new(|_, _| false);
    world.pass(SECOND);
    assert_eq!(read.marks(), [6, 7, 8, 9]);
}
