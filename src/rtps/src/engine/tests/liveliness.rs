//! Detection of participants that appear and disappear.

use super::world::{NetworkWorld, SECOND, bound_ports, keep_last_qos};
use crate::wire::{self, InlineQos, Submessage};
use crate::{EntityId, Guid, GuidPrefix};

#[test]
fn who_falls_silent_is_gone_when_the_lease_is_over() {
    let mut world = NetworkWorld::with_participants(2);
    let (_, ends) = world.writer(0, keep_last_qos(10));
    world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    assert_eq!(ends.borrow().matched.len(), 1);
    world.loses = Box::new(|_, bytes| bytes[8] == 2);
    world.advance(SECOND * 8);
    assert_eq!(ends.borrow().matched.len(), 1);
    world.advance(SECOND * 8);
    assert_eq!(ends.borrow().matched.len(), 0);
    assert!(world.engines[0].watch_discovered().borrow().participants.is_empty());
}

#[test]
fn who_says_anything_is_there() {
    let mut world = NetworkWorld::with_participants(2);
    let (_, ends) = world.writer(0, keep_last_qos(10));
    world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    // Only its announcements are lost; it still acknowledges.
    world.loses = Box::new(|_, bytes| bytes[8] == 2 && bytes.windows(4).any(|ids| ids == EntityId::SPDP_WRITER.0));
    let writer = ends.borrow().matched[0].guid;
    assert_eq!(writer.prefix, GuidPrefix([2; 12]));
    let ours = *world.engines[0].writers.keys().find(|entity| !entity.is_builtin()).expect("a writer");
    for mark in 0..20 {
        world.write(Guid::new(GuidPrefix([1; 12]), ours), mark, 8);
        world.advance(SECOND);
    }
    assert_eq!(ends.borrow().matched.len(), 1);
}

#[test]
fn whose_port_is_gone_is_dead_at_once() {
    let mut world = NetworkWorld::with_participants(2);
    let (_, ends) = world.writer(0, keep_last_qos(10));
    world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    let now = world.now;
    world.engines[0].set_bound_ports(now, &bound_ports([7410, 7411, 7412, 7413]));
    assert_eq!(ends.borrow().matched.len(), 1);
    world.engines[0].set_bound_ports(now, &bound_ports([7410, 7411]));
    assert_eq!(ends.borrow().matched.len(), 0);
}

#[test]
fn a_node_killed_between_two_fragments_leaves_nothing_of_its_sample() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, _) = world.writer(0, keep_last_qos(10));
    let (_, ends, read) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    // It sends one of many datagrams.
    let mut sent = 0;
    world.loses = Box::new(move |_, bytes| {
        sent += usize::from(bytes[8] == 1);
        sent > 1
    });
    world.write(writer, 1, 500_000);
    world.carry();
    assert_ne!(world.budget.used_bytes(), 0, "a part has come");
    let now = world.now;
    world.engines[1].set_bound_ports(now, &bound_ports([7412, 7413]));
    assert_eq!(world.budget.used_bytes(), 0);
    assert_eq!(ends.borrow().matched.len(), 0);
    // Its successor is heard, and nothing of the dead participant.
    world.loses = Box::new(|_, bytes| bytes[8] == 1);
    world.join();
    let (writer, _) = world.writer(2, keep_last_qos(10));
    world.advance(SECOND);
    world.write(writer, 7, 8);
    world.advance(SECOND);
    assert_eq!(read.marks(), [7]);
}

#[test]
fn whoever_was_given_up_by_one_side_alone_is_met_again_by_both() {
    for forgets in [0, 1] {
        let mut world = NetworkWorld::with_participants(2);
        let (writer, _) = world.writer(0, keep_last_qos(10));
        let (reader, reader_ends, read) = world.reader(1, keep_last_qos(10));
        world.advance(SECOND * 5);
        world.write(writer, 1, 8);
        world.advance(SECOND);
        // As after a network outage that was longer than one lease and shorter than the other.
        let other = [reader.prefix, writer.prefix][forgets];
        world.engines[forgets].remove_participant(other);
        world.engines[forgets].flush_changes();
        world.advance(SECOND * 9);
        world.write(writer, 2, 100_000);
        world.advance(SECOND);
        assert_eq!(read.marks(), [1, 2], "{forgets} forgets");
        assert_eq!(reader_ends.borrow().confirmed, [writer]);
    }
}

#[test]
fn whoever_comes_in_the_place_of_one_that_was_killed_says_its_good_bye() {
    for (named, there) in [(true, 0), (false, 1)] {
        let mut world = NetworkWorld::with_participants(2);
        let (_, ends) = world.writer(0, keep_last_qos(10));
        world.reader(1, keep_last_qos(10));
        world.advance(SECOND);
        world.killed.insert(1);
        let killed = GuidPrefix([2; 12]);
        world.join_after(&[killed][..usize::from(named)]);
        world.advance(SECOND / 10);
        assert_eq!(ends.borrow().matched.len(), there);
        let discovered = world.engines[0].watch_discovered().borrow().clone();
        let others: Vec<_> = discovered.participants.keys().copied().collect();
        let successor = GuidPrefix([3; 12]);
        let expected = [killed, successor];
        assert_eq!(others, expected[1 - there..]);
    }
}

/// As other implementations require: they accept a disposal only from the announcing writer, whose numbers must
/// increase.
#[test]
fn a_predecessors_good_bye_comes_from_its_own_writer_with_the_highest_number() {
    let mut world = NetworkWorld::with_participants(1);
    let killed = GuidPrefix([9; 12]);
    world.join_after(&[killed]);
    let now = world.now;
    // As when it has just joined; an unknown newcomer is told as well.
    world.engines[1].set_bound_ports(now, &bound_ports([7410]));
    let mut said = Vec::new();
    while let Some(datagram) = world.engines[1].transmit(&mut |_, _, _| true) {
        let parts = datagram.parts();
        let bytes: Vec<u8> = parts.iter().flat_map(|part| part.to_vec()).collect();
        said.extend(wire::parse(&bytes.into()).received);
    }
    assert_eq!(said.len(), 2, "{said:?}");
    let [gone, comes] = [0, 1].map(|at| match &said[at].submessage {
        Submessage::Data(data) => data,
        other => panic!("{other:?}"),
    });
    assert_eq!((said[0].from, said[1].from), (killed, GuidPrefix([2; 12])));
    assert_eq!((gone.writer, gone.reader), (EntityId::SPDP_WRITER, EntityId::SPDP_READER));
    let key = Guid::new(killed, EntityId::PARTICIPANT).bytes();
    let disposed = InlineQos::DISPOSED | InlineQos::UNREGISTERED;
    assert_eq!((gone.key_only, gone.inline.status, gone.inline.key_hash), (true, disposed, Some(key)));
    assert!(gone.number.0 > 1 << 31);
    assert_eq!((comes.inline.status, comes.key_only), (0, false));
}

#[test]
fn predecessors_are_spoken_of_until_their_leases_are_over() {
    let mut world = NetworkWorld::with_participants(2);
    let killed = GuidPrefix([9; 12]);
    world.join_after(&[killed]);
    let said = std::rc::Rc::new(std::cell::Cell::new(0));
    let count = std::rc::Rc::clone(&said);
    world.loses = Box::new(move |_, bytes| {
        count.set(count.get() + usize::from(bytes[8..20] == killed.0));
        false
    });
    world.advance(SECOND * 10);
    assert!(said.take() > 4, "each may be lost");
    world.advance(SECOND * 10);
    assert_eq!(said.get(), 0);
}
