//! Matching of endpoints.

use std::sync::Arc;

use super::world::{NetworkWorld, SECOND, SampleRecorder, best_effort_qos, keep_last_qos, topic};
use crate::shared::TopicDescription;

#[test]
fn ends_that_do_not_fit_are_told_why_and_others_are_not_disturbed() {
    let mut world = NetworkWorld::with_participants(2);
    let (writer, writer_ends) = world.writer(0, best_effort_qos());
    let (reader, reader_ends, refused) = world.reader(1, keep_last_qos(10));
    let (other, _, taken) = world.reader(1, best_effort_qos());
    world.advance(SECOND);
    world.write(writer, 1, 8);
    world.advance(SECOND);
    assert_eq!((refused.marks(), taken.marks()), (vec![], vec![1]));
    let ends = writer_ends.borrow().clone();
    assert_eq!(ends.matched.iter().map(|end| end.guid).collect::<Vec<_>>(), [other]);
    assert_eq!(ends.refused.len(), 1);
    assert_eq!(ends.refused[0].0.guid, reader);
    assert_eq!(reader_ends.borrow().refused[0].1[0].policy, "reliability");
}

#[test]
fn ends_that_are_taken_back_are_gone_there_too() {
    let mut world = NetworkWorld::with_participants(2);
    let (_, ends) = world.writer(0, keep_last_qos(10));
    let (reader, _, _) = world.reader(1, keep_last_qos(10));
    world.advance(SECOND);
    assert_eq!(ends.borrow().matched.len(), 1);
    let now = world.now;
    drop(world.engines[1].remove_endpoint(now, reader.entity));
    world.advance(SECOND);
    assert_eq!(ends.borrow().matched.len(), 0);
    world.engines[1].close(world.now);
    world.advance(SECOND / 10);
    assert!(world.engines[0].watch_discovered().borrow().participants.is_empty());
}

#[test]
fn a_hundred_topics_are_known_soon() {
    let mut world = NetworkWorld::with_participants(2);
    let mut sinks = Vec::new();
    for number in 0..100 {
        let topic = TopicDescription { name: format!("rt/topic{number}"), ..topic() };
        let now = world.now;
        let read = Arc::new(SampleRecorder::default());
        world.engines[0].add_writer(now, &topic, keep_last_qos(10));
        world.engines[1].add_reader(now, &topic, keep_last_qos(10), read.clone());
        sinks.push(read);
    }
    world.advance(SECOND / 4);
    let ours = world.engines[0].writers.iter().filter(|(entity, _)| !entity.is_builtin());
    let confirmed = ours.filter(|(_, writer)| writer.ends.borrow().confirmed.len() == 1);
    assert_eq!(confirmed.count(), 100);
}
