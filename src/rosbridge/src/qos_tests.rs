use super::*;
use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};
use crate::{Advertise, Publish, Subscribe};

fn subscribe_op(qos: QosRequest) -> Subscribe<'static> {
    Subscribe {
        id: None,
        topic: "/x".into(),
        type_name: None,
        throttle_rate: Duration::ZERO,
        queue_length: 0,
        fragment_size: None,
        compression: crate::Compression::None,
        qos: Some(qos),
    }
}

/// Returns the JSON of a subscription to `/x` with this `qos`.
fn subscribe_json(qos: &str) -> String {
    format!(r#"{{"op":"subscribe","topic":"/x","qos":{qos}}}"#)
}

#[track_caller]
fn assert_qos(qos: &str, meant: QosRequest) {
    assert_parses(&subscribe_json(qos), subscribe_op(meant));
    assert_survives_cbor(subscribe_op(meant));
}

fn all() -> QosRequest {
    QosRequest {
        history: Some(HistoryPolicy::KeepLast),
        depth: Some(5),
        reliability: Some(ReliabilityPolicy::BestEffort),
        durability: Some(DurabilityPolicy::TransientLocal),
        deadline: Some(Period::Of(Duration::from_millis(1500))),
        lifespan: Some(Period::Infinite),
        liveliness: Some(LivelinessPolicy::ManualByTopic),
        liveliness_lease_duration: Some(Period::Of(Duration::new(2, 3))),
    }
}

#[test]
fn policies_are_words_or_numbers() {
    assert_qos(
        r#"{"history":"keep_last","depth":5,"reliability":"best_effort","durability":"transient_local","deadline":1.5,
            "lifespan":"infinite","liveliness":"manual_by_topic","liveliness_lease_duration":{"sec":2,"nanosec":3},
            "avoid_ros_namespace_conventions":false}"#,
        all(),
    );
    assert_qos(
        r#"{"history":1,"depth":5.0,"reliability":2,"durability":1,"deadline":{"secs":1,"nsecs":500000000},
            "lifespan":1e300,"liveliness":3,"liveliness_lease_duration":{"sec":2,"nsec":3}}"#,
        all(),
    );
    assert_qos(
        r#"{"history":"KEEP_ALL","reliability":"Reliable","durability":"VOLATILE"}"#,
        QosRequest {
            history: Some(HistoryPolicy::KeepAll),
            reliability: Some(ReliabilityPolicy::Reliable),
            durability: Some(DurabilityPolicy::Volatile),
            ..QosRequest::default()
        },
    );
    assert_qos(
        r#"{"reliability":4,"durability":"best_available","deadline":"best_available","liveliness":5,
            "liveliness_lease_duration":"best_available"}"#,
        QosRequest {
            reliability: Some(ReliabilityPolicy::BestAvailable),
            durability: Some(DurabilityPolicy::BestAvailable),
            deadline: Some(Period::BestAvailable),
            liveliness: Some(LivelinessPolicy::BestAvailable),
            liveliness_lease_duration: Some(Period::BestAvailable),
            ..QosRequest::default()
        },
    );
}

#[test]
fn what_says_nothing_leaves_the_choice_to_the_server() {
    assert_qos("{}", QosRequest::default());
    assert_qos(
        r#"{"history":0,"depth":0,"reliability":"system_default","durability":null,"deadline":0,
            "lifespan":{"sec":0,"nanosec":0},"liveliness":"System_Default"}"#,
        QosRequest::default(),
    );
    let none = Subscribe { qos: None, ..subscribe_op(QosRequest::default()) };
    assert_parses(&subscribe_json("null"), none);
}

