//! Changes of parameters, and dynamic_reconfigure.

use super::*;

const NODE: &str = "/see";

fn text(text: &str) -> ParamValue {
    ParamValue::String(text.to_owned())
}

/// Declares or sets parameters of the node, all at once.
async fn set(node: &MemoryBus, values: &[(&str, ParamValue)]) {
    let changes = values.iter().map(|(name, value)| ((*name).to_owned(), Some(value.clone()))).collect();
    node.node_parameters().expect("ROS 2").set(NODE, changes).await.expect("a node");
}

/// Returns the next message as JSON.
async fn next_value(of: &MessageType, subscription: &mut Subscription) -> Value {
    parse(of, &next(subscription).await.bytes)
}

fn builtin_type(bus: &TranslatedBus, name: &str) -> Arc<MessageType> {
    bus.message(&WireType::with_name(name)).expect(name)
}

/// Returns the names in a list of a message.
fn names(list: &Value) -> Vec<&str> {
    let items = list.as_array().into_iter().flatten();
    items.filter_map(|item| item["name"].as_str()).collect()
}

#[tokio::test]
async fn a_robot_of_ros_1_is_told_what_it_can_reconfigure_at_a_node_of_ros_2() {
    let (bus, _, node) = servant_of_ros2();
    let list = ParamValue::List(vec![ParamValue::Int(1)]);
    let wide = ParamValue::Int(1 << 40);
    set(&node, &[("gain", ParamValue::Double(0.5)), ("gains.p", ParamValue::Int(1)), ("frame", text("map"))]).await;
    set(&node, &[("list", list), ("wide", wide), ("use_sim_time", ParamValue::Bool(false))]).await;
    let topic = "/see/parameter_descriptions";
    let graph = wait_graph(&*bus, |graph| graph.topics.contains_key(topic)).await;
    assert_eq!(graph.topics[topic].type_name, "dynamic_reconfigure/ConfigDescription");
    assert_eq!(graph.topics[topic].publishers, [NODE]);
    let offer = bus.topic_offer(topic).await.expect("it is there");
    assert!(offer.latching && offer.wire_type.digest == "757ce9d44ba8ddd801bb30bc456f946f", "{offer:?}");
    let qos = QosProfile::keep_last(5).latching(true);
    let mut told = bus.subscribe(topic, WireType::any(), qos).await.expect("a subscription");
    wait_matched(told.matched.clone(), NODE).await;
    let first = next(&mut told).await;
    assert_eq!((first.publisher.node(), first.latching), (NODE, true));
    let of = builtin_type(&bus, "dynamic_reconfigure/ConfigDescription");
    let first = parse(&of, &first.bytes);
    assert_eq!(names(&first["groups"][0]["parameters"]), ["frame", "gain", "gains/p"]);
    assert_eq!(first["groups"][0]["parameters"][1]["description"], "gain of /see");
    for part in ["max", "min", "dflt"] {
        let has = ["strs", "doubles", "ints"].map(|list| names(&first[part][list]).join(" "));
        assert_eq!(has, ["frame", "gain", "gains/p"], "{part}");
    }
    // Another value changes nothing in it, another parameter does.
    set(&node, &[("gain", ParamValue::Double(2.0))]).await;
    set(&node, &[("late", ParamValue::Bool(true))]).await;
    let second = next_value(&of, &mut told).await;
    assert_eq!(names(&second["groups"][0]["parameters"]), ["frame", "gain", "gains/p", "late"]);
    assert_eq!(second["dflt"]["doubles"][0]["value"], 0.5);
}

