//! Lanes of a session: frames of one end passed to the other one by one.

use super::*;
use crate::control::{Graph, InputChannel, RequestedInput};
use crate::frame::Frame;
use crate::session::Session;

fn options() -> SessionOptions {
    SessionOptions::for_silence(Duration::from_secs(1), None)
}

/// A robot's and a cloud's end after hello and welcome.
fn ends() -> (RobotSession, CloudSession) {
    let (robot, cloud) = (RobotSession::new(options()), CloudSession::new(options()));
    robot.reconnect(0, &[], 1);
    cloud.reconnect(0, &[], 1);
    (robot, cloud)
}

/// Returns the next frame of one end.
fn frame<O: ControlMessage>(from: &Session<O>) -> Option<Frame> {
    from.state.lock().out.next(0)
}

/// Receives a frame as the other end does; returns the record that it completes.
fn deliver<O: ControlMessage>(to: &Session<O>, frame: Frame) -> Result<Option<Record>, Error> {
    let incoming = &mut to.state.lock().incoming;
    let bytes = match frame {
        Frame::Whole { number, record } => incoming.receive_whole(number, record)?,
        Frame::Begin { stream, number, total, bytes } => incoming.receive_begin(stream, number, total, &bytes)?,
        Frame::More { stream, bytes } => incoming.receive_more(stream, &bytes)?,
        other => panic!("{other:?}"),
    };
    bytes.map(Record::decode).transpose()
}

/// Passes everything queued at one end to the other.
fn carry<A: ControlMessage, B: ControlMessage>(from: &Session<A>, to: &Session<B>) -> Vec<Record> {
    let frames = std::iter::from_fn(|| frame(from));
    let came = frames.filter_map(|frame| deliver(to, frame).expect("the other end takes it"));
    came.collect()
}

/// Returns the lines among records.
fn lines(came: &[Record]) -> Vec<String> {
    let orders = came.iter().filter_map(|record| match record {
        Record::Control(json) => serde_json::from_slice(json).ok(),
        _ => None,
    });
    let lines = orders.filter_map(|order| match order {
        FromCloud::Line { text, .. } => Some(text),
        _ => None,
    });
    lines.collect()
}

fn line(text: impl ToString) -> FromCloud {
    FromCloud::Line { error: false, text: text.to_string() }
}

/// A graph with this many inputs of about 60 bytes of text each.
fn graph(inputs: usize) -> FromCloud {
    let inputs =
        (0..inputs).map(|number| RequestedInput { topic: format!("/input_{number}"), ..RequestedInput::default() });
    FromCloud::Graph(Graph { inputs: inputs.collect(), ..Graph::default() })
}

#[test]
fn a_message_does_not_wait_for_a_thousand_lines() {
    let (robot, cloud) = ends();
    for number in 0..1000 {
        cloud.send_control(&line(number));
    }
    cloud.publish(data(1, 10), DeliveryMode::Newest);
    let came = carry(&cloud, &robot);
    let at = came.iter().position(|record| matches!(record, Record::Data(_)));
    assert!(at < Some(3), "it is record {at:?}");
    assert_eq!(lines(&came).len(), 1000, "and all lines come after it");
}

#[test]
fn lines_take_a_small_share_while_messages_wait() {
    let (robot, cloud) = ends();
    for number in 0..1000 {
        cloud.send_control(&line(format!("{number} {}", "x".repeat(80))));
    }
    let (mut of_lines, mut of_messages) = (0, 0);
    for _ in 0..1000 {
        cloud.publish(data(1, 100), DeliveryMode::Newest);
        match deliver(&robot, frame(&cloud).unwrap()).unwrap().unwrap() {
            Record::Data(_) => of_messages += 1,
            _ => of_lines += 1,
        }
    }
    assert!(of_lines * 10 < of_messages, "{of_lines} lines beside {of_messages} messages");
    assert!(of_lines > 10, "they come all the same: {of_lines}");
}

#[test]
fn lines_for_a_link_that_is_away_do_not_end_the_session_and_those_left_out_are_told() {
    let (robot, cloud) = ends();
    for number in 0..100_000 {
        cloud.send_control(&line(number));
    }
    assert_eq!(cloud.state.lock().out.overflow_reason, None);
    let came = lines(&carry(&cloud, &robot));
    assert_eq!(came.last().map(String::as_str), Some("99999"), "the newest stay");
    let kept = came.len() - 1;
    let told = format!("{} lines", 100_000 - kept);
    assert!(came[0].contains(&told), "{}: {}", came[0], told);
    // Reported once; later lines are delivered normally.
    cloud.send_control(&line("more"));
    assert_eq!(lines(&carry(&cloud, &robot)), ["more"]);
}

