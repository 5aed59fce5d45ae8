use std::time::Duration;

use ::budget::Budget;
use bytes::Bytes;
use proptest::prelude::*;

use super::*;
use crate::incoming::Incoming;
use crate::limits::{ANSWERS, CALLS};
use crate::record::{Call, Data};

fn data(channel: u32, born: i64, size: usize) -> Record {
    Record::Data(Data {
        channel,
        encoded: false,
        latching: false,
        born,
        left: 0,
        serialise: 0,
        answered: None,
        message: Bytes::from(vec![born as u8; size]),
    })
}

fn control(number: u8) -> Record {
    Record::Control(Bytes::copy_from_slice(&[number]))
}

/// Receives a frame as the peer would.
fn deliver(incoming: &mut Incoming, frame: Frame) -> Option<Record> {
    let record = match frame {
        Frame::Whole { number, record } => incoming.receive_whole(number, record),
        Frame::Begin { stream, number, total, bytes } => incoming.receive_begin(stream, number, total, &bytes),
        Frame::More { stream, bytes } => incoming.receive_more(stream, &bytes),
        other => panic!("{other:?}"),
    };
    record.unwrap().map(|record| Record::decode(record).unwrap())
}

fn born_time(record: Option<Record>) -> Option<i64> {
    match record {
        Some(Record::Data(data)) => Some(data.born),
        _ => None,
    }
}

/// Returns the number of messages of a channel dropped for this cause.
fn drop_count(out: &Outgoing, channel: u32, cause: Cause) -> u64 {
    let mut all = out.dropped.iter();
    all.find_map(|(of, why, count)| (*of == channel && why == cause).then_some(count)).unwrap_or(0)
}

#[test]
fn a_message_shorter_than_a_piece_arrives_once_and_whole() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    out.set_throughput(1e9);
    let mut came = Vec::new();
    for number in 1..=3 {
        out.push(&data(1, number, SMALL + 1000), DeliveryMode::Newest);
        while let Some(frame) = out.next(0) {
            came.extend(born_time(deliver(&mut incoming, frame)));
        }
    }
    assert_eq!(came, [1, 2, 3]);
}

#[test]
fn after_four_billion_records_every_one_still_comes_once() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    // 2^32 records take fifty days at 1 kHz.
    let first = u64::from(u32::MAX) - 3;
    out.begin_at(first);
    incoming.reconnect(first);
    for number in 0..8 {
        out.push(&control(number), DeliveryMode::Each);
    }
    let mut came: Vec<Record> = Vec::new();
    while let Some(frame) = out.next(0) {
        came.extend(deliver(&mut incoming, frame));
    }
    assert_eq!(incoming.progress().number, first + 7);
    out.acknowledge(incoming.progress().number);
    assert!(out.retransmit.is_empty(), "the peer has them all");
    // The connection is lost with more in flight: one record was received, one was not.
    for number in 8..10 {
        out.push(&control(number), DeliveryMode::Each);
    }
    let frames: Vec<Frame> = std::iter::from_fn(|| out.next(0)).collect();
    came.extend(deliver(&mut incoming, frames[0].clone()));
    let (received, ahead) = incoming.received_numbers();
    out.reconnect(received, &ahead);
    incoming.reconnect(out.next_number());
    while let Some(frame) = out.next(0) {
        came.extend(deliver(&mut incoming, frame));
    }
    let all: Vec<Record> = (0..10).map(control).collect();
    assert_eq!(came, all);
}

#[test]
fn a_big_message_does_not_hold_up_small_ones() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    out.push(&data(1, 1, 1 << 20), DeliveryMode::Newest);
    assert!(matches!(out.next(0), Some(Frame::Begin { .. })));
    out.push(&data(2, 2, 10), DeliveryMode::Newest);
    out.push(&control(9), DeliveryMode::Each);
    let next = out.next(0).unwrap();
    assert_eq!(deliver(&mut incoming, next), Some(control(9)));
    let next = out.next(0).unwrap();
    assert_eq!(born_time(deliver(&mut incoming, next)), Some(2));
    assert!(matches!(out.next(0), Some(Frame::More { .. })));
}