#[tokio::test]
async fn a_robot_of_ros_1_reconfigures_a_node_of_ros_2() {
    let (bus, losses, node) = servant_of_ros2();
    set(&node, &[("gain", ParamValue::Double(0.5)), ("gains.p", ParamValue::Int(1)), ("frame", text("map"))]).await;
    let service = "/see/set_parameters";
    let graph = wait_graph(&*bus, |graph| graph.services.contains_key(service)).await;
    assert_eq!(graph.services[service], NODE);
    let of = bus.service_type(service).await.expect("a type");
    assert_eq!(
        (&*of.name, of.digest.as_str()),
        ("dynamic_reconfigure/Reconfigure", "bb125d226a21982a4a98760418dc2672")
    );
    let config = builtin_type(&bus, "dynamic_reconfigure/Config");
    let qos = QosProfile::keep_last(5).latching(true);
    let mut updates = bus.subscribe("/see/parameter_updates", WireType::any(), qos).await.expect("a subscription");
    assert_eq!(next_value(&config, &mut updates).await["doubles"][0]["value"], 0.5);
    let asked = json!({
        "doubles": [{ "name": "gain", "value": 2.0 }],
        "ints": [{ "name": "gains/p", "value": 3 }, { "name": "none", "value": 1 }],
        "bools": [{ "name": "frame", "value": true }],
    });
    let answer = bus.call_typed(service, &of.digest, serialize(&config, &asked), LONG).await.expect("an answer");
    let chosen = parse(&config, &answer);
    assert_eq!(chosen["doubles"], json!([{ "name": "gain", "value": 2.0 }]));
    assert_eq!(chosen["ints"], json!([{ "name": "gains/p", "value": 3 }]));
    assert_eq!(chosen["strs"], json!([{ "name": "frame", "value": "map" }]), "it is what it was");
    let told = losses.0.lock().join("\n");
    let refused = ["/see/frame", "it is of the type str", "/see/none", "the node has no such parameter"];
    assert!(refused.iter().all(|part| told.contains(part)), "{told}");
    assert_eq!(next_value(&config, &mut updates).await, chosen);
    let held = node.node_parameters().expect("ROS 2").get(NODE, &["gains.p".to_owned()]).await;
    assert_eq!(held.expect("a node"), [Some(ParamValue::Int(3))]);
    // It is what the node gets when it is started again.
    let launch = bus.prepare_launch(NODE, &[], &BTreeMap::new()).argv;
    assert_eq!(launch.join(" "), "--ros-args -p gain:=2.0 -p gains.p:=3 --");
    let other = bus.call_typed(service, &Digest::from("0"), answer, LONG).await;
    assert!(matches!(other, Err(BusError::TypeMismatch { .. })), "{other:?}");
}

#[tokio::test]
async fn a_robot_of_ros_2_hears_what_changes_at_a_node_of_ros_1() {
    let (bus, _, node) = servant_of_ros1().await;
    let _alive = node.advertise("/alive", string(RosVersion::One), QosProfile::keep_last(1)).await.expect("a topic");
    let topic = "/parameter_events";
    let graph = wait_graph(&*bus, |graph| graph.publishes(NODE, topic)).await;
    let (of, qos) = &graph.ends[NODE].publishers[topic];
    assert_eq!((&*of.name, qos.is_latching()), ("rcl_interfaces/msg/ParameterEvent", false));
    assert_eq!(bus.topic_type(topic).await.expect("a type").digest, of.digest);
    let of = builtin_type(&bus, "rcl_interfaces/msg/ParameterEvent");
    let events = bus.subscribe(topic, WireType::any(), QosProfile::keep_last(10)).await;
    let mut events = events.expect("a subscription");
    wait_matched(events.matched.clone(), NODE).await;
    // Nobody waits for a node to report that it sends this.
    let reports = bus.publisher_reports().expect("ROS 1 has reports");
    assert!(reports.reported_connections(topic).await.is_err() && reports.reported_connections("/x").await.is_ok());
    let master = node.parameters().expect("a Master");
    // What the node sets itself.
    master.set("/see/gains/p", ParamValue::Int(5)).await.expect("a Master");
    let message = next(&mut events).await;
    assert_eq!(message.publisher.node(), NODE);
    let event = parse(&of, &message.bytes);
    assert_eq!(event["node"], NODE);
    let changed = &event["changed_parameters"][0];
    assert_eq!((&changed["name"], &changed["value"]["integer_value"]), (&json!("gains.p"), &json!(5)));
    // What the robot sets, and what a server of dynamic_reconfigure writes: all of its parameters.
    let rate = vec![("rate".to_owned(), Some(ParamValue::Double(0.5)))];
    let set = bus.node_parameters().expect("ROS 2").set(NODE, rate).await.expect("a node");
    assert_eq!(set, [Ok(())]);
    assert_eq!(names(&next_value(&of, &mut events).await["changed_parameters"]), ["rate"]);
    let config = [("rate".to_owned(), ParamValue::Double(0.5)), ("mode".to_owned(), ParamValue::Int(2))];
    for (name, value) in config {
        master.set(&format!("/see/{name}"), value).await.expect("a Master");
    }
    assert_eq!(names(&next_value(&of, &mut events).await["changed_parameters"]), ["mode"]);
    master.delete("/see/rate").await.expect("a Master");
    let event = next_value(&of, &mut events).await;
    assert_eq!((names(&event["deleted_parameters"]), names(&event["changed_parameters"])), (vec!["rate"], Vec::new()));
}