#[test]
fn the_longest_times_are_without_end() {
    for long in [
        "9223372036",
        r#"{"sec":9223372036,"nanosec":854775807}"#,
        r#"{"sec":9223372036854775807,"nanosec":9223372036854775807}"#,
    ] {
        let qos = format!(r#"{{"deadline":{long}}}"#);
        assert_qos(&qos, QosRequest { deadline: Some(Period::Infinite), ..QosRequest::default() });
    }
    // The largest value that can be written.
    assert_qos(
        r#"{"depth":9000000000000000000}"#,
        QosRequest { depth: Some(9_000_000_000_000_000_000), ..QosRequest::default() },
    );
}

#[test]
fn what_cannot_be_meant_is_named_with_what_can() {
    let seconds = "a number of seconds, {\"sec\": 0, \"nanosec\": 0} or infinite, is expected";
    let or_best = "a number of seconds, {\"sec\": 0, \"nanosec\": 0}, infinite or best_available is expected";
    let reliability = "reliable (1), best_effort (2), best_available (4) or system_default (0) is expected";
    let durability = "transient_local (1), volatile (2), best_available (4) or system_default (0) is expected";
    for (key, value, expected) in [
        ("history", r#""keep_some""#, "keep_last (1), keep_all (2) or system_default (0) is expected"),
        ("history", "3", "keep_last (1), keep_all (2) or system_default (0) is expected"),
        ("depth", "-1", "a number of messages, 0 or more, is expected"),
        ("depth", "1.5", "a number of messages, 0 or more, is expected"),
        ("depth", r#""5""#, "a number of messages, 0 or more, is expected"),
        ("reliability", r#""best-effort""#, reliability),
        ("reliability", "3", reliability),
        ("reliability", "true", reliability),
        ("durability", r#""persistent""#, durability),
        ("durability", "[1]", durability),
        ("liveliness", "2", "automatic (1), manual_by_topic (3), best_available (5) or system_default (0) is expected"),
        ("deadline", "-0.5", or_best),
        ("deadline", r#""soon""#, or_best),
        ("deadline", r#"{"sec":1}"#, or_best),
        ("lifespan", r#"{"sec":-1,"nanosec":0}"#, seconds),
        ("lifespan", r#""best_available""#, seconds),
        ("avoid_ros_namespace_conventions", "true", "false (names are those of ROS) is expected"),
    ] {
        assert_refused(
            &subscribe_json(&format!(r#"{{"{key}":{value}}}"#)),
            &format!("subscribe: field \"qos.{key}\" is {value}, {expected}"),
        );
    }
    let object = "an object such as {\"reliability\": \"best_effort\", \"depth\": 5} is expected";
    for value in [r#""best_effort""#, "5", r#"{"depth" 5}"#, "[]"] {
        assert_refused(&subscribe_json(value), &format!("subscribe: field \"qos\" is {value}, {object}"));
    }
}

#[test]
fn publishers_say_what_they_offer() {
    let qos = Some(QosRequest {
        durability: Some(DurabilityPolicy::TransientLocal),
        depth: Some(1),
        ..QosRequest::default()
    });
    let advertise = Advertise {
        id: None,
        topic: "/x".into(),
        type_name: "a/B".into(),
        latch: false,
        queue_size: None,
        md5sum: None,
        qos,
    };
    assert_parses(
        r#"{"op":"advertise","topic":"/x","type":"a/B","qos":{"durability":"transient_local","depth":1}}"#,
        advertise.clone(),
    );
    assert_survives_cbor(advertise);
    let publish = Publish {
        id: None,
        topic: "/x".into(),
        msg: Payload::json("{}"),
        compression: crate::Compression::None,
        latch: false,
        type_name: None,
        qos,
    };
    assert_parses(r#"{"op":"publish","topic":"/x","msg":{},"qos":{"durability":1,"depth":1}}"#, publish);
    assert_refused(
        r#"{"op":"publish","topic":"/x","msg":{},"qos":{"depth":{}}}"#,
        "publish: field \"qos.depth\" is {}, a number of messages, 0 or more, is expected",
    );
    assert_refused(
        r#"{"op":"advertise","topic":"/x","type":"a/B","qos":7}"#,
        "advertise: field \"qos\" is 7, an object such as {\"reliability\": \"best_effort\", \"depth\": 5} is expected",
    );
}