#[test]
fn on_a_slow_link_a_command_waits_for_a_piece_of_a_picture_alone() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    // 600 kbit/s, on which the picture takes 0.4 s.
    out.set_throughput(75e3);
    out.push(&data(1, 1, 30_000), DeliveryMode::Newest);
    let begin = out.next(0).unwrap();
    assert!(matches!(&begin, Frame::Begin { bytes, .. } if bytes.len() <= 4096), "{begin:?}");
    assert_eq!(deliver(&mut incoming, begin), None);
    out.push(&data(2, 2, 10), DeliveryMode::Newest);
    let mut came = Vec::new();
    while let Some(frame) = out.next(0) {
        came.extend(born_time(deliver(&mut incoming, frame)));
    }
    assert_eq!(came, [2, 1]);
}

#[test]
fn a_flood_of_small_ones_does_not_stop_a_big_one() {
    let mut out = Outgoing::new(None);
    out.push(&data(1, 1, 200_000), DeliveryMode::Newest);
    for n in 0..200 {
        out.push(&data(2, n, 10), DeliveryMode::Newest);
    }
    let frames: Vec<Frame> = std::iter::from_fn(|| out.next(0)).take(100).collect();
    let pieces = frames.iter().filter(|frame| matches!(frame, Frame::More { .. }));
    assert!(pieces.count() >= 4, "{frames:?}");
}

#[test]
fn newest_wins_among_big_ones_and_old_ones_are_not_sent() {
    let mut out = Outgoing::new(Some(100));
    for n in 0..5 {
        out.push(&data(1, n, 1 << 17), DeliveryMode::Newest);
    }
    assert_eq!(drop_count(&out, 1, Cause::Replaced), 4);
    for n in 0..5 {
        out.push(&data(2, n * 50, 2000), DeliveryMode::Newest);
        // Commands are small, and all of them are sent.
        out.push(&data(3, n * 50 + 1, 10), DeliveryMode::Newest);
    }
    let mut incoming = Incoming::default();
    let mut came: Vec<i64> =
        std::iter::from_fn(|| out.next(250)).filter_map(|frame| born_time(deliver(&mut incoming, frame))).collect();
    assert_eq!(drop_count(&out, 2, Cause::Stale), 3, "those of 0, 50 and 100");
    came.sort_unstable();
    assert_eq!(came, [1, 4, 51, 101, 150, 151, 200, 201]);
}

#[test]
fn what_was_sent_and_did_not_come_is_counted_unless_it_is_sent_again() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    let mut came = Vec::new();
    // The first image arrives; the end of the second and a short message do not; the third is still queued.
    for number in 1..=3 {
        out.push(&data(1, number, 40_000), DeliveryMode::Newest);
        let frames = std::iter::from_fn(|| out.next(0)).take(3 - number as usize / 2);
        for frame in frames.collect::<Vec<_>>() {
            if number == 1 || matches!(frame, Frame::Begin { .. }) {
                came.extend(born_time(deliver(&mut incoming, frame)));
            }
        }
    }
    out.push(&data(2, 4, 10), DeliveryMode::Newest);
    let (received, ahead) = incoming.received_numbers();
    incoming.reconnect(out.next_number());
    out.reconnect(received, &ahead);
    while let Some(frame) = out.next(0) {
        came.extend(born_time(deliver(&mut incoming, frame)));
    }
    assert_eq!(came[0], 1);
    let lost: u64 = out.dropped.iter().map(|(.., count)| count).sum();
    assert_eq!(came.len() as u64 + lost, 4, "{came:?} {:?}", out.dropped);
    assert!(drop_count(&out, 1, Cause::CutOff) >= 1, "{:?}", out.dropped);
    assert!(came.contains(&4));
}

#[test]
fn what_waits_on_a_channel_that_is_gone_is_counted() {
    let mut out = Outgoing::new(None);
    for number in 0..3 {
        out.push(&data(1, number, 10), DeliveryMode::Newest);
    }
    out.forget_channel(1);
    assert_eq!(drop_count(&out, 1, Cause::Gone), 3);
}

