//! Links of rclpy nodes: what the robot's end receives and can do, and lent services and actions.

use std::sync::Arc;

use link::clock::now;
use link::control::{Graph, Hello, InputChannel};
use ros::bus::{Bus, FailureReason, Lending, QosProfile, RosVersion, ServiceType, WireType};
use ros::ros2::Ros2Bus;
use ros::schema::Registry;
use serde_json::{Value, json as value};
use tokio::time::timeout;

use super::actions::fibonacci;
use super::lab::{
    GET_PARAMETERS, LONG, Lab, cdr, json, set_bool, set_bool_type, string, string_message, string_type, wait_graph,
};
use super::robot::{CloudRequest, LinkedRobot, RunTracker, expect_refusal, find_output, find_service, hello, hub};
use super::services::{CallerEchoService, request};

const NODE: &str = "/cloudroid_bridge";
const PEER: &str = "/lab/peer";
const DEFINITIONS: [(&str, &str); 2] = [
    ("std_msgs/msg/String", "string data"),
    ("std_srvs/srv/SetBool", "bool data\n---\nbool success\nstring message\n"),
];

/// Connects a link of this node, whose robot's end waits until its graph satisfies a condition.
async fn connect_robot(bus: &Arc<Ros2Bus>, node: &str, wanted: impl Fn(&Graph) -> bool) -> (LinkedRobot, Graph) {
    let nodes = Arc::new(RunTracker::default());
    let hub = hub(Arc::clone(bus) as _, nodes, &DEFINITIONS);
    let robot = LinkedRobot::connect(&hub, &hello(node)).await;
    let graph = robot.wait_graph(wanted).await;
    (robot, graph)
}

fn strings(topic: &str, channel: u32) -> InputChannel {
    let of = string_type();
    InputChannel {
        channel,
        topic: topic.to_owned(),
        type_name: of.name,
        md5: of.digest.to_string(),
        ..InputChannel::default()
    }
}

/// Returns the text of a message, ignoring padding.
fn text(message: &[u8]) -> String {
    let said: Value = serde_json::from_str(&json(&string(), message)).expect("JSON");
    said["data"].as_str().expect("a string").to_owned()
}

#[tokio::test]
async fn the_robot_is_told_all_that_a_node_has_with_its_quality_of_service() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let (robot, graph) = connect_robot(&bus, PEER, |graph| {
        graph.inputs.len() >= 3 && graph.outputs.len() >= 6 && graph.services.len() >= 8
    })
    .await;
    let quality = |topic: &str| {
        let output = find_output(&graph, topic).unwrap_or_else(|| panic!("{topic}: {graph:#?}"));
        let qos = output.qos.as_ref().expect("it is told");
        (qos.best_effort, qos.transient_local)
    };
    assert_eq!(quality("/pong"), (false, false));
    assert_eq!(quality("/map"), (false, true));
    assert_eq!(quality("/scan"), (true, false));
    assert!(quality("/rosout").1);
    quality("/parameter_events");
    let inputs: Vec<_> = graph
        .inputs
        .iter()
        .map(|input| {
            let latching = input.qos.as_ref().is_some_and(|qos| qos.transient_local);
            (&*input.topic, latching, input.feed)
        })
        .collect();
    assert_eq!(inputs, [("/late", true, true), ("/ping", false, true), ("/strict", false, true)]);
    // The stub matches responses by their contents.
    let of = string_type();
    assert_eq!(graph.inputs[0].md5, of.digest.as_str());
    let told = robot.definition(&of.name, of.digest.as_str());
    assert_eq!(told.as_deref(), Some(&*of.definition));
    let set = find_service(&graph, "/set").expect("it is served");
    assert!(set.service_type(RosVersion::Two).is_compatible_with(&set_bool_type()), "{set:?}");
    assert_eq!(set.halves.len(), 2);
    for own in ["get_parameters", "set_parameters", "describe_parameters"] {
        let name = format!("{PEER}/{own}");
        assert!(find_service(&graph, &name).is_some(), "{name}: {graph:#?}");
    }
}

