//! Nodes that return less than requested, or unreadable answers. Well-behaved nodes are tested with real ones.

use std::sync::Arc;

use bytes::Bytes;
use ros_bus::ServiceHandler;
use ros_message::codec::{from_json, to_json};
use ros_message::schema::MessageType;

use super::super::*;
use crate::testing::join;

/// Gives each request the next of the prepared answers, and records the requests.
struct Says {
    answer: Box<dyn Fn(&str) -> Bytes + Send + Sync>,
    request: Arc<MessageType>,
}

#[async_trait]
impl ServiceHandler for Says {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let mut json = Vec::new();
        to_json(&self.request, &request, &mut json, &Default::default()).unwrap();
        Ok((self.answer)(&String::from_utf8(json).unwrap()))
    }
}

/// A service `/odd/PART` with these answers to requests, as JSON.
async fn odd(
    bus: &Ros2Bus,
    part: &str,
    of: &str,
    answer: impl Fn(&str) -> Bytes + Send + Sync + 'static,
) -> Box<dyn Send + Sync> {
    let request = interfaces::message(&format!("rcl_interfaces/srv/{of}_Request")).unwrap();
    let of = interfaces::service(&format!("rcl_interfaces/srv/{of}")).unwrap();
    let answer = Box::new(answer);
    let handler = Arc::new(Says { answer, request });
    bus.serve(&format!("/odd/{part}"), of, handler).await.unwrap()
}

fn response(of: &str, json: &str) -> Bytes {
    let of = interfaces::message(&format!("rcl_interfaces/srv/{of}_Response")).unwrap();
    let mut bytes = Vec::new();
    from_json(&of, json.as_bytes(), &mut bytes, &Default::default()).unwrap();
    bytes.into()
}

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[tokio::test]
async fn a_node_that_answers_nothing_because_it_lacks_one_is_asked_one_by_one() {
    let bus = join(81, "/asker").await;
    let _node = odd(&bus, "get_parameters", "GetParameters", |request| {
        let json = match request {
            r#"{"names":["a"]}"# => r#"{"values":[{"type":2,"integer_value":7}]}"#,
            r#"{"names":["unset"]}"# => r#"{"values":[{}]}"#,
            r#"{"names":[]}"# | r#"{"names":["b"]}"# | r#"{"names":["a","b","unset"]}"# => "{}",
            other => panic!("{other}"),
        };
        response("GetParameters", json)
    })
    .await;
    let asked = names(&["a", "b", "unset"]);
    let values = bus.get("/odd", &asked).await.unwrap();
    assert_eq!(values, [Some(ParamValue::Int(7)), None, None]);
    assert_eq!(bus.get("/odd", &names(&["b"])).await.unwrap(), [None]);
    assert!(bus.get("/odd", &[]).await.unwrap().is_empty());
}

#[tokio::test]
async fn answers_that_are_torn_or_too_few_are_the_nodes_fault() {
    let bus = join(82, "/asker").await;
    let torn = |_: &str| Bytes::from_static(&[0, 1, 0, 0, 9, 0, 0, 0, 1]);
    let _node = (
        odd(&bus, "get_parameters", "GetParameters", torn).await,
        odd(&bus, "list_parameters", "ListParameters", torn).await,
        odd(&bus, "describe_parameters", "DescribeParameters", torn).await,
        odd(&bus, "set_parameters", "SetParameters", |_| {
            response("SetParameters", r#"{"results":[{"successful":true}]}"#)
        })
        .await,
        odd(&bus, "set_parameters_atomically", "SetParametersAtomically", |_| {
            response("SetParametersAtomically", "{}")
        })
        .await,
    );
    let some = names(&["a"]);
    let broken = |error: BusError| {
        assert!(matches!(error, BusError::Protocol { .. }), "{error}");
        error.to_string()
    };
    assert_eq!(
        broken(bus.get("/odd", &some).await.unwrap_err()),
        "service /odd/get_parameters broke the protocol: its answer is truncated or too long"
    );
    broken(bus.list("/odd", &[], 0).await.unwrap_err());
    broken(bus.describe("/odd", &some).await.unwrap_err());
    let change = |key: &str| (key.to_owned(), Some(ParamValue::Bool(true)));
    let both = vec![change("a"), change("b")];
    broken(bus.set("/odd", both).await.unwrap_err());
    assert_eq!(bus.set("/odd", vec![change("a")]).await.unwrap(), [Ok(())]);
    let refused = bus.set_atomically("/odd", vec![change("a")]).await.unwrap_err();
    assert_eq!(refused.to_string(), "service /odd/set_parameters_atomically failed: the node does not say why");
}

#[tokio::test]
async fn what_cannot_be_sent_is_not_and_the_rest_is() {
    let bus = join(83, "/asker").await;
    let _node = (
        odd(&bus, "get_parameter_types", "GetParameterTypes", |request| {
            assert_eq!(request, r#"{"names":["list","rate"]}"#);
            response("GetParameterTypes", r#"{"types":[0,3]}"#)
        })
        .await,
        odd(&bus, "set_parameters", "SetParameters", |request| {
            assert!(request.contains(r#""name":"rate","value":{"type":3,"#), "{request}");
            assert!(request.contains(r#""name":"gone","value":{"type":0,"#), "{request}");
            assert!(!request.contains("list"), "{request}");
            let json = r#"{"results":[{"reason":"no"},{"successful":true}]}"#;
            response("SetParameters", json)
        })
        .await,
    );
    let changes = vec![
        ("list".to_owned(), Some(ParamValue::List(vec![]))),
        ("rate".to_owned(), Some(ParamValue::Int(2))),
        ("gone".to_owned(), None),
    ];
    let set = bus.set("/odd", changes.clone()).await.unwrap();
    let empty = "an empty list does not say what it is a list of";
    let refused = |reason| Err(FailureReason::new(reason));
    assert_eq!(set, [refused(empty), refused("no"), Ok(())]);
    match bus.set_atomically("/odd", changes).await.unwrap_err() {
        BusError::BadParam { key, reason } => assert_eq!((&*key, &*reason), ("list", empty)),
        other => panic!("{other}"),
    }
}
