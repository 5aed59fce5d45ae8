use std::sync::Arc;

use ros::bus::{Bus, BusError, DoubleRange, FailureReason, IntegerRange, ParamValue, ParameterEvent, ParameterKind};
use ros::ros2::Ros2Bus;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, wait_graph};

const TUNED: &str = "/lab/tuned";

/// Joins, starts the nodes of `tuned.py` and waits until they are discovered.
pub async fn tuned_node(lab: &Lab) -> (Arc<Ros2Bus>, Peer) {
    let nodes = lab.node("tuned.py", &[]).await;
    let bus = lab.join("/cloudroid_bridge").await;
    for service in [
        "/lab/tuned/describe_parameters",
        "/lab/tuned/set_parameters_atomically",
        "/lab/staged/get_available_transitions",
        "/lab/staged/set_parameters",
    ] {
        wait_graph(&bus, |graph| graph.services.contains_key(service)).await;
    }
    (bus, nodes)
}

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

fn text(text: &str) -> ParamValue {
    ParamValue::String(text.to_owned())
}

fn list<const N: usize>(items: [ParamValue; N]) -> ParamValue {
    ParamValue::List(items.into())
}

#[tokio::test]
async fn parameters_of_a_node_are_listed_read_and_described() {
    use ParamValue::{Binary, Bool, Double, Int};
    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let parameters = bus.node_parameters().unwrap();
    let listed = parameters.list(TUNED, &[], 0).await.unwrap();
    for name in ["on", "blob", "arm.joint.gain", "use_sim_time"] {
        assert!(listed.names.iter().any(|listed| listed == name), "{name}");
    }
    assert!(listed.prefixes.contains(&"arm.joint".to_owned()));
    let below = parameters.list(TUNED, &names(&["arm"]), 1).await.unwrap();
    assert_eq!(below.names, ["arm.length"]);

    let all = [
        ("on", Bool(true)),
        ("count", Int((1 << 53) + 1)),
        ("name", text("gütig")),
        ("blob", Binary(vec![1, 255])),
        ("bools", list([Bool(true), Bool(false)])),
        ("ints", list([Int(1), Int(-2)])),
        ("doubles", list([Double(0.5), Double(2.0)])),
        ("texts", list([text("a"), text("")])),
        ("arm.joint.gain", Int(3)),
        ("speed", Double(1.5)),
    ];
    let asked = all.clone().map(|(name, _)| name.to_owned());
    let values = parameters.get(TUNED, &asked).await.unwrap();
    assert_eq!(values, all.map(|(_, value)| Some(value)));
    let some = names(&["on", "nothing", "unset", "count"]);
    let values = parameters.get(TUNED, &some).await.unwrap();
    let found: Vec<bool> = values.iter().map(Option::is_some).collect();
    assert_eq!(found, [true, false, false, true]);
    let nowhere = parameters.get("/lab/nobody", &some).await;
    assert!(matches!(nowhere, Err(BusError::NoService(_))), "{nowhere:?}");

    let asked = names(&["speed", "level", "serial", "any", "nothing"]);
    let described = parameters.describe(TUNED, &asked).await.unwrap();
    let [Some(speed), Some(level), Some(serial), Some(any), None] = &described[..] else {
        panic!("{described:?}");
    };
    assert_eq!((&*speed.name, speed.kind), ("speed", ParameterKind::Double));
    assert_eq!((&*speed.description, &*speed.constraints), ("how fast", "not on stairs"));
    let (from, to, step) = (0.0, 100.0, 0.5);
    assert_eq!(speed.double_range, Some(DoubleRange { from, to, step }));
    let (from, to, step) = (-1, 9, 2);
    assert_eq!(level.integer_range, Some(IntegerRange { from, to, step }));
    assert!(serial.read_only && !any.read_only && any.dynamic_typing);
    assert_eq!((serial.double_range, level.double_range), (None, None));
}

#[tokio::test]
async fn parameters_of_a_node_are_set_if_it_agrees() {
    use ParamValue::{Binary, Double, Int};
    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let parameters = bus.node_parameters().unwrap();
    let changes = [
        ("speed", Int(2)),
        ("speed", Int(11)),
        ("serial", text("x2")),
        ("doubles", list([Int(1), Int(2)])),
        ("blob", list([Int(7), Int(8)])),
        ("texts", list([])),
        ("count", Double(5.0)),
        ("name", Int(5)),
        ("nothing", Int(5)),
    ];
    let changes = changes.map(|(name, value)| (name.to_owned(), Some(value)));
    let set = parameters.set(TUNED, changes.into()).await.unwrap();
    let done: Vec<bool> = set.iter().map(Result::is_ok).collect();
    let expected = [true, false, false, true, true, true, true, false, false];
    assert_eq!(done, expected, "{set:?}");
    assert_eq!(set[1], Err(FailureReason::new("too fast")));
    let asked = names(&["speed", "serial", "doubles", "blob", "texts", "count"]);
    let values = parameters.get(TUNED, &asked).await.unwrap();
    let expected = [Double(2.0), text("x1"), list([Double(1.0), Double(2.0)]), Binary(vec![7, 8]), list([]), Int(5)];
    assert_eq!(values, expected.map(Some));

    let both = |speed| {
        let change = |name: &str, value| (name.to_owned(), Some(value));
        vec![change("count", Int(6)), change("speed", Int(speed))]
    };
    let refused = parameters.set_atomically(TUNED, both(12)).await.unwrap_err();
    assert_eq!(refused.to_string(), "service /lab/tuned/set_parameters_atomically failed: too fast");
    let count = names(&["count"]);
    assert_eq!(parameters.get(TUNED, &count).await.unwrap(), [Some(Int(5))]);
    parameters.set_atomically(TUNED, both(3)).await.unwrap();
    assert_eq!(parameters.get(TUNED, &count).await.unwrap(), [Some(Int(6))]);
}

#[tokio::test]
async fn changes_of_parameters_are_told() {
    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let parameters = bus.node_parameters().unwrap();
    let mut of_tuned = parameters.watch(Some(TUNED)).await.unwrap();
    let mut of_all = parameters.watch(None).await.unwrap();
    let change = |name: &str, value| vec![(name.to_owned(), Some(value))];
    let broken = change("broken", ParamValue::Bool(true));
    assert_eq!(parameters.set("/lab/staged", broken).await.unwrap(), [Ok(())]);
    let staged = timeout(LONG, of_all.next()).await.expect("an event");
    let staged = staged.expect("the bus is open");
    assert_eq!(staged.node, "/lab/staged");
    assert_eq!(staged.changed, [("broken".to_owned(), ParamValue::Bool(true))]);
    let level = change("level", ParamValue::Int(3));
    parameters.set(TUNED, level).await.unwrap();
    let tuned = timeout(LONG, of_tuned.next()).await.expect("an event");
    let expected = ParameterEvent {
        node: TUNED.to_owned(),
        changed: vec![("level".to_owned(), ParamValue::Int(3))],
        ..ParameterEvent::default()
    };
    assert_eq!(tuned, Some(expected));
}