#[test]
fn acknowledged_records_are_released() {
    let mut out = Outgoing::new(None);
    out.push(&control(1), DeliveryMode::Each);
    out.push(&control(2), DeliveryMode::Each);
    while out.next(0).is_some() {}
    assert_eq!(out.retransmit.len(), 2);
    out.acknowledge(1);
    assert_eq!(out.retransmit.len(), 1);
    out.acknowledge(2);
    assert_eq!((out.retransmit.len(), out.lanes.bytes()), (0, 0));
}

proptest! {
    /// Connections are lost after any frame: what is numbered arrives exactly once, and control records in order.
    #[test]
    fn nothing_kept_is_lost_or_doubled(
        sizes in prop::collection::vec(1_usize..100_000, 1..60),
        cuts in prop::collection::vec(1_usize..12, 0..12),
    ) {
        let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
        for (n, size) in sizes.iter().enumerate() {
            let call = Call { id: n as u32, service: 0, request: vec![0; *size].into() };
            out.push(&Record::Call(call), DeliveryMode::Each);
            out.push(&data(7, n as i64, size % 1000), DeliveryMode::Each);
        }
        let (mut calls, mut messages) = (Vec::new(), Vec::new());
        let mut cuts = cuts.into_iter();
        loop {
            let frames = cuts.next().unwrap_or(usize::MAX);
            // The last frame of a connection may be lost in flight.
            for n in 0..frames {
                let Some(frame) = out.next(0) else { break };
                if n + 1 == frames { break }
                match deliver(&mut incoming, frame) {
                    Some(Record::Call(Call { id, .. })) => calls.push(id),
                    Some(Record::Data(data)) => messages.push(data.born),
                    _ => {}
                }
            }
            if out.is_empty() && frames == usize::MAX { break }
            let (received, ahead) = incoming.received_numbers();
            incoming.reconnect(out.next_number());
            out.reconnect(received, &ahead);
        }
        let expected: Vec<u32> = (0..sizes.len() as u32).collect();
        prop_assert_eq!(calls, expected);
        let expected: Vec<i64> = (0..sizes.len() as i64).collect();
        prop_assert_eq!(messages, expected);
    }
}

fn encoding_outgoing() -> Outgoing {
    let mut out = Outgoing::new(None);
    out.encoding.channels.insert(1);
    out.encoding.pays = true;
    out
}

#[test]
fn the_newest_message_is_encoded() {
    let (mut out, mut incoming) = (encoding_outgoing(), Incoming::default());
    for born in 1..=3 {
        out.push(&data(1, born, 50_000), DeliveryMode::Newest);
    }
    assert_eq!(out.next(0), None, "it is to be encoded first");
    let (channel, message, alone) = out.encoding.take().unwrap();
    assert_eq!((channel, message[0], alone), (1, 3, false));
    assert_eq!(out.encoding.take(), None, "once");
    // Meanwhile other records are sent, and newer messages are queued.
    out.push(&data(2, 9, 10), DeliveryMode::Newest);
    out.push(&data(1, 4, 50_000), DeliveryMode::Newest);
    let next = out.next(0).unwrap();
    assert_eq!(born_time(deliver(&mut incoming, next)), Some(9));
    assert_eq!(out.next(0), None);
    assert!(out.is_idle() && !out.is_empty());
    out.encoding.finish(Some((Bytes::from_static(b"frame"), Duration::from_micros(7))));
    let frame = out.next(0).unwrap();
    let Some(Record::Data(sent)) = deliver(&mut incoming, frame) else {
        panic!("a message");
    };
    assert_eq!((sent.born, sent.encoded, sent.serialise, &sent.message[..]), (3, true, 7, &b"frame"[..]));
    assert_eq!(out.next(0), None);
    assert_eq!(out.encoding.take().unwrap().1[0], 4, "the next in turn");
    out.encoding.finish(None);
    let mut whole = None;
    while let Some(frame) = out.next(0) {
        whole = deliver(&mut incoming, frame).or(whole);
    }
    assert_eq!(born_time(whole), Some(4), "as it is, where it cannot be encoded");
    assert!(out.is_empty());
}

