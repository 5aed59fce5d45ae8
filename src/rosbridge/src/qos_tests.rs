use super::*;
use crate::op::tests::{reads, refuses, survives_cbor};
use crate::{Advertise, Publish, Subscribe};

fn subscribed(qos: Qos) -> Subscribe<'static> {
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

/// A subscription to `/x` with this `qos`.
fn with(qos: &str) -> String {
    format!(r#"{{"op":"subscribe","topic":"/x","qos":{qos}}}"#)
}

#[track_caller]
fn means(qos: &str, meant: Qos) {
    reads(&with(qos), subscribed(meant));
    survives_cbor(subscribed(meant));
}

fn all() -> Qos {
    Qos {
        history: Some(History::KeepLast),
        depth: Some(5),
        reliability: Some(Reliability::BestEffort),
        durability: Some(Durability::TransientLocal),
        deadline: Some(Period::Of(Duration::from_millis(1500))),
        lifespan: Some(Period::Infinite),
        liveliness: Some(Liveliness::ManualByTopic),
        liveliness_lease_duration: Some(Period::Of(Duration::new(2, 3))),
    }
}

#[test]
fn policies_are_words_or_numbers() {
    means(
        r#"{"history":"keep_last","depth":5,"reliability":"best_effort","durability":"transient_local","deadline":1.5,
            "lifespan":"infinite","liveliness":"manual_by_topic","liveliness_lease_duration":{"sec":2,"nanosec":3},
            "avoid_ros_namespace_conventions":false}"#,
        all(),
    );
    means(
        r#"{"history":1,"depth":5.0,"reliability":2,"durability":1,"deadline":{"secs":1,"nsecs":500000000},
            "lifespan":1e300,"liveliness":3,"liveliness_lease_duration":{"sec":2,"nsec":3}}"#,
        all(),
    );
    means(
        r#"{"history":"KEEP_ALL","reliability":"Reliable","durability":"VOLATILE"}"#,
        Qos {
            history: Some(History::KeepAll),
            reliability: Some(Reliability::Reliable),
            durability: Some(Durability::Volatile),
            ..Qos::default()
        },
    );
    means(
        r#"{"reliability":4,"durability":"best_available","deadline":"best_available","liveliness":5,
            "liveliness_lease_duration":"best_available"}"#,
        Qos {
            reliability: Some(Reliability::BestAvailable),
            durability: Some(Durability::BestAvailable),
            deadline: Some(Period::BestAvailable),
            liveliness: Some(Liveliness::BestAvailable),
            liveliness_lease_duration: Some(Period::BestAvailable),
            ..Qos::default()
        },
    );
}

#[test]
fn what_says_nothing_leaves_the_choice_to_the_server() {
    means("{}", Qos::default());
    means(
        r#"{"history":0,"depth":0,"reliability":"system_default","durability":null,"deadline":0,
            "lifespan":{"sec":0,"nanosec":0},"liveliness":"System_Default"}"#,
        Qos::default(),
    );
    let none = Subscribe {
        qos: None,
        ..subscribed(Qos::default())
    };
    reads(&with("null"), none);
}

#[test]
fn the_longest_times_are_without_end() {
    for long in [
        "9223372036",
        r#"{"sec":9223372036,"nanosec":854775807}"#,
        r#"{"sec":9223372036854775807,"nanosec":9223372036854775807}"#,
    ] {
        let qos = format!(r#"{{"deadline":{long}}}"#);
        means(
            &qos,
            Qos {
                deadline: Some(Period::Infinite),
                ..Qos::default()
            },
        );
    }
    // As long as can be said.
    means(
        r#"{"depth":9000000000000000000}"#,
        Qos {
            depth: Some(9_000_000_000_000_000_000),
            ..Qos::default()
        },
    );
}

#[test]
fn what_cannot_be_meant_is_named_with_what_can() {
    let seconds = "a number of seconds, {\"sec\": 0, \"nanosec\": 0} or infinite, is expected";
    let or_best =
        "a number of seconds, {\"sec\": 0, \"nanosec\": 0}, infinite or best_available is expected";
    let reliability =
        "reliable (1), best_effort (2), best_available (4) or system_default (0) is expected";
    let durability =
        "transient_local (1), volatile (2), best_available (4) or system_default (0) is expected";
    for (key, value, expected) in [
        (
            "history",
            r#""keep_some""#,
            "keep_last (1), keep_all (2) or system_default (0) is expected",
        ),
        (
            "history",
            "3",
            "keep_last (1), keep_all (2) or system_default (0) is expected",
        ),
        (
            "depth",
            "-1",
            "a number of messages, 0 or more, is expected",
        ),
        (
            "depth",
            "1.5",
            "a number of messages, 0 or more, is expected",
        ),
        (
            "depth",
            r#""5""#,
            "a number of messages, 0 or more, is expected",
        ),
        ("reliability", r#""best-effort""#, reliability),
        ("reliability", "3", reliability),
        ("reliability", "true", reliability),
        ("durability", r#""persistent""#, durability),
        ("durability", "[1]", durability),
        (
            "liveliness",
            "2",
            "automatic (1), manual_by_topic (3), best_available (5) or system_default (0) is expected",
        ),
        ("deadline", "-0.5", or_best),
        ("deadline", r#""soon""#, or_best),
        ("deadline", r#"{"sec":1}"#, or_best),
        ("lifespan", r#"{"sec":-1,"nanosec":0}"#, seconds),
        ("lifespan", r#""best_available""#, seconds),
        (
            "avoid_ros_namespace_conventions",
            "true",
            "false (names are those of ROS) is expected",
        ),
    ] {
        refuses(
            &with(&format!(r#"{{"{key}":{value}}}"#)),
            &format!("subscribe: field \"qos.{key}\" is {value}, {expected}"),
        );
    }
    let object = "an object such as {\"reliability\": \"best_effort\", \"depth\": 5} is expected";
    for value in [r#""best_effort""#, "5", r#"{"depth" 5}"#, "[]"] {
        refuses(
            &with(value),
            &format!("subscribe: field \"qos\" is {value}, {object}"),
        );
    }
}

#[test]
fn publishers_say_what_they_offer() {
    let qos = Some(Qos {
        durability: Some(Durability::TransientLocal),
        depth: Some(1),
        ..Qos::default()
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
    reads(
        r#"{"op":"advertise","topic":"/x","type":"a/B","qos":{"durability":"transient_local","depth":1}}"#,
        advertise.clone(),
    );
    survives_cbor(advertise);
    let publish = Publish {
        id: None,
        topic: "/x".into(),
        msg: Payload::json("{}"),
        compression: crate::Compression::None,
        latch: false,
        type_name: None,
        qos,
    };
    reads(
        r#"{"op":"publish","topic":"/x","msg":{},"qos":{"durability":1,"depth":1}}"#,
        publish,
    );
    refuses(
        r#"{"op":"publish","topic":"/x","msg":{},"qos":{"depth":{}}}"#,
        "publish: field \"qos.depth\" is {}, a number of messages, 0 or more, is expected",
    );
    refuses(
        r#"{"op":"advertise","topic":"/x","type":"a/B","qos":7}"#,
        "advertise: field \"qos\" is 7, an object such as {\"reliability\": \"best_effort\", \"depth\": 5} is expected",
    );
}
