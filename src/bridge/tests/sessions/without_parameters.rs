//! A ROS whose nodes share no parameters.

use serde_json::json;

use super::rosapi::ask;
use super::support::World;

#[tokio::test]
async fn parameters_that_no_ros_shares_are_refused_in_words() {
    let world = World::new().await;
    let mut client = world.client().await;
    for service in [
        "get_param",
        "set_param",
        "has_param",
        "search_param",
        "delete_param",
        "get_param_names",
    ] {
        let args = json!({"name": "/rate", "value": "1"});
        client
            .send(json!({"op": "call_service", "service": format!("/rosapi/{service}"), "args": args}))
            .await;
        let answer = client.json().await;
        assert_eq!(answer["result"], false, "{answer}");
        assert_eq!(
            answer["values"],
            "global parameters are not offered by this ROS"
        );
    }
    // What is asked of them besides has another answer.
    let time = ask(&mut client, "get_time", json!({})).await;
    assert!(time["time"]["secs"].as_u64().unwrap() > 1_500_000_000);
    let version = ask(&mut client, "get_ros_version", json!({})).await;
    assert_eq!(version, json!({"version": 2, "distro": "memory"}));
}