#[test]
fn a_message_that_came_damaged_goes_once_more_and_leaves_nothing() {
    // Big before it was encoded, small afterwards.
    let mut out = encoding_outgoing();
    out.push(&data(1, 1, 2 * SMALL), DeliveryMode::Each);
    assert_eq!(out.next(0), None);
    out.encoding.take().unwrap();
    out.encoding.finish(Some((Bytes::from_static(b"frame"), Duration::ZERO)));
    assert!(out.next(0).is_some());
    assert!(out.resend_damaged(1, 1) && !out.resend_damaged(1, 1));
    out.encoding.pays = false;
    let mut incoming = Incoming::default();
    incoming.reconnect(2);
    let frames: Vec<Frame> = std::iter::from_fn(|| out.next(0)).collect();
    let mut came = frames.into_iter().map(|frame| deliver(&mut incoming, frame));
    assert_eq!(came.find_map(born_time), Some(1));
    out.acknowledge(out.next_number() - 1);
    assert_eq!((out.retransmit.len(), out.lanes.bytes()), (0, 0));
}

#[test]
fn a_message_that_was_being_encoded_when_the_connection_was_lost_is_not() {
    let (mut out, mut incoming) = (encoding_outgoing(), Incoming::default());
    out.push(&data(1, 1, 50_000), DeliveryMode::Each);
    assert_eq!(out.next(0), None);
    assert!(out.encoding.take().unwrap().2, "it must be understood alone");
    out.reconnect(0, &[]);
    assert_eq!(out.next(0), None);
    assert_eq!(out.encoding.take().unwrap().1[0], 1);
    out.encoding.finish(Some((Bytes::from_static(b"frame"), Duration::ZERO)));
    let frame = out.next(0).unwrap();
    assert_eq!(born_time(deliver(&mut incoming, frame)), Some(1));
    // It was encoded once and is sent again in that form.
    out.reconnect(0, &[]);
    let frame = out.next(0).unwrap();
    assert!(matches!(frame, Frame::Whole { number: 1.., .. }), "{frame:?}");
    assert_eq!(out.encoding.take(), None);
}

#[test]
fn small_messages_and_other_topics_are_not_encoded() {
    let mut out = encoding_outgoing();
    out.push(&data(1, 1, 100), DeliveryMode::Newest);
    out.push(&data(2, 2, 50_000), DeliveryMode::Newest);
    assert!(out.next(0).is_some() && out.next(0).is_some());
    assert_eq!(out.encoding.take(), None);
}

fn latched_message(channel: u32, born: i64, size: usize) -> Record {
    let Record::Data(data) = data(channel, born, size) else { unreachable!("data is data") };
    Record::Data(Data { latching: true, ..data })
}

/// Returns the number of bytes of queued messages.
fn queued_bytes(out: &Outgoing) -> usize {
    let all = out.topics.values().flat_map(Ring::iter);
    all.map(|out| out.payload.len()).sum()
}

#[test]
fn latched_messages_for_a_dead_link_take_so_much_memory_and_no_more() {
    const MB: usize = 1 << 20;
    let mut out = Outgoing::new(None);
    // A growing map, a second map that was latched once, and the poses that belong to them.
    out.push(&latched_message(2, 0, 4 * MB), DeliveryMode::Each);
    for number in 1..=100 {
        out.push(&latched_message(1, number, 3 * MB), DeliveryMode::Each);
        out.push(&latched_message(3, number, 100), DeliveryMode::Each);
        assert!(queued_bytes(&out) <= 68 * MB, "{} MB", queued_bytes(&out) / MB);
    }
    assert_eq!(out.topics[&2].len(), 1, "nothing has taken its place");
    assert_eq!(out.topics[&3].len(), 100, "small ones cost nothing");
    assert_eq!(out.topics[&1].back().map(|out| out.born), Some(100));
    let kept = out.topics[&1].len();
    assert!((19..=21).contains(&kept), "{kept}");
    let lost = u64::try_from(100 - kept).unwrap();
    assert_eq!(drop_count(&out, 1, Cause::Full), lost, "{:?}", out.dropped);
    assert_eq!(out.dropped.iter().count(), 1, "each is told by its cause");
    // With many topics, one of them drops a message when their sum is too large.
    for channel in 10..40 {
        out.push(&latched_message(channel, 1, 8 * MB), DeliveryMode::Each);
        assert!(queued_bytes(&out) <= 73 * MB, "{} MB", queued_bytes(&out) / MB);
    }
    assert_eq!(out.topics[&39].len(), 1);
    // The last message stays however big it is.
    out.push(&latched_message(50, 1, 100 * MB), DeliveryMode::Each);
    assert_eq!(out.topics[&50].len(), 1);
    let mut incoming = Incoming::default();
    let mut came = 0;
    while let Some(frame) = out.next(0) {
        came += usize::from(deliver(&mut incoming, frame).is_some());
    }
    assert!(came > 100, "what was kept goes out: {came}");
}

