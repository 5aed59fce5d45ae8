//! Parameters that all nodes share, as ROS 1 has them.

use serde_json::{Value, json};

use super::rosapi::{ask, holds};
use super::support::World;

#[tokio::test]
async fn parameters_are_set_found_and_deleted() {
    let world = World::new().await;
    let mut client = world.client().await;
    for value in [
        json!(5),
        json!(1.5),
        json!("text"),
        json!([1, "a", true]),
        json!({"x": {"y": 2}}),
    ] {
        let set = json!({"name": "/p/q", "value": value.to_string()});
        assert_eq!(ask(&mut client, "set_param", set).await, json!({}));
        let got = ask(&mut client, "get_param", json!({"name": "p/q"})).await;
        assert_eq!(
            serde_json::from_str::<Value>(got["value"].as_str().unwrap()).unwrap(),
            value
        );
    }
    assert_eq!(
        ask(&mut client, "has_param", json!({"name": "/p/q/x/y"})).await,
        json!({"exists": true})
    );
    let found = ask(&mut client, "search_param", json!({"name": "p"})).await;
    assert_eq!(found, json!({"global_name": "/p"}));
    assert!(holds(
        &ask(&mut client, "get_param_names", json!({})).await["names"],
        "/p/q/x/y"
    ));
    assert_eq!(
        ask(&mut client, "delete_param", json!({"name": "/p"})).await,
        json!({})
    );
    assert_eq!(
        ask(&mut client, "delete_param", json!({"name": "/p"})).await,
        json!({})
    );
    assert_eq!(
        ask(&mut client, "has_param", json!({"name": "/p/q"})).await,
        json!({"exists": false})
    );
    assert_eq!(
        ask(&mut client, "get_param", json!({"name": "/p"})).await,
        json!({"value": "null"})
    );
    let get = json!({"name": "/p", "default": "7"});
    assert_eq!(
        ask(&mut client, "get_param", get).await,
        json!({"value": "7"})
    );
    let get = json!({"name": "/p", "default": "seven"});
    assert_eq!(
        ask(&mut client, "get_param", get).await,
        json!({"value": "\"seven\""})
    );
}
