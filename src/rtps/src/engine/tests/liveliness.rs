//! Who is there, and when somebody is not any more.

use super::world::{SECOND, World, bound, keep};
use crate::{EntityId, Guid, GuidPrefix};

#[test]
fn who_falls_silent_is_gone_when_the_lease_is_over() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    world.reader(1, keep(10));
    world.pass(SECOND);
    assert_eq!(ends.borrow().matched.len(), 1);
    world.loses = Box::new(|_, bytes| bytes[8] == 2);
    world.pass(SECOND * 8);
    assert_eq!(ends.borrow().matched.len(), 1);
    world.pass(SECOND * 8);
    assert_eq!(ends.borrow().matched.len(), 0);
    assert!(
        world.engines[0]
            .discovered()
            .borrow()
            .participants
            .is_empty()
    );
}

#[test]
fn who_says_anything_is_there() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    world.reader(1, keep(10));
    world.pass(SECOND);
    // Only its announcements are lost; it is asked for acknowledgements, and gives them.
    world.loses = Box::new(|_, bytes| {
        bytes[8] == 2 && bytes.windows(4).any(|ids| ids == EntityId::SPDP_WRITER.0)
    });
    let writer = ends.borrow().matched[0].guid;
    assert_eq!(writer.prefix, GuidPrefix([2; 12]));
    let ours = *world.engines[0]
        .writers
        .keys()
        .find(|entity| !entity.is_builtin())
        .expect("a writer");
    for mark in 0..20 {
        world.write(Guid::new(GuidPrefix([1; 12]), ours), mark, 8);
        world.pass(SECOND);
    }
    assert_eq!(ends.borrow().matched.len(), 1);
}

#[test]
fn whose_port_is_gone_is_dead_at_once() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    world.reader(1, keep(10));
    world.pass(SECOND);
    let now = world.now;
    world.engines[0].ports_bound(now, &bound([7410, 7411, 7412, 7413]));
    assert_eq!(ends.borrow().matched.len(), 1);
    world.engines[0].ports_bound(now, &bound([7410, 7411]));
    assert_eq!(ends.borrow().matched.len(), 0);
}

#[test]
fn a_node_killed_between_two_fragments_leaves_nothing_of_its_sample() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(10));
    let (_, ends, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // It sends one datagram of many.
    let mut sent = 0;
    world.loses = Box::new(move |_, bytes| {
        sent += usize::from(bytes[8] == 1);
        sent > 1
    });
    world.write(writer, 1, 500_000);
    world.carry();
    assert_ne!(world.budget.used(), 0, "a part has come");
    let now = world.now;
    world.engines[1].ports_bound(now, &bound([7412, 7413]));
    assert_eq!(world.budget.used(), 0);
    assert_eq!(ends.borrow().matched.len(), 0);
    // Who takes its place is heard, and nothing of the dead.
    world.loses = Box::new(|_, bytes| bytes[8] == 1);
    world.join();
    let (writer, _) = world.writer(2, keep(10));
    world.pass(SECOND);
    world.write(writer, 7, 8);
    world.pass(SECOND);
    assert_eq!(read.marks(), [7]);
}

#[test]
fn whoever_was_given_up_by_one_side_alone_is_met_again_by_both() {
    for forgets in [0, 1] {
        let mut world = World::of(2);
        let (writer, _) = world.writer(0, keep(10));
        let (reader, reader_ends, read) = world.reader(1, keep(10));
        world.pass(SECOND * 5);
        world.write(writer, 1, 8);
        world.pass(SECOND);
        // As after a pause of the network that was longer than one lease and shorter than the other.
        let other = [reader.prefix, writer.prefix][forgets];
        world.engines[forgets].participant_gone(other);
        world.engines[forgets].settle();
        world.pass(SECOND * 9);
        world.write(writer, 2, 100_000);
        world.pass(SECOND);
        assert_eq!(read.marks(), [1, 2], "{forgets} forgets");
        assert_eq!(reader_ends.borrow().confirmed, [writer]);
    }
}