#[test]
fn a_big_latched_message_that_was_cut_off_comes_again() {
    const BIG: usize = 6 << 20;
    let mut out = Outgoing::new(None);
    out.push(&latched_message(1, 1, BIG), DeliveryMode::Each);
    out.push(&data(2, 2, 10), DeliveryMode::Newest);
    let mut lost = Incoming::default();
    while let Some(frame) = out.next(0) {
        deliver(&mut lost, frame);
    }
    // The connection is lost and nothing is known to have been received.
    out.reconnect(0, &[]);
    let (mut incoming, mut came) = (Incoming::default(), Vec::new());
    incoming.reconnect(out.next_number());
    while let Some(frame) = out.next(0) {
        came.extend(born_time(deliver(&mut incoming, frame)));
    }
    came.sort_unstable();
    assert_eq!(came, [1, 2], "{:?}", out.dropped);
}

#[test]
fn a_channel_is_closed_after_its_last_message_and_leaves_nothing() {
    let mut out = Outgoing::new(None);
    let close = control(7);
    out.encoding.channels.insert(1);
    for number in 1..=3 {
        out.push(&data(1, number, 10 * number as usize), DeliveryMode::Each);
    }
    out.push(&data(1, 4, SMALL * 3), DeliveryMode::Each);
    out.close_channel(1, &close);
    out.push(&control(1), DeliveryMode::Each);
    let mut lost = Incoming::default();
    for _ in 0..4 {
        let frame = out.next(0).unwrap();
        deliver(&mut lost, frame);
    }
    // Cut off in the middle of the message.
    out.reconnect(0, &[]);
    let (mut incoming, mut came) = (Incoming::default(), Vec::new());
    incoming.reconnect(out.next_number());
    while let Some(frame) = out.next(0) {
        came.extend(deliver(&mut incoming, frame));
    }
    let messages: Vec<i64> = came.iter().cloned().filter_map(|it| born_time(Some(it))).collect();
    assert_eq!(messages, [1, 2, 3, 4]);
    assert_eq!(came.last(), Some(&close), "after all of them: {came:?}");
    assert!(out.closed.is_empty(), "the peer has not said that it has it");
    out.acknowledge(incoming.received_numbers().0);
    assert_eq!(out.closed, [1]);
    assert!(out.topics.is_empty() && out.encoding.channels.is_empty() && out.retransmit.is_empty());
}

fn answer(size: usize) -> Record {
    Record::Answer { id: 1, taken: 0, given: 0, response: Ok(Bytes::from(vec![0; size])) }
}

#[test]
fn a_peer_that_acknowledges_nothing_ends_the_session_before_memory_does() {
    for size in [10, SMALL / 2, 10 << 20] {
        let mut out = Outgoing::new(None);
        let mut pushed = 0;
        // The peer reads everything immediately.
        while out.overflow_reason.is_none() {
            assert!(pushed <= ANSWERS.messages, "{pushed} answers of {size} bytes");
            out.push(&answer(size), DeliveryMode::Each);
            while out.next(0).is_some() {}
            pushed += 1;
        }
        assert!(pushed * size <= ANSWERS.bytes + size);
        let reason = out.overflow_reason.clone().unwrap();
        assert!(reason.contains("not acknowledged"), "{reason}");
        // Further records are not kept any more.
        let held = out.lanes.bytes();
        out.push(&answer(size), DeliveryMode::Each);
        assert!((out.next(0).is_none(), out.lanes.bytes()) == (true, held));
    }
    // A peer that does acknowledge may be sent any amount.
    let mut out = Outgoing::new(None);
    for _ in 0..2 * ANSWERS.messages {
        out.push(&answer(10), DeliveryMode::Each);
        out.next(0).unwrap();
        out.acknowledge(out.next_number() - 1);
    }
    assert_eq!((out.overflow_reason.as_deref(), out.lanes.bytes()), (None, 0));
}

