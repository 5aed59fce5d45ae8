use proptest::prelude::*;

use super::*;

const STAMPED_TYPES: [&str; 9] = [
    "sensor_msgs/Image",
    "sensor_msgs/LaserScan",
    "sensor_msgs/CameraInfo",
    "opencv_apps/RectArrayStamped",
    "rosgraph_msgs/Log",
    "nav_msgs/OccupancyGrid",
    "geometry_msgs/PoseStamped",
    "p/Stamped",
    "sensor_msgs/PointCloud2",
];

/// Creates an interface of topics with their types: `<` is an input, `>` an output, and `!` after the name means
/// latched.
fn interface(topics: &[&str]) -> Interface {
    interface_of_nodes(&topics.iter().map(|topic| (*topic, "/node")).collect::<Vec<_>>())
}

fn interface_of_nodes(topics: &[(&str, &str)]) -> Interface {
    let mut interface = Interface::default();
    let header = "uint32 seq\ntime stamp\nstring frame_id\n";
    let mut define = |name: &str, text: &str| {
        let Some((package, short)) = name.split_once('/') else {
            return;
        };
        let key = format!("{package}/msg/{short}");
        interface.definitions.insert(key, text.to_owned());
    };
    define("std_msgs/Header", header);
    for (topic, _) in topics {
        let (_, type_name) = topic.split_once(' ').expect("a type");
        let text = if STAMPED_TYPES.contains(&type_name) { "std_msgs/Header header\n" } else { "int32 x\n" };
        define(type_name, text);
    }
    for (topic, node) in topics {
        let (end, rest) = topic.split_at(1);
        let (name, type_name) = rest.split_once(' ').expect("a type");
        interface.topics.push(Topic {
            name: name.trim_end_matches('!').to_owned(),
            type_name: type_name.to_owned(),
            md5: String::new(),
            direction: match end {
                "<" => Direction::Input,
                _ => Direction::Output,
            },
            nodes: vec![(*node).to_owned()],
            latched: name.ends_with('!'),
            lazy: false,
            qos: None,
        });
    }
    interface
}

fn observed_answers(answers: &[(&str, &str)]) -> BTreeSet<ObservedAnswer> {
    let watched =
        |(input, output): &(&str, &str)| ObservedAnswer { input: (*input).to_owned(), output: (*output).to_owned() };
    answers.iter().map(watched).collect()
}

fn display_requests(requests: &[Request]) -> Vec<String> {
    let shown = |request: &Request| format!("{} {:?}", request.pair, request.reason);
    requests.iter().map(shown).collect()
}

fn decide_and_display(topics: &[&str], answers: &[(&str, &str)]) -> Vec<String> {
    display_requests(&decide_requests(RosVersion::One, &interface(topics), &observed_answers(answers)))
}

#[test]
fn by_rule_data_answers_before_switches_and_results_before_views() {
    for (topics, expected) in [
        (
            &[
                "</image sensor_msgs/Image",
                ">/people_detect/image sensor_msgs/Image",
                ">/people_detect/parameter_updates dynamic_reconfigure/Config",
                ">/people_detect/found opencv_apps/RectArrayStamped",
                ">/rosout rosgraph_msgs/Log",
            ][..],
            &["/image -> /people_detect/found, /people_detect/image by stamp Guessed"][..],
        ),
        (
            &[
                "</camera/camera_info sensor_msgs/CameraInfo",
                "</camera/image_raw sensor_msgs/Image",
                ">/camera/image_rect sensor_msgs/Image",
            ],
            &["/camera/image_raw -> /camera/image_rect by stamp Alone"],
        ),
        (
            &[
                "</tf tf2_msgs/TFMessage",
                "</scan sensor_msgs/LaserScan",
                ">/map! nav_msgs/OccupancyGrid",
                ">/map_metadata! nav_msgs/MapMetaData",
                ">/tf tf2_msgs/TFMessage",
            ],
            &["/scan -> /map by stamp Alone"],
        ),
        (
            &["</depth_enable std_msgs/Bool", "</image sensor_msgs/Image", ">/boxes p/Stamped"],
            &["/image -> /boxes by stamp Guessed"],
        ),
        (
            &["</a_switch std_msgs/Bool", "</word std_msgs/String", ">/out std_msgs/String"],
            &["/word -> /out by arrival Guessed"],
        ),
        (
            &["</camera/depth/image sensor_msgs/Image", "</camera/rgb/image sensor_msgs/Image", ">/boxes p/Stamped"],
            &["/camera/rgb/image -> /boxes by stamp Guessed"],
        ),
        (
            &["</in std_msgs/String", ">/a_state! std_msgs/String", ">/out std_msgs/String"],
            &["/in -> /out by arrival Alone"],
        ),
        (&["</in *", ">/out *"], &["/in -> /out Alone"]),
        (&["</in std_msgs/String", ">/out std_msgs/String"], &["/in -> /out by arrival Alone"]),
        (&[">/out std_msgs/String"], &[]),
        (&["</in std_msgs/String"], &[]),
        (&["</tf tf2_msgs/TFMessage", ">/out std_msgs/String"], &[]),
    ] {
        assert_eq!(decide_and_display(topics, &[]), expected, "{topics:?}");
    }
}

