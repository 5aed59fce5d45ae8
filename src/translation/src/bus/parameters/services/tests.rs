use async_trait::async_trait;
use ros::bus::{
    DoubleRange, IntegerRange, ParamChange, ParamValue, ParameterDescription, ParameterEvents, ParameterKind,
    ParameterNames,
};
use ros::codec::{FillOptions, JsonOptions, from_json, to_json};
use ros::schema::{Registry, ServiceDef};
use serde_json::{Value, json};

use super::*;

/// A node `/see` whose parameter `gain` takes no negative values.
struct SeeingNode;

#[async_trait]
impl NodeParameters for SeeingNode {
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError> {
        assert_eq!(node, "/see");
        let value = |name: &String| match &**name {
            "gain" => Some(ParamValue::Double(0.5)),
            "names" => Some(ParamValue::List(vec![ParamValue::String("a".to_owned())])),
            "none" => Some(ParamValue::List(Vec::new())),
            _ => None,
        };
        Ok(names.iter().map(value).collect())
    }

    async fn set(&self, _: &str, changes: Vec<ParamChange>) -> Result<Vec<Result<(), FailureReason>>, BusError> {
        let set = |(_, value): ParamChange| match value {
            Some(ParamValue::Double(gain)) if gain >= 0.0 => Ok(()),
            other => Err(FailureReason::new(format!("{other:?} is no gain"))),
        };
        Ok(changes.into_iter().map(set).collect())
    }

    async fn set_atomically(&self, node: &str, changes: Vec<ParamChange>) -> Result<(), BusError> {
        let reason = self.set(node, changes).await?.into_iter().find_map(Result::err);
        reason.map_or(Ok(()), |reason| Err(BusError::BadParam { key: "gain".to_owned(), reason: reason.into_string() }))
    }

    async fn list(&self, _: &str, prefixes: &[String], depth: u64) -> Result<ParameterNames, BusError> {
        assert_eq!((prefixes, depth), (&["a".to_owned()][..], 2));
        Ok(ParameterNames { names: vec!["a.b".to_owned()], prefixes: vec!["a".to_owned()] })
    }

    async fn describe(&self, _: &str, names: &[String]) -> Result<Vec<Option<ParameterDescription>>, BusError> {
        let describe = |name: &String| {
            (name == "gain").then(|| ParameterDescription {
                name: name.clone(),
                kind: ParameterKind::Double,
                description: "how much".to_owned(),
                constraints: "not less than nothing".to_owned(),
                read_only: true,
                dynamic_typing: false,
                double_range: Some(DoubleRange { from: 0.0, to: 1.5, step: 0.5 }),
                integer_range: Some(IntegerRange { from: -1, to: 1, step: 2 }),
            })
        };
        Ok(names.iter().map(describe).collect())
    }