#[test]
fn control_comes_in_order_however_long_it_is() {
    let (robot, cloud) = ends();
    let told = [graph(1000), graph(2), graph(700), graph(0)];
    for graph in &told {
        cloud.send_control(graph);
    }
    let came = carry(&cloud, &robot);
    let came: Vec<FromCloud> = came
        .iter()
        .map(|record| match record {
            Record::Control(json) => serde_json::from_slice(json).unwrap(),
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(came == told, "the last graph that comes is the last one");
}

#[test]
fn a_message_comes_after_the_opening_of_its_channel() {
    let (robot, cloud) = ends();
    let open = |channel, definition: usize| {
        robot.send_control(&FromRobot::Open(InputChannel {
            channel,
            definition: "x".repeat(definition),
            ..InputChannel::default()
        }));
        robot.open_channel(channel, "/t", codec::Schema::for_type("a/B", "0"));
    };
    open(1, 100_000);
    robot.publish(data(1, 10), DeliveryMode::Newest);
    open(2, 10);
    robot.publish(data(2, 10), DeliveryMode::Newest);
    let mut opened = Vec::new();
    for record in carry(&robot, &cloud) {
        match record {
            Record::Control(json) => match serde_json::from_slice(&json).unwrap() {
                FromRobot::Open(input) => opened.push(input.channel),
                other => panic!("{other:?}"),
            },
            Record::Data(data) => assert!(opened.contains(&data.channel), "{}", data.channel),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(opened, [1, 2]);
}

#[test]
fn a_long_opening_holds_up_no_other_channel() {
    let (robot, _) = ends();
    robot.send_control(&FromRobot::Open(InputChannel {
        channel: 1,
        definition: "x".repeat(500_000),
        ..InputChannel::default()
    }));
    robot.open_channel(1, "/t", codec::Schema::for_type("a/B", "0"));
    assert!(matches!(frame(&robot), Some(Frame::Begin { .. })));
    robot.publish(data(2, 10), DeliveryMode::Newest);
    assert!(matches!(frame(&robot), Some(Frame::Whole { .. })));
}

#[test]
fn a_cancel_does_not_overtake_its_call() {
    let (robot, cloud) = ends();
    let goal = robot.call(1, vec![0; 200_000].into());
    let cancel = robot.call(2, Bytes::new());
    let came = carry(&robot, &cloud);
    let ids = came.iter().map(|record| match record {
        Record::Call(Call { id, .. }) => *id,
        other => panic!("{other:?}"),
    });
    assert_eq!(ids.collect::<Vec<_>>(), [goal, cancel]);
}

#[test]
fn short_answers_do_not_wait_for_long_ones() {
    let (_, cloud) = ends();
    cloud.answer(1, 0, Ok(vec![0; 1 << 20].into()));
    assert!(matches!(frame(&cloud), Some(Frame::Begin { .. })));
    cloud.answer(2, 0, Ok(Bytes::new()));
    assert!(matches!(frame(&cloud), Some(Frame::Whole { .. })));
}

#[test]
fn as_many_long_records_as_there_are_come() {
    let (robot, cloud) = ends();
    for number in 0..300 {
        robot.call(1, vec![0; 40_000].into());
        robot.answer(number, 0, Ok(vec![0; 40_000].into()));
        robot.send_control(&FromRobot::Parameters(vec![("x".repeat(40_000), None)]));
        robot.publish(data(1000 + number, 40_000), DeliveryMode::Newest);
    }
    assert_eq!(carry(&robot, &cloud).len(), 1200);
}

#[test]
fn records_under_way_are_as_long_together_as_the_other_end_takes() {
    let (robot, cloud) = ends();
    for channel in 0..5 {
        robot.publish(data(channel, 100 << 20), DeliveryMode::Newest);
    }
    // Each has begun before the first one is complete.
    assert_eq!(carry(&robot, &cloud).len(), 5);
}

#[test]
fn a_long_map_comes_beside_ever_so_many_small_messages() {
    let (robot, cloud) = ends();
    robot.state.lock().out.set_throughput(125_000.0);
    let mut map = data(1, 20 << 20);
    map.latching = true;
    robot.publish(map, DeliveryMode::Each);
    let mut came = 0;
    // 20 MB in pieces of the minimum size, after sixteen small messages each: 80,000 of them.
    for round in 0..200_000 {
        robot.publish(data(2, 10), DeliveryMode::Newest);
        if round % 1000 == 0 {
            robot.call(1, Bytes::new());
        }
        let Some(frame) = frame(&robot) else { break };
        let record = deliver(&cloud, frame).expect("the other end takes it");
        if matches!(&record, Some(Record::Data(data)) if data.channel == 1) {
            came += 1;
        }
    }
    assert_eq!(came, 1, "the map");
}