#[test]
fn topics_of_ros_2_that_every_node_has_answer_nothing() {
    let topics = [
        "</in std_msgs/String",
        ">/a/_action/feedback p/Walk_FeedbackMessage",
        ">/a/_action/status action_msgs/GoalStatusArray",
        ">/a/transition_event lifecycle_msgs/TransitionEvent",
        ">/out std_msgs/String",
        ">/parameter_events rcl_interfaces/ParameterEvent",
        ">/rosout rosgraph_msgs/Log",
    ];
    assert_eq!(decide_and_display(&topics, &[]), ["/in -> /out by arrival Alone"]);
    let two = Interface {
        topics: vec![Topic {
            type_name: "sensor_msgs/msg/Image".to_owned(),
            ..interface(&["</z sensor_msgs/Image"]).topics.remove(0)
        }],
        ..Interface::default()
    };
    let ends = TopicEnds::from_interface(RosVersion::Two, &two);
    assert_eq!(ends.topics[0].1.type_name, "sensor_msgs/Image");
}

#[test]
fn what_was_seen_counts_before_rules() {
    for (topics, answers, expected) in [
        // By name, the other one would be the trigger.
        (
            &[
                "</a/image sensor_msgs/Image",
                "</b/image sensor_msgs/Image",
                ">/boxes p/Stamped",
                ">/view sensor_msgs/Image",
            ][..],
            &[("/b/image", "/boxes")][..],
            &["/b/image -> /boxes, /view by stamp Watched"][..],
        ),
        // Two pipelines in one node.
        (
            &["</left sensor_msgs/Image", "</right sensor_msgs/Image", ">/l p/Stamped", ">/r p/Stamped"],
            &[("/left", "/l"), ("/right", "/r")],
            &["/left -> /l by stamp Watched", "/right -> /r by stamp Watched"],
        ),
        // A node that forwards everything: an output answers a single input.
        (
            &["</left sensor_msgs/Image", "</right sensor_msgs/Image", ">/out sensor_msgs/Image"],
            &[("/left", "/out"), ("/right", "/out")],
            &["/left -> /out by stamp Watched"],
        ),
        // Nothing is detected in an empty image; the echo of a pose is irrelevant.
        (
            &[
                "</image sensor_msgs/Image",
                "</pose geometry_msgs/PoseStamped",
                ">/boxes p/Stamped",
                ">/echo geometry_msgs/PoseStamped",
            ],
            &[("/pose", "/echo")],
            &["/pose -> /echo by stamp Watched", "/image -> /boxes by stamp Guessed"],
        ),
        // The depth image is processed together with the image and has no answer of its own.
        (
            &["</depth sensor_msgs/Image", "</rgb sensor_msgs/Image", ">/boxes p/Stamped", ">/debug p/Stamped"],
            &[("/rgb", "/boxes")],
            &["/rgb -> /boxes, /debug by stamp Watched"],
        ),
    ] {
        assert_eq!(decide_and_display(topics, answers), expected, "{topics:?}");
    }
}

proptest! {
    /// The result does not depend on the order of registration or recording.
    #[test]
    fn the_order_of_topics_does_not_matter(topics in Just(vec![
        "</depth_enable std_msgs/Bool",
        "</camera/depth sensor_msgs/Image",
        "</camera/rgb sensor_msgs/Image",
        ">/boxes p/Stamped",
        ">/debug sensor_msgs/Image",
    ]).prop_shuffle()) {
        prop_assert_eq!(decide_and_display(&topics, &[]), ["/camera/rgb -> /boxes, /debug by stamp Guessed"]);
        let answers = [("/camera/depth", "/boxes")];
        prop_assert_eq!(decide_and_display(&topics, &answers), ["/camera/depth -> /boxes, /debug by stamp Watched"]);
    }
}

#[test]
fn each_node_has_its_own_requests() {
    let interface = interface_of_nodes(&[
        ("</image sensor_msgs/Image", "/finder"),
        (">/boxes p/Stamped", "/finder"),
        ("</boxes p/Stamped", "/tracker"),
        (">/tracks p/Stamped", "/tracker"),
    ]);
    let found = decide_requests(RosVersion::One, &interface, &BTreeSet::new());
    assert_eq!(display_requests(&found), ["/image -> /boxes by stamp Alone", "/boxes -> /tracks by stamp Alone"]);
    assert_eq!((&*found[0].node, &*found[1].node), ("/finder", "/tracker"));
    // Topics of a supplement may belong to any node.
    let mut stated = interface;
    for topic in &mut stated.topics {
        topic.nodes.clear();
    }
    let found = decide_requests(RosVersion::One, &stated, &BTreeSet::new());
    assert_eq!(found[0].node, "");
}