#[test]
fn goals_and_what_cancels_them_come_in_order_and_results_all() {
    for (of, quality) in [
        ("move_base_msgs/MoveBaseActionGoal", DeliveryMode::InOrder),
        ("actionlib_msgs/GoalID", DeliveryMode::InOrder),
        ("move_base_msgs/MoveBaseActionResult", DeliveryMode::Each),
        ("sensor_msgs/Image", DeliveryMode::Newest),
    ] {
        assert_eq!(DeliveryMode::for_type(of, false), quality, "{of}");
    }
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    out.push(&data(1, 1, 10 * SMALL), DeliveryMode::InOrder);
    out.push(&data(2, 2, 10), DeliveryMode::InOrder);
    let came: Vec<i64> =
        std::iter::from_fn(|| out.next(0)).filter_map(|frame| born_time(deliver(&mut incoming, frame))).collect();
    assert_eq!(came, [1, 2], "the goal, and then what cancels it");
}

#[test]
fn goals_beyond_the_limit_are_dropped_and_counted() {
    let mut out = Outgoing::new(None);
    for number in 0..CALLS.messages as i64 + 3 {
        out.push(&data(1, number, 10), DeliveryMode::InOrder);
    }
    assert_eq!((out.overflow_reason.as_deref(), drop_count(&out, 1, Cause::Full)), (None, 3));
}

#[test]
fn what_is_longer_than_the_peer_takes_is_left_out_and_counted() {
    let mut out = Outgoing::new(None);
    let record = 2 << 20;
    out.set_limits(LinkLimits { record, ..LinkLimits::default() });
    out.push(&data(1, 1, record), DeliveryMode::Each);
    out.push(&data(1, 2, record - 100), DeliveryMode::Each);
    assert_eq!(drop_count(&out, 1, Cause::Full), 1);
    assert!(matches!(out.next(0), Some(Frame::Begin { total, .. }) if total as usize <= record));
}

#[test]
fn limits_without_which_nothing_could_be_sent_are_not_believed() {
    let mut out = Outgoing::new(None);
    out.set_limits(LinkLimits { record: 0, under_way: 0, under_way_bytes: 0, ahead: 0, told: 0 });
    assert_eq!(out.peer_limits().told, crate::MAX_CONTROL);
    out.push(&control(1), DeliveryMode::Each);
    out.push(&data(1, 1, 100_000), DeliveryMode::Each);
    assert!(out.next(0).is_some() && out.next(0).is_some());
}

#[test]
fn on_a_slow_link_a_short_message_waits_for_a_tenth_of_a_second_of_pictures() {
    const RATE: f64 = 500e3 / 8.0;
    let mut out = Outgoing::new(None);
    out.set_throughput(RATE);
    for channel in 1..=3 {
        out.push(&data(channel, 1, 100_000), DeliveryMode::Newest);
        assert!(matches!(out.next(0), Some(Frame::Begin { .. })));
    }
    let mut waits = Vec::new();
    for born in 0..20 {
        // The bytes in the socket buffer, then those queued in front of the message.
        let mut before = out.low_water();
        out.push(&data(9, born, 50), DeliveryMode::Newest);
        while let Some(Frame::More { bytes, .. } | Frame::Begin { bytes, .. }) = out.next(0) {
            before += bytes.len();
        }
        waits.push(before as f64 / RATE);
    }
    waits.sort_by(f64::total_cmp);
    assert!(waits[18] < 0.14, "{waits:?}");
}

