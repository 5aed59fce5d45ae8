//! Parameters shared by all nodes, as in ROS 1.

use bridge::SessionOptions;
use budget::Budget;
use serde_json::{Value, json};

use super::rosapi::{ask, holds};
use super::support::{Client, World};

#[tokio::test]
async fn parameters_are_set_found_and_deleted() {
    let world = World::new().await;
    let mut client = world.client().await;
    for value in [json!(5), json!(1.5), json!("text"), json!([1, "a", true]), json!({"x": {"y": 2}})] {
        let set = json!({"name": "/p/q", "value": value.to_string()});
        assert_eq!(ask(&mut client, "set_param", set).await, json!({}));
        let got = ask(&mut client, "get_param", json!({"name": "p/q"})).await;
        assert_eq!(serde_json::from_str::<Value>(got["value"].as_str().unwrap()).unwrap(), value);
    }
    assert_eq!(ask(&mut client, "has_param", json!({"name": "/p/q/x/y"})).await, json!({"exists": true}));
    let found = ask(&mut client, "search_param", json!({"name": "p"})).await;
    assert_eq!(found, json!({"global_name": "/p"}));
    assert!(holds(&ask(&mut client, "get_param_names", json!({})).await["names"], "/p/q/x/y"));
    assert_eq!(ask(&mut client, "delete_param", json!({"name": "/p"})).await, json!({}));
    assert_eq!(ask(&mut client, "delete_param", json!({"name": "/p"})).await, json!({}));
    assert_eq!(ask(&mut client, "has_param", json!({"name": "/p/q"})).await, json!({"exists": false}));
    assert_eq!(ask(&mut client, "get_param", json!({"name": "/p"})).await, json!({"value": "null"}));
    let get = json!({"name": "/p", "default": "7"});
    assert_eq!(ask(&mut client, "get_param", get).await, json!({"value": "7"}));
    let get = json!({"name": "/p", "default": "seven"});
    assert_eq!(ask(&mut client, "get_param", get).await, json!({"value": "\"seven\""}));
}

/// Returns the error of a failed call of a rosapi service.
async fn call_refused(client: &mut Client, service: &str, args: Value) -> String {
    let service = format!("/rosapi/{service}");
    let call = json!({"op": "call_service", "service": service, "args": args});
    client.send(call).await;
    let answer = client.json().await;
    assert_eq!(answer["result"], false, "{answer}");
    answer["values"].as_str().expect("a reason").to_owned()
}

#[tokio::test]
async fn what_a_parameter_becomes_counts_in_the_clients_budget() {
    let world = World::new().await;
    let budget = Budget::new("client x", 32 << 20);
    let options = SessionOptions { budget: budget.clone(), ..SessionOptions::default() };
    let mut client = world.client_with(options).await;
    // A hundred kilobytes that take megabytes when parsed.
    let maps = |count: usize| format!("[{}1]", r#"{"a":1},"#.repeat(count));
    let set = json!({"name": "/p", "value": maps(10_000)});
    assert_eq!(ask(&mut client, "set_param", set).await, json!({}));
    // A megabyte that would take a hundred of them.
    let set = json!({"name": "/p", "value": maps(120_000)});
    let words = call_refused(&mut client, "set_param", set).await;
    assert!(words.contains("the memory for client x"), "{words}");
    let get = json!({"name": "/none", "default": "1".repeat(2 << 20)});
    let words = call_refused(&mut client, "get_param", get).await;
    assert!(words.contains("at most 1048576 are taken"), "{words}");
    assert_eq!(ask(&mut client, "has_param", json!({"name": "/p"})).await, json!({"exists": true}));
}