#[tokio::test]
async fn messages_calls_and_parameters_go_through_a_link() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let parameters = format!("{PEER}/get_parameters");
    let (mut robot, graph) = connect_robot(&bus, PEER, |graph| {
        find_output(graph, "/pong").is_some()
            && find_output(graph, "/map").is_some()
            && graph.inputs.iter().any(|input| input.topic == "/ping")
            && find_service(graph, "/set").is_some()
            && find_service(graph, &parameters).is_some()
    })
    .await;
    // The first subscriber receives the answer to the first message.
    let pong = find_output(&graph, "/pong").unwrap();
    robot.listen(pong);
    robot.open_input(strings("/ping", 1));
    // The node's own endpoints keep 10.
    for some in [0..10, 10..20] {
        for number in some.clone() {
            robot.publish(1, string_message(&number.to_string()));
        }
        for number in some {
            let (channel, message) = robot.next_message().await;
            assert_eq!((channel, text(&message)), (pong.channel, number.to_string()));
        }
    }
    // Later subscribers receive the history.
    let map = find_output(&graph, "/map").unwrap();
    robot.listen(map);
    let (channel, message) = robot.next_message().await;
    assert_eq!((channel, &*text(&message)), (map.channel, "kept"));
    let set = find_service(&graph, "/set").unwrap();
    for data in [true, false] {
        let answer = robot.call(set, request(data)).await.unwrap();
        let expected = format!(r#"{{"success":{data},"message":"set"}}"#);
        assert_eq!(json(&set_bool().response, &answer), expected);
    }
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in GET_PARAMETERS {
        registry.insert(key, text).expect("a definition");
    }
    let get = registry.service("rcl_interfaces/srv/GetParameters").unwrap();
    let asked = cdr(&get.request, r#"{"names":["use_sim_time"]}"#);
    let answer = robot.call(find_service(&graph, &parameters).unwrap(), asked);
    let answer: Value = serde_json::from_str(&json(&get.response, &answer.await.unwrap())).unwrap();
    assert_eq!(answer["values"][0]["type"], 1, "{answer}");
    assert_eq!(answer["values"][0]["bool_value"], false, "{answer}");
}

#[tokio::test]
async fn the_robot_is_told_how_many_messages_a_node_keeps_before_it_gets_them() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let both = |graph: &Graph| find_output(graph, "/plan").is_some() && find_output(graph, "/map").is_some();
    let (mut robot, graph) = connect_robot(&bus, PEER, both).await;
    for (topic, kept) in [("/plan", &["2", "3", "4"][..]), ("/map", &["kept"])] {
        let output = find_output(&graph, topic).unwrap();
        assert_eq!(robot.kept_count(output), None, "{topic}: nobody listens");
        robot.listen(output);
        for expected in kept {
            let (channel, message) = robot.next_message().await;
            assert_eq!((channel, &*text(&message)), (output.channel, *expected));
            assert_eq!(robot.kept_count(output), Some(kept.len()), "{topic}");
        }
    }
}

const GOAL_ID: &str = r#"{"uuid":[1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16]}"#;

