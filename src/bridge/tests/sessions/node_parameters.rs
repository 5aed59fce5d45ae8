//! Parameters that belong to nodes, as in ROS 2.

use ros::bus::{Bus, ParamValue};
use serde_json::{Value, json};

use super::rosapi::ask;
use super::support::World;

/// Sets parameters of the node.
async fn declare(world: &World, parameters: &[(&str, ParamValue)]) {
    let changes = parameters.iter();
    let changes = changes.map(|(name, value)| ((*name).to_owned(), Some(value.clone())));
    let node = Bus::node_parameters(&*world.node).unwrap();
    let done = node.set("/node", changes.collect()).await.unwrap();
    assert!(done.iter().all(Result::is_ok), "{done:?}");
}

fn parse_value(answer: &Value) -> Value {
    serde_json::from_str(answer["value"].as_str().unwrap()).unwrap()
}

#[tokio::test]
async fn parameters_are_those_of_nodes() {
    let world = World::new().await;
    let exposures = ParamValue::List(vec![ParamValue::Int(1), ParamValue::Int(2)]);
    declare(
        &world,
        &[
            ("rate", ParamValue::Double(1.5)),
            ("camera.exposures", exposures),
            ("frame", ParamValue::String("map".to_owned())),
        ],
    )
    .await;
    let mut client = world.client().await;
    for (name, value) in [
        ("/node:rate", json!(1.5)),
        // In the format of ROS 2's tools.
        ("node:camera.exposures", json!([1, 2])),
        ("/node:frame", json!("map")),
    ] {
        let got = ask(&mut client, "get_param", json!({"name": name})).await;
        assert_eq!(parse_value(&got), value);
        assert_eq!((&got["successful"], &got["reason"]), (&json!(true), &json!("")));
        let has = ask(&mut client, "has_param", json!({"name": name})).await;
        assert_eq!(has, json!({"exists": true}));
    }
    let names = ask(&mut client, "get_param_names", json!({})).await;
    assert_eq!(names, json!({"names": ["/node:camera.exposures", "/node:frame", "/node:rate"]}));
    // JavaScript writes 5.0 like this.
    let set = json!({"name": "/node:rate", "value": "5"});
    let done = json!({"successful": true, "reason": ""});
    assert_eq!(ask(&mut client, "set_param", set).await, done);
    let got = ask(&mut client, "get_param", json!({"name": "/node:rate"})).await;
    assert_eq!(got["value"], "5.0");
    for _ in 0..2 {
        let delete = json!({"name": "/node:rate"});
        assert_eq!(ask(&mut client, "delete_param", delete.clone()).await, done);
        let has = ask(&mut client, "has_param", delete).await;
        assert_eq!(has, json!({"exists": false}));
    }
}

#[tokio::test]
async fn what_is_not_there_is_said_and_has_its_default() {
    let world = World::new().await;
    declare(&world, &[("rate", ParamValue::Int(1))]).await;
    let mut client = world.client().await;
    for (name, reason) in [
        ("/node:none", "node /node has no parameter none"),
        ("/gone:rate", "there is no node /gone; /rosapi/nodes lists the existing ones"),
    ] {
        let got = ask(&mut client, "get_param", json!({"name": name})).await;
        assert_eq!(got, json!({"value": "null", "successful": false, "reason": reason}));
        for (default, value) in [("7", "7"), ("seven", "\"seven\"")] {
            let get = json!({"name": name, "default_value": default});
            assert_eq!(ask(&mut client, "get_param", get).await["value"], value);
        }
        let has = ask(&mut client, "has_param", json!({"name": name})).await;
        assert_eq!(has, json!({"exists": false}));
    }
}

#[tokio::test]
async fn what_cannot_be_done_with_a_parameter_is_answered_with_the_reason() {
    let world = World::new().await;
    declare(&world, &[("rate", ParamValue::Int(1))]).await;
    let mut client = world.client().await;
    for (service, args, reason) in [
        (
            "set_param",
            json!({"name": "/node:rate", "value": "\"fast\""}),
            "node /node refuses rate: it is of another kind",
        ),
        ("set_param", json!({"name": "/gone:rate", "value": "1"}), "service /gone/get_parameters has no server"),
        (
            "get_param",
            json!({"name": "/node/rate"}),
            "field \"name\" is \"/node/rate\", a node and its parameter such as \"/camera:exposure\" is expected",
        ),
        (
            "has_param",
            json!({"name": "/node:"}),
            "field \"name\" is \"/node:\", a node and its parameter such as \"/camera:exposure\" is expected",
        ),
        (
            "get_param",
            json!({}),
            "field \"name\" is missing, a node and its parameter such as \"/camera:exposure\" is expected",
        ),
        ("search_param", json!({"name": "rate"}), "global parameters are not offered by this version of ROS"),
    ] {
        client.send(json!({"op": "call_service", "service": format!("/rosapi/{service}"), "args": args})).await;
        let answer = client.json().await;
        assert_eq!(answer["result"], false, "{answer}");
        assert_eq!(answer["values"], reason);
    }
}