    async fn watch(&self, _: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError> {
        Err(BusError::NotOffered("events"))
    }
}

/// Returns the definitions of the services as the package `rcl_interfaces` has them.
fn definition(of: &str) -> std::sync::Arc<ServiceDef> {
    let registry = Registry::for_version(ros::bus::RosVersion::Two);
    for (key, text) in [
        (
            "rcl_interfaces/msg/ParameterValue",
            "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\n\
             byte[] byte_array_value\nbool[] bool_array_value\nint64[] integer_array_value\n\
             float64[] double_array_value\nstring[] string_array_value\n",
        ),
        ("rcl_interfaces/msg/Parameter", "string name\nParameterValue value\n"),
        ("rcl_interfaces/msg/FloatingPointRange", "float64 from_value\nfloat64 to_value\nfloat64 step\n"),
        ("rcl_interfaces/msg/IntegerRange", "int64 from_value\nint64 to_value\nuint64 step\n"),
        (
            "rcl_interfaces/msg/ParameterDescriptor",
            "string name\nuint8 type\nstring description\nstring additional_constraints\nbool read_only false\n\
             bool dynamic_typing false\nFloatingPointRange[<=1] floating_point_range\n\
             IntegerRange[<=1] integer_range\n",
        ),
        ("rcl_interfaces/msg/ListParametersResult", "string[] names\nstring[] prefixes\n"),
        ("rcl_interfaces/msg/SetParametersResult", "bool successful\nstring reason\n"),
        ("rcl_interfaces/srv/GetParameters", "string[] names\n---\nParameterValue[] values\n"),
        ("rcl_interfaces/srv/GetParameterTypes", "string[] names\n---\nuint8[] types\n"),
        ("rcl_interfaces/srv/SetParameters", "Parameter[] parameters\n---\nSetParametersResult[] results\n"),
        ("rcl_interfaces/srv/SetParametersAtomically", "Parameter[] parameters\n---\nSetParametersResult result\n"),
        ("rcl_interfaces/srv/ListParameters", "string[] prefixes\nuint64 depth\n---\nListParametersResult result\n"),
        ("rcl_interfaces/srv/DescribeParameters", "string[] names\n---\nParameterDescriptor[] descriptors\n"),
    ] {
        registry.insert(key, text).expect(key);
    }
    registry.service(&format!("rcl_interfaces/srv/{of}")).expect(of)
}

/// Calls a service of `/see` with a request in JSON; returns the response in JSON.
async fn call(name: &str, request: Value) -> Value {
    let service = format!("/see/{name}");
    let (_, _, of) = split_name(&service).expect("a service");
    let def = definition(of);
    assert_eq!(ServiceType::from_service(&def), service_type(of).expect("a type"));
    let mut bytes = Vec::new();
    from_json(&def.request, request.to_string().as_bytes(), &mut bytes, &FillOptions::default()).expect("a request");
    let response = ParameterServices::call(&SeeingNode, &service, &bytes).await.expect("a response");
    let mut json = Vec::new();
    to_json(&def.response, &response, &mut json, &JsonOptions::default()).expect("a response");
    serde_json::from_slice(&json).expect("JSON")
}

#[tokio::test]
async fn parameters_are_read_by_their_services() {
    let values = call("get_parameters", json!({"names": ["gain", "missing", "names", "none"]})).await;
    let values = values["values"].as_array().expect("a list");
    let kinds: Vec<_> = values.iter().map(|value| value["type"].clone()).collect();
    assert_eq!(kinds, [3, 0, 9, 0]);
    assert_eq!((&values[0]["double_value"], &values[2]["string_array_value"]), (&json!(0.5), &json!(["a"])));
    let listed = call("list_parameters", json!({"prefixes": ["a"], "depth": 2})).await;
    assert_eq!(listed, json!({"result": {"names": ["a.b"], "prefixes": ["a"]}}));
    // The codec writes bytes as base64.
    assert_eq!(call("get_parameter_types", json!({"names": ["gain", "missing"]})).await, json!({"types": "AwA="}));
    let described = call("describe_parameters", json!({"names": ["gain", "missing"]})).await;
    assert_eq!(
        described["descriptors"][0],
        json!({"name": "gain", "type": 3, "description": "how much",
            "additional_constraints": "not less than nothing", "read_only": true, "dynamic_typing": false,
            "floating_point_range": [{"from_value": 0.0, "to_value": 1.5, "step": 0.5}],
            "integer_range": [{"from_value": -1, "to_value": 1, "step": 2}]})
    );
    assert_eq!(
        (&described["descriptors"][1]["name"], &described["descriptors"][1]["type"]),
        (&json!("missing"), &json!(0))
    );
}

#[tokio::test]
async fn parameters_are_set_by_their_services_or_refused_with_the_reason() {
    let gain = |gain: f64| json!({"name": "gain", "value": {"type": 3, "double_value": gain}});
    let refused = json!({"successful": false, "reason": "Some(Double(-1.0)) is no gain"});
    let set = call("set_parameters", json!({"parameters": [gain(1.0), gain(-1.0), {"name": "gain"}]})).await;
    assert_eq!(set["results"][0], json!({"successful": true, "reason": ""}));
    assert_eq!((&set["results"][1], &set["results"][2]["reason"]), (&refused, &json!("None is no gain")));
    let set = call("set_parameters_atomically", json!({"parameters": [gain(1.0)]})).await;
    assert_eq!(set, json!({"result": {"successful": true, "reason": ""}}));
    let set = call("set_parameters_atomically", json!({"parameters": [gain(1.0), gain(-1.0)]})).await;
    assert_eq!(set["result"]["reason"], "gain: Some(Double(-1.0)) is no gain");
}

#[tokio::test]
async fn a_request_that_is_none_is_refused() {
    for request in [&b""[..], b"\0\x01\0\0", b"\0\x01\0\0\xff\xff\xff\xff"] {
        for (_, name, _) in SERVICES {
            let service = format!("/see/{name}");
            let refused = ParameterServices::call(&SeeingNode, &service, request).await.expect_err(name);
            assert!(refused.to_string().contains("truncated or too long"), "{refused}");
        }
    }
    let other = ParameterServices::call(&SeeingNode, "/see/add", b"").await.expect_err("none of them");
    assert!(matches!(other, BusError::NoService(_)), "{other}");
}

#[test]
fn every_node_has_six_of_them() {
    let graph = Graph { nodes: [("/see".to_owned(), String::new())].into(), ..Graph::default() };
    let all = ParameterServices::of_node("/see").expect("types");
    assert_eq!(all.len(), 6);
    for (service, of) in all {
        assert_eq!(ParameterServices::find_type(&graph, &service).expect("one of them").expect("a type"), of);
    }
    for other in ["/seen/get_parameters", "/see/get", "/get_parameters", "get_parameters", ""] {
        assert!(ParameterServices::find_type(&graph, other).is_none(), "{other}");
    }
}