#[test]
fn the_deployer_says_otherwise_or_is_told_what_there_is() {
    let interface = interface_of_nodes(&[
        ("</switch std_msgs/Bool", "/one"),
        ("</image sensor_msgs/Image", "/one"),
        (">/boxes p/Stamped", "/one"),
        (">/words std_msgs/String", "/one"),
        ("</in std_msgs/String", "/two"),
        (">/out std_msgs/String", "/two"),
    ]);
    let decided = decide_requests(RosVersion::One, &interface, &BTreeSet::new());
    let says = |stated: &[&str]| {
        let stated: Vec<TopicPair> = stated.iter().map(|text| text.parse().expect("a pair")).collect();
        apply_stated(RosVersion::One, &interface, &stated, decided.clone())
    };
    assert_eq!(
        display_requests(&says(&["/switch -> /words"]).expect("fine")),
        ["/switch -> /words by arrival Stated", "/in -> /out by arrival Alone"]
    );
    assert_eq!(display_requests(&says(&["/image -> /boxes"]).expect("fine"))[0], "/image -> /boxes by stamp Stated");
    assert_eq!(
        display_requests(&says(&["/image -> /boxes by arrival", "/switch -> /words"]).expect("fine"))[..2],
        ["/image -> /boxes by arrival Stated", "/switch -> /words by arrival Stated"]
    );
    assert_eq!(says(&[]).expect("fine"), decided);
    for (stated, words) in [
        (&["/imge -> /boxes"][..], "/imge is not an input of this service; its inputs are /switch, /image, /in"),
        (&["/image -> /image"], "/image is not an output of this service; its outputs are /boxes, /words, /out"),
        (&["/switch -> /boxes by stamp"], "/switch is a std_msgs/Bool, which has no header.stamp"),
        (&["/image -> /boxes by goal"], "remove it"),
        (&["/image -> /boxes", "/switch -> /boxes"], "/boxes is named twice"),
        (&["/image -> /boxes", "/image -> /words"], "/image is named twice"),
    ] {
        let error = says(stated).expect_err("refused").to_string();
        assert!(error.contains(words), "{error}");
    }
    let none = apply_stated(RosVersion::One, &Interface::default(), &["/a -> /b".parse().expect("a pair")], Vec::new());
    assert!(none.expect_err("refused").to_string().ends_with("it has no inputs"));
}

#[test]
fn what_was_recorded_before_has_its_requests_decided_now() {
    let old = interface(&["</image sensor_msgs/Image", ">/boxes p/Stamped"]);
    assert_eq!(old.requests, None);
    let text = serde_json::to_string(&old).expect("plain data");
    assert!(!text.contains("requests"), "as before");
    let found = old.decided_requests(RosVersion::One);
    assert_eq!(display_requests(&found), ["/image -> /boxes by stamp Alone"]);
    let new = Interface { requests: Some(Vec::new()), ..old };
    assert_eq!(new.decided_requests(RosVersion::One), []);
    let again: Interface = serde_json::from_str(
        &serde_json::to_string(&Interface { requests: Some(found.clone()), ..new.clone() }).expect("plain data"),
    )
    .expect("its own form");
    assert_eq!(again.requests, Some(found));
    assert!(!again.to_toml().contains("requests"), "{}", again.to_toml());
}

#[test]
fn what_could_not_be_read_again_is_not_decided() {
    let odd = ["</camera-1/image sensor_msgs/Image", ">/out std_msgs/String", ">/o,ut std_msgs/String"];
    assert_eq!(decide_and_display(&odd, &[]), [""; 0]);
    // Other fields of a record are still read.
    let unreadable = r#"{"requests": [{"pair": "/camera-1/image -> /out", "reason": "alone"}], "topics": []}"#;
    let read: Interface = serde_json::from_str(unreadable).unwrap();
    assert_eq!(read.requests, None);
}

#[test]
fn the_words_name_the_option() {
    let request = |reason| Request {
        node: "/node".to_owned(),
        pair: "/image -> /boxes by stamp".parse().expect("a pair"),
        reason,
    };
    let guess = request(Reason::Guessed).to_string();
    assert_eq!(
        guess,
        "answers on /boxes count for /image (a guess by types and names, because no answer was seen); change it with \
            --request INPUT=OUTPUT"
    );
    assert!(!request(Reason::Stated).to_string().contains("change it"));
}