#[tokio::test]
async fn a_whole_goal_goes_through_a_link_by_the_parts_of_its_action() {
    let lab = Lab::new();
    let _server = lab.node("fibonacci.py", &["server"]).await;
    let bus = lab.join(NODE).await;
    let parts = ["send_goal", "get_result", "cancel_goal"].map(|part| format!("/fib/_action/{part}"));
    let (mut robot, graph) = connect_robot(&bus, "/lab/fibonacci", |graph| {
        let is_told = |part: &String| find_service(graph, part).is_some();
        parts.iter().all(is_told)
            && find_output(graph, "/fib/_action/feedback").is_some()
            && find_output(graph, "/fib/_action/status").is_some()
    })
    .await;
    let of = fibonacci();
    let services = of.services.as_ref().expect("an action of ROS 2");
    let feedback = find_output(&graph, "/fib/_action/feedback").unwrap();
    assert_eq!(feedback.md5, of.action_feedback.digest());
    let status = find_output(&graph, "/fib/_action/status").unwrap();
    assert!(status.qos.as_ref().is_some_and(|qos| qos.transient_local));
    robot.listen(feedback);
    let goal = format!(r#"{{"goal_id":{GOAL_ID},"goal":{{"order":5}}}}"#);
    let sent = cdr(&services.send_goal.request, &goal);
    let accepted = robot.call(find_service(&graph, &parts[0]).unwrap(), sent);
    let accepted = json(&services.send_goal.response, &accepted.await.unwrap());
    assert!(accepted.contains(r#""accepted":true"#), "{accepted}");
    let asked = format!(r#"{{"goal_id":{GOAL_ID}}}"#);
    let asked = cdr(&services.get_result.request, &asked);
    let result = robot.call(find_service(&graph, &parts[1]).unwrap(), asked);
    let result = json(&services.get_result.response, &result.await.unwrap());
    assert_eq!(result, r#"{"status":4,"result":{"sequence":[0,1,1,2,3,5]}}"#);
    let (channel, first) = robot.next_message().await;
    assert_eq!(channel, feedback.channel);
    let first: Value = serde_json::from_str(&json(&of.action_feedback, &first)).unwrap();
    assert_eq!(first["feedback"]["sequence"], value!([0, 1, 1]));
}

/// Waits for a call on the robot and answers it with what it was asked.
async fn answer_call(robot: &mut LinkedRobot, channel: u32) {
    loop {
        if let CloudRequest::Call(id, of, request) = robot.next_request().await {
            assert_eq!(of, channel);
            let asked: Value = serde_json::from_str(&json(&set_bool().request, &request)).unwrap();
            let answer = value!({"success": asked["data"], "message": "the robot"});
            let answer = cdr(&set_bool().response, &answer.to_string());
            return robot.session.answer(id, now(), Ok(answer));
        }
    }
}

async fn expect_lookup(robot: &mut LinkedRobot, wanted: &str) {
    loop {
        if let CloudRequest::Lookup(service) = robot.next_request().await {
            return assert_eq!(service, wanted);
        }
    }
}

#[tokio::test]
async fn a_service_that_is_looked_for_is_lent_until_it_is_gone_or_the_servant_has_its_own() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let (mut robot, _) = connect_robot(&bus, PEER, |graph| !graph.outputs.is_empty()).await;
    let of = set_bool_type();
    // Its client is seen, so the robot is asked before anything is called.
    expect_lookup(&mut robot, "/ask").await;
    robot.send_lent("/ask", Some((5, &of)));
    peer.tell("call true").await;
    answer_call(&mut robot, 5).await;
    assert_eq!(peer.wait_for("call").await, [value!(true), value!("the robot")]);
    let here = |graph: &ros::bus::Graph| graph.services.get("/ask").cloned();
    wait_graph(&bus, |graph| here(graph).as_deref() == Some(NODE)).await;
    // Once gone, it is looked up again for as long as there is a client.
    robot.send_lent("/ask", None);
    expect_lookup(&mut robot, "/ask").await;
    robot.send_lent("/ask", Some((6, &of)));
    peer.tell("call false").await;
    answer_call(&mut robot, 6).await;
    assert_eq!(peer.wait_for("call").await, [value!(false), value!("the robot")]);
    // The servant's own server takes precedence.
    let other = lab.join("/other").await;
    let _own = other.serve("/ask", of, Arc::new(CallerEchoService)).await.unwrap();
    wait_graph(&bus, |graph| here(graph).as_deref() == Some("/other")).await;
    // A request to the lent service at the moment of its removal is lost, as always in ROS 2.
    while peer.obey("servers_of /ask").await != [value!(["/other"])] {}
    let answer = peer.obey("call true").await;
    assert_eq!(answer, [value!(true), value!(PEER)]);
}

#[tokio::test]
async fn a_service_of_another_type_is_not_lent() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let (mut robot, _) = connect_robot(&bus, PEER, |graph| !graph.outputs.is_empty()).await;
    let other = ServiceType::new("std_srvs/srv/Trigger", "*").with_version(RosVersion::Two);
    expect_lookup(&mut robot, "/ask").await;
    robot.send_lent("/ask", Some((5, &other)));
    // It is looked up again, because another server may have appeared.
    expect_lookup(&mut robot, "/ask").await;
    assert!(!bus.graph().borrow().services.contains_key("/ask"));
}

/// Runs a robot with a bus of its own: what the cloud requests is looked up and called there, and what the node in the
/// cloud subscribes to is published there.
async fn run_robot(robot: &mut LinkedRobot, own: &Arc<Ros2Bus>, graph: &Graph) {
    let mut reading = tokio::task::JoinSet::new();
    let inputs = graph.inputs.iter().filter(|input| input.feed);
    for (channel, input) in (1..).zip(inputs) {
        let qos = QosProfile::keep_last(100).latching(input.qos.as_ref().is_some_and(|it| it.transient_local));
        let heard = own.subscribe(&input.topic, WireType::any(), qos).await;
        let heard = heard.expect("a subscription");
        robot.open_input(InputChannel {
            channel,
            topic: input.topic.clone(),
            type_name: input.type_name.clone(),
            md5: input.md5.clone(),
            latching: qos.is_latching(),
            ..InputChannel::default()
        });
        let session = Arc::clone(&robot.session);
        let number = channel;
        reading.spawn(async move {
            // As a whole: if it were destructured, its guard would stay behind and end the subscription.
            let heard = &mut { heard };
            while let Some(message) = heard.messages.recv().await {
                let data = link::record::Data {
                    channel: number,
                    encoded: false,
                    latching: message.latching,
                    born: now(),
                    left: 0,
                    serialise: 0,
                    answered: None,
                    message: message.bytes,
                };
                session.publish(data, link::DeliveryMode::Each);
            }
        });
    }
    let mut lent = Vec::new();
    while let Some(asked) = robot.asked.recv().await {
        match asked {
            CloudRequest::Lookup(service) => {
                let found = own.provider(&service).await.ok();
                lent.push(service.clone());
                let channel = u32::try_from(lent.len()).expect("few");
                let of = found.as_ref().map(|found| (channel, &found.service_type));
                robot.send_lent(&service, of);
            }
            CloudRequest::Call(id, channel, request) => {
                let (own, session) = (Arc::clone(own), Arc::clone(&robot.session));
                let service = lent[channel as usize - 1].clone();
                reading.spawn(async move {
                    let called = own.call(&service, request, LONG).await;
                    let called = called.map_err(|error| FailureReason::new(error.to_string()));
                    session.answer(id, now(), called);
                });
            }
        }
    }
}

#[tokio::test]
async fn a_node_in_the_cloud_sends_goals_to_a_server_on_the_robot() {
    let (cloud, field) = (Lab::new(), Lab::new());
    let _server = field.node("fibonacci.py", &["server"]).await;
    let own = field.join("/stub").await;
    wait_graph(&own, |graph| graph.actions.get("/fib").is_some_and(|action| !action.servers.is_empty())).await;
    let mut client = cloud.node("fibonacci.py", &["client"]).await;
    let bus = cloud.join(NODE).await;
    let (mut robot, graph) = connect_robot(&bus, "/lab/fibonacci", |graph| {
        let listened = |part: &str| {
            let topic = format!("/fib/_action/{part}");
            let mut inputs = graph.inputs.iter();
            inputs.any(|input| input.topic == topic && input.feed)
        };
        listened("feedback") && listened("status")
    })
    .await;
    let goals = async {
        assert_eq!(client.obey("there").await, [value!(true)]);
        client.tell("goal 20").await;
        let accepted = client.wait_for("goal").await;
        assert_eq!(accepted[0], value!(true));
        // The first of it may have arrived before.
        let feedback = client.wait_for("feedback").await;
        assert_eq!(feedback[0][2], value!(1), "{feedback:?}");
        let ended = client.wait_for("ended").await;
        let result = ended[1].as_array().map(Vec::len);
        assert_eq!((&ended[0], result), (&value!(4), Some(21)));
        client.tell("goal 1000").await;
        client.wait_for("goal").await;
        client.wait_for("feedback").await;
        client.tell("cancel").await;
        // They are reported by several threads.
        let [cancelled, ended] = client.wait_for_each(["cancel", "ended"]).await;
        assert_eq!((&cancelled[0], &ended[0]), (&value!(1), &value!(5)));
    };
    tokio::select! {
        () = goals => {}
        () = run_robot(&mut robot, &own, &graph) => panic!("the link has ended"),
    }
}

#[tokio::test]
async fn who_serves_and_how_it_calls_itself_is_seen() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let (one, other) = (lab.join("/one").await, lab.join("/other").await);
    one.set_label("vision for rover");
    let _serving = one.serve("/ask", set_bool_type(), Arc::new(CallerEchoService)).await.unwrap();
    wait_graph(&other, |graph| graph.services.contains_key("/ask") && graph.services.contains_key("/set")).await;
    let ours = one.provider("/ask").await.unwrap();
    let theirs = other.provider("/ask").await.unwrap();
    for found in [&ours, &theirs] {
        assert_eq!(found.node, "/one");
        assert_eq!(found.label.as_deref(), Some("vision for rover"));
        assert!(found.service_type.is_compatible_with(&set_bool_type()));
    }
    let plain = other.provider("/set").await.unwrap();
    assert_eq!((&*plain.node, plain.label), (PEER, None));
    assert!(other.provider("/nobody").await.is_err());
}

#[tokio::test]
async fn robots_of_an_unknown_ros_are_refused_and_names_that_ros_2_does_not_allow() {
    let lab = Lab::new();
    let bus = lab.join(NODE).await;
    let hub = hub(bus, Arc::new(RunTracker::default()), &[]);
    let of_three = Hello { ros: 3, ..hello("/see") };
    let (reason, again) = expect_refusal(&hub, &of_three).await;
    assert!(!again && reason.contains("uses ROS 3"), "{reason}");
    // In ROS 2, each part of a name begins with a letter: whatever the robot's ROS.
    for ros in [1, 2] {
        let (reason, _) = expect_refusal(&hub, &Hello { ros, ..hello("/2see") }).await;
        assert!(reason.contains("not an absolute node name of ROS 2"), "{reason}");
    }
}

#[tokio::test]
async fn a_node_goes_on_when_another_daemon_takes_its_link_up() {
    let lab = Lab::new();
    let nodes = Arc::new(RunTracker::default());
    let begins = async |run: &str| {
        let bus = lab.join(NODE).await;
        let hub = hub(bus, Arc::clone(&nodes) as _, &[]);
        let hello = Hello { run: run.to_owned(), ..hello("/see") };
        let robot = timeout(LONG, LinkedRobot::connect(&hub, &hello)).await;
        robot.expect("a link");
        nodes.starts("/see")
    };
    assert_eq!(begins("one life").await, 1);
    assert_eq!(begins("one life").await, 1);
    assert_eq!(begins("another life").await, 2);
}
