//! Samples arrive complete, once, in order and in time; or not at all if best-effort.

use std::time::Duration;

use bytes::Bytes;

use super::world::{HERE, NetworkWorld, SECOND, best_effort_qos, keep_last_qos, pseudo_random};
use crate::{SampleIdentity, SequenceNumber};

#[test]
fn participants_find_each_other_and_samples_arrive_in_order() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, writer_ends) = world.writer(0, keep_last_qos(10));
    let (reader, reader_ends, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND / 5);
    assert_eq!(writer_ends.borrow().confirmed, [reader]);
    assert_eq!(reader_ends.borrow().confirmed, [writer]);
    for (mark, length) in [(1, 8), (2, 100_000), (3, 8), (4, 15_872), (5, 15_873), (6, 3_000_001)] {
        world.write(writer, mark, length);
    }
    world.advance(SECOND / 10);
    assert_eq!(read.marks(), [1, 2, 3, 4, 5, 6]);
    assert_eq!(read.lengths(), [8, 100_000, 8, 15_872, 15_873, 3_000_001]);
    let discovered = world.engines[0].watch_discovered().borrow().clone();
    assert_eq!(discovered.participants.len(), 1);
    assert_eq!(discovered.readers.keys().copied().collect::<Vec<_>>(), [reader]);
}

#[test]
fn whatever_the_network_loses_reliable_samples_come_once_and_in_order() {
    for seed in 0..20 {
        let mut world = NetworkWorld::with_participants(2);
        let mut random = pseudo_random(seed);
        world.loses = Box::new(move |_, _| random() % 4 == 0);
        let (writer, _) = world.writer(0, keep_last_qos(100));
        let (_, _, read) = world.reader(1, keep_last_qos(100));
        world.advance(SECOND * 5);
        let mut random = pseudo_random(seed + 1000);
        for mark in 0..50 {
            world.write(writer, mark, 8 + (random() % 60_000) as usize);
            world.advance(Duration::from_millis(random() % 30));
        }
        world.advance(SECOND * 20);
        assert_eq!(read.marks(), (0..50).collect::<Vec<u8>>(), "seed {seed}");
    }
}

#[test]
fn best_effort_samples_are_whole_or_lost_and_never_out_of_order() {
    for seed in 0..10 {
        let mut world = NetworkWorld::with_participants(2);
        let (writer, _) = world.writer(0, best_effort_qos());
        let (_, _, read) = world.reader(1, best_effort_qos());
        world.advance(SECOND);
        let mut random = pseudo_random(seed);
        world.loses = Box::new(move |_, _| random() % 20 == 0);
        for mark in 0..100 {
            world.write(writer, mark, 8 + usize::from(mark % 3) * 40_000);
            world.advance(Duration::from_millis(10));
        }
        let marks = read.marks();
        assert!(marks.is_sorted_by(|before, after| before < after), "seed {seed}: {marks:?}");
        assert!((50..100).contains(&marks.len()), "seed {seed}: {} of 100", marks.len());
        for (mark, length) in marks.iter().zip(read.lengths()) {
            assert_eq!(length, 8 + usize::from(mark % 3) * 40_000);
        }
    }
}

#[test]
fn a_sample_of_which_parts_were_lost_is_whole_in_the_end_however_many_follow() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(1));
    let (_, _, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    // One in three datagrams is lost, and each sample is replaced long before it is repaired.
    let mut random = pseudo_random(7);
    world.loses = Box::new(move |_, _| random() % 3 == 0);
    let fragmented = 20 * 16_000;
    for mark in 1..=10 {
        world.write(writer, mark, fragmented);
        world.advance(Duration::from_millis(2));
    }
    world.loses = Box::new(|_, _| false);
    world.advance(SECOND * 5);
    assert_eq!(read.marks(), (1..=10).collect::<Vec<u8>>());
    assert_eq!(world.engines[0].dropped_samples(writer.entity), 0);
}

#[test]
fn what_was_written_is_sent_though_the_writer_is_dropped() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(10));
    let (_, ends, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    let mut random = pseudo_random(3);
    world.loses = Box::new(move |_, _| random() % 3 == 0);
    (0..5).for_each(|mark| world.write(writer, mark, 30_000));
    let now = world.now;
    drop(world.engines[0].remove_endpoint(now, writer.entity));
    world.advance(SECOND * 4);
    assert_eq!(read.marks(), [0, 1, 2, 3, 4]);
    assert_eq!(ends.borrow().matched.len(), 0);
}

#[test]
fn requests_and_replies_keep_their_identity() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(10));
    let (_, _, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    let related = SampleIdentity { writer, number: SequenceNumber(7) };
    let now = world.now;
    for length in [8, 50_000] {
        world.engines[0].write(now, writer.entity, vec![0; length].into(), Some(related));
    }
    world.advance(SECOND);
    let told: Vec<_> = read.0.lock().iter().map(|sample| sample.related).collect();
    assert_eq!(told, [Some(related), Some(related)]);
}

#[test]
fn datagrams_of_nonsense_change_nothing() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(10));
    let (_, ends, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    let mut kept: Vec<Bytes> = Vec::new();
    for mark in 0..4 {
        world.write(writer, mark, 40_000);
        while let Some(datagram) = world.engines[0].transmit(&mut |_, _, _| true) {
            kept.push(datagram.parts().iter().flat_map(|part| part.to_vec()).collect());
        }
    }
    let mut random = pseudo_random(7);
    let now = world.now;
    for _ in 0..20_000 {
        let mut bytes = kept[random() as usize % kept.len()].to_vec();
        // Except the sender: a forged sender is believed, because there is no security.
        for _ in 0..1 + random() % 8 {
            let at = 20 + random() as usize % (bytes.len().min(200) - 20);
            bytes[at] = random() as u8;
        }
        bytes.truncate(20 + random() as usize % bytes.len());
        world.engines[1].receive(now, HERE, &bytes.into());
        world.engines[1].take_deliveries();
    }
    assert_eq!(ends.borrow().matched.len(), 1);
    drop(read);
}