#[test]
fn a_flood_of_calls_does_not_stop_messages() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    for _ in 0..1000 {
        out.push(&answer(10), DeliveryMode::Each);
    }
    out.push(&data(1, 7, 10), DeliveryMode::Newest);
    let came: Vec<Option<i64>> =
        std::iter::from_fn(|| out.next(0)).map(|frame| born_time(deliver(&mut incoming, frame))).collect();
    let at = came.iter().position(|born| *born == Some(7));
    assert!(at < Some(5), "{at:?}");
}

#[test]
fn what_waits_counts_and_beyond_the_budget_messages_go_before_answers_do() {
    let budget = Budget::new("servant x", 8 << 20);
    let mut out = Outgoing::new(None);
    out.permit = Some(budget.permit());
    for born in 0..20 {
        for channel in 0..8 {
            out.push(&data(channel, born, 1 << 20), DeliveryMode::Each);
        }
    }
    assert!((6 << 20..=8 << 20).contains(&budget.used_bytes()), "{budget:?}");
    let lost: u64 = out.dropped.iter().map(|(.., count)| count).sum();
    assert!(lost >= 20 * 8 - 8, "{:?}", out.dropped);
    assert_eq!(out.overflow_reason.as_deref(), None);
    out.push(&answer(3 << 20), DeliveryMode::Each);
    let reason = out.overflow_reason.clone().expect("there is no room for it");
    assert!(reason.contains("the memory for servant x"), "{reason}");

    drop(out);

    // In flight, kept, and put back.
    let mut out = Outgoing::new(None);
    out.permit = Some(budget.permit());
    assert_eq!(budget.used_bytes(), 0);
    for _ in 0..100 {
        out.push(&answer(2 << 20), DeliveryMode::Each);
        assert!(budget.used_bytes() >= 2 << 20);
        while out.next(0).is_some() {}
        out.acknowledge(out.next_number() - 1);
        assert_eq!(budget.used_bytes(), 0);
    }
    assert_eq!(out.overflow_reason.as_deref(), None);
}

#[test]
fn the_newest_lines_come_before_the_last_order() {
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    for number in 0..=255 {
        out.push_line(&control(number));
    }
    out.push_last(&control(0));
    // Nothing passes it, and nothing is left.
    out.push(&control(1), DeliveryMode::Each);
    let frames: Vec<Frame> = std::iter::from_fn(|| out.next(0)).collect();
    let came: Vec<Record> = frames.into_iter().filter_map(|frame| deliver(&mut incoming, frame)).collect();
    let Some(Record::Control(notice)) = came.first() else {
        panic!("{came:?}");
    };
    assert!(String::from_utf8_lossy(notice).contains("[128 lines"), "{notice:?}");
    let last: Vec<Record> = (128..=255).chain([0, 1]).map(control).collect();
    assert_eq!(came[1..], last);
}

/// Returns the number of lines that a record is or tells of as omitted.
fn count_lines(record: Record) -> u64 {
    let Record::Control(text) = record else {
        panic!("{record:?}");
    };
    let text = String::from_utf8_lossy(&text);
    let omitted = text.split('[').nth(1).and_then(|text| text.split(' ').next());
    omitted.map_or(1, |count| count.parse().unwrap())
}

#[test]
fn lines_that_are_lost_unkept_are_told_of() {
    const PRINTED_LINES: u64 = 90;
    let (mut out, mut incoming) = (Outgoing::new(None), Incoming::default());
    out.set_limits(LinkLimits { ahead: 256, ..LinkLimits::default() });
    let line = Record::Control(vec![b'x'; 30_000].into());
    let mut lost = Vec::new();
    for _ in 0..PRINTED_LINES {
        out.push_line(&line);
        lost.extend(out.next(0));
    }
    assert!(lost.iter().all(|frame| matches!(frame, Frame::Whole { number: 1.., .. })), "each can be missed");
    assert_eq!(lost.len(), 256 / UNKEPT_AHEAD, "the others wait");
    out.reconnect(0, &[]);
    incoming.reconnect(out.next_number());
    let mut came = 0;
    while !out.is_empty() {
        came += out.next(0).and_then(|frame| deliver(&mut incoming, frame)).map_or(0, count_lines);
        out.acknowledge(incoming.progress().number);
    }
    assert_eq!(came, PRINTED_LINES, "lines, and those that were told of");
}
