//! Data that crosses the link besides plain messages: time, transforms, settings. Actions are covered in
//! [`crate::goals`].

use std::sync::Arc;

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{
    GlobalParameters, ParamValue, Publisher, QosProfile, RosVersion, SerializedMessage, Subscription, WireType,
};
use ros::ros1::Ros1Bus;
use ros::schema::{MessageType, Registry};
use support::Verdict;
use support::cable::{Cable, NetworkImpairment};
use support::layout::MessageLayout;
use support::patience::{Deadline, wait_for};
use support::ros_system::HasBus;
use support::site::{NodeProcess, Site, string_text};
use support::twins::call_trigger;
use support::world::{CROSSING, CROSSING_TWO, PEOPLE, StoryService, world};

const NODE: &str = "/crossing";
/// One hour in seconds.
pub const HOUR: i64 = 3600;

/// Returns a registry of the message types in use.
pub fn message_types() -> anyhow::Result<Registry> {
    message_types_for(RosVersion::One)
}

/// Returns a registry of the message types for either version of ROS.
pub fn message_types_for(ros: RosVersion) -> anyhow::Result<Registry> {
    let registry = Registry::for_version(ros);
    for (key, text) in [
        ("geometry_msgs/PointStamped", "std_msgs/Header header\nPoint point"),
        ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z"),
        ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms"),
        ("geometry_msgs/TransformStamped", "std_msgs/Header header\nstring child_frame_id\nTransform transform"),
        ("geometry_msgs/Transform", "Vector3 translation\nQuaternion rotation"),
        ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
        (
            "sensor_msgs/Image",
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 \
             step\nuint8[] data",
        ),
    ] {
        registry.insert(&type_name(ros, key), text)?;
    }
    let (time, action, text) = match ros {
        RosVersion::One => ("time", "actionlib/action/Test", ["int32"; 3]),
        RosVersion::Two => ("builtin_interfaces/Time", "test_msgs/action/Fibonacci", ["int32", "int32[]", "int32[]"]),
    };
    registry.insert(&type_name(ros, "rosgraph_msgs/Clock"), &format!("{time} clock"))?;
    let names = match ros {
        RosVersion::One => ["goal", "result", "feedback"],
        RosVersion::Two => ["order", "sequence", "sequence"],
    };
    let parts = text.iter().zip(names).map(|(of, name)| format!("{of} {name}\n"));
    registry.insert(action, &parts.collect::<Vec<_>>().join("---\n"))?;
    Ok(registry)
}

/// Returns the name of a type in this version of ROS.
fn type_name(ros: RosVersion, name: &str) -> String {
    match ros {
        RosVersion::One => name.to_owned(),
        RosVersion::Two => name.replacen('/', "/msg/", 1),
    }
}

/// Returns the type of this name.
pub fn find_type(ros: RosVersion, name: &str) -> anyhow::Result<Arc<MessageType>> {
    Ok(message_types_for(ros)?.message(&type_name(ros, name))?)
}

pub fn advertise(
    site: &Site,
    node: &(impl HasBus + ?Sized),
    topic: &str,
    of: &MessageType,
    latch: bool,
) -> anyhow::Result<Box<dyn Publisher>> {
    Ok(site.runtime.block_on(node.bus().advertise(
        topic,
        WireType::from_message(of),
        QosProfile::keep_last(10).latching(latch),
    ))?)
}

/// A serialized message, written field by field.
#[derive(Default)]
pub struct MessageBytes(pub Vec<u8>);

impl MessageBytes {
    pub fn word(mut self, word: u32) -> Self {
        self.0.extend(word.to_le_bytes());
        self
    }

    pub fn text(self, text: &str) -> Self {
        let mut written = self.word(u32::try_from(text.len()).unwrap_or(0));
        written.0.extend(text.as_bytes());
        written
    }

    /// Appends a time; `at` is in nanoseconds since 1970.
    pub fn time(self, at: i64) -> Self {
        let part = |part: i64| u32::try_from(part).unwrap_or(0);
        self.word(part(at / 1_000_000_000)).word(part(at % 1_000_000_000))
    }

    pub fn zeros(mut self, count: usize) -> Self {
        self.0.resize(self.0.len() + count, 0);
        self
    }
}

/// Serializes a geometry_msgs/PointStamped.
pub fn point_message(ros: RosVersion, at: i64) -> Bytes {
    let mut out = MessageLayout::new(ros);
    out.header_at(at, "map").f64(0.0).f64(0.0).f64(0.0).finish()
}

/// Returns whether two messages are equal except for the first four bytes, which rospy fills in, or which select the
/// CDR encoding.
pub fn is_same(one: &[u8], other: &[u8]) -> bool {
    one.get(4..) == other.get(4..)
}

/// Returns the service of the crossing node for this version of ROS, and its executable in the package of the same
/// name.
pub fn service(ros: RosVersion) -> (StoryService, &'static str) {
    match ros {
        RosVersion::One => (CROSSING, "crossing.py"),
        RosVersion::Two => (CROSSING_TWO, "crossing"),
    }
}

/// Returns a robot name that is unique for this version of ROS.
pub fn robot_name(ros: RosVersion, robot: &str) -> String {
    format!("crossing-{robot}-{}", ros.number())
}

/// Returns the node's command line.
pub fn argv(ros: RosVersion) -> &'static [&'static str] {
    match ros {
        RosVersion::One => &["__name:=crossing"],
        RosVersion::Two => &[],
    }
}

/// Starts a stub of the crossing node, whose clock is `ahead` seconds ahead of the machine's.
pub fn crossing(site: &Site, server: &str, robot: &str, ahead: i64, settings: &str) -> anyhow::Result<NodeProcess> {
    let argv = argv(site.system.version());
    crossing_with(site, (server, robot), ahead, settings, argv)
}

/// Starts a stub with these arguments.
fn crossing_with(
    site: &Site,
    (server, robot): (&str, &str),
    ahead: i64,
    settings: &str,
    argv: &[&str],
) -> anyhow::Result<NodeProcess> {
    let (StoryService { name, .. }, executable) = service(site.system.version());
    let toml = format!(
        "server = \"ws://{server}\"\nservice = \"{name}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n{settings}\n"
    );
    let ahead = ahead.to_string();
    let environment = [("CLOUDROID_TEST_CLOCK_SHIFT", ahead.as_str())];
    site.start_stub_with_environment(&environment, &toml, name, executable, argv)
}

/// Waits until the node has registered everything.
pub fn wait_until_ready(site: &Site, app: &(impl HasBus + ?Sized)) -> anyhow::Result<()> {
    site.wait_for_graph(app, "the node", |graph| match site.system.version() {
        RosVersion::One => {
            let result = graph.topics.get(&format!("{NODE}/act/result"));
            let publishes = result.is_some_and(|ends| ends.publishers.iter().any(|node| node == NODE));
            publishes && graph.services.contains_key(&format!("{NODE}/ask"))
        }
        RosVersion::Two => graph.ends.get(NODE).is_some_and(|ends| {
            let serves = |name: &str| ends.services.contains_key(&format!("{NODE}/{name}"));
            serves("now") && serves("act/_action/get_result") && serves("set_parameters")
        }),
    })?;
    Ok(())
}

pub fn with_log<T>(outcome: anyhow::Result<T>, stub: &NodeProcess) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", stub.output()))
}

/// Publishes until there is an answer: as in every ROS, messages are lost until both sides are connected.
pub fn wait_for_answer(
    site: &Site,
    publish: impl Fn(),
    subscription: &mut Subscription,
) -> anyhow::Result<SerializedMessage> {
    let ask = || {
        publish();
        Ok(())
    };
    site.ask_until(subscription, ask, |_| Ok(true))
}

/// Publishes until a message is returned unchanged; other messages may precede it.
fn wait_for_echo(site: &Site, points: &dyn Publisher, subscription: &mut Subscription, sent: &Bytes) -> Verdict {
    let ask = || {
        points.publish(sent.clone());
        Ok(())
    };
    site.ask_until(subscription, ask, |came| Ok(is_same(&came.bytes, sent))).map(drop)
}

/// Subscribes, and waits until the node's stub is connected.
pub fn subscribe(site: &Site, app: &(impl HasBus + ?Sized), topic: &str) -> anyhow::Result<Subscription> {
    let mut subscription = site.subscribe(app, topic)?;
    let connected = site.runtime.block_on(async {
        let connected = subscription.matched.wait_for(|now| now.connected_count() > 0);
        wait_for(connected).await.is_ok()
    });
    ensure!(connected, "nobody publishes {topic}");
    Ok(subscription)
}

pub fn stamps_mean_the_same_where_clocks_differ(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(service(ros).0)?;
    let stamped = find_type(ros, "geometry_msgs/PointStamped")?;
    for (settings, understood) in [("", true), ("stamps = \"keep\"", false)] {
        let site = Site::with_ros(ros)?;
        let app = site.join("/app")?;
        let robot = robot_name(ros, &format!("clock-{understood}"));
        let stub = crossing(&site, &daemon.address, &robot, HOUR, settings)?;
        with_log(wait_until_ready(&site, &app), &stub)?;
        let points = advertise(&site, &app, "/crossing/point", &stamped, false)?;
        site.wait_for_subscribers(&*points, 1)?;
        let mut seen = site.subscribe(&app, "/crossing/seen")?;
        let mut refused = site.subscribe(&app, "/crossing/refused")?;
        let sent = point_message(ros, link::clock::now() + HOUR * 1_000_000_000 + 123);
        let say = || points.publish(sent.clone());
        if understood {
            let answer = with_log(wait_for_answer(&site, say, &mut seen), &stub)?;
            // The stamp at the beginning is the one that the robot sent.
            ensure!(is_same(&answer.bytes, &sent), "{answer:?} is not {sent:?}\n{}", stub.output());
        } else {
            let answer = with_log(wait_for_answer(&site, say, &mut refused), &stub)?;
            let answer = string_text(ros, &answer.bytes, 0)?;
            // It is an hour ahead, less the latency of the message.
            let age = answer.split_whitespace().find_map(|word| word.parse::<f64>().ok());
            ensure!(age.is_some_and(|age| (-3600.5..-3000.0).contains(&age)), "{answer}");
        }
    }
    Ok(())
}

pub fn simulated_time_is_the_robot_s(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(service(ros).0)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    // In ROS 1 one parameter applies to all nodes, in ROS 2 each node has its own.
    if let Ok(parameters) = app.parameters() {
        let simulated = parameters.set("/use_sim_time", ParamValue::Bool(true));
        site.runtime.block_on(simulated)?;
    }
    let argv = match ros {
        RosVersion::One => argv(ros),
        RosVersion::Two => &["--ros-args", "-p", "use_sim_time:=true"],
    };
    let clock = find_type(ros, "rosgraph_msgs/Clock")?;
    let clock = advertise(&site, &app, "/clock", &clock, true)?;
    // Larger than the difference of the clocks, so that a conversion by that difference would be noticed.
    let simulated = 1_000_000 * 1_000_000_000 + 5;
    let tick = || clock.publish(MessageLayout::new(ros).time(simulated).finish());
    tick();
    let robot = robot_name(ros, "simulated");
    let stub = crossing_with(&site, (&daemon.address, &robot), HOUR, "", argv)?;
    with_log(wait_until_ready(&site, &app), &stub)?;
    let stamped = find_type(ros, "geometry_msgs/PointStamped")?;
    let points = advertise(&site, &app, "/crossing/point", &stamped, false)?;
    site.wait_for_subscribers(&*points, 1)?;
    let mut seen = site.subscribe(&app, "/crossing/seen")?;
    // The clock stands still until the next tick, so the node is polled.
    let told = || Ok(call_trigger(&site, &app, "/crossing/now")?.1);
    let deadline = Deadline::begin();
    loop {
        let now = with_log(told(), &stub)?;
        if now == simulated.to_string() {
            break;
        }
        let late = || format!("it is {now} in the cloud, and should be {simulated}");
        with_log(deadline.check(late), &stub)?;
        tick();
    }
    let sent = point_message(ros, simulated - 1);
    let say = || points.publish(sent.clone());
    let answer = with_log(wait_for_answer(&site, say, &mut seen), &stub)?;
    ensure!(is_same(&answer.bytes, &sent), "{answer:?} is not {sent:?}");
    // A node of ROS 2 can be switched while it runs.
    if let Ok(parameters) = app.node_parameters() {
        for is_simulated in [false, true] {
            let change = ("use_sim_time".to_owned(), Some(ParamValue::Bool(is_simulated)));
            let set = site.runtime.block_on(parameters.set(NODE, vec![change]))?;
            ensure!(set == [Ok(())], "{set:?}");
            let sent = if is_simulated {
                point_message(ros, simulated - 2)
            } else {
                point_message(ros, link::clock::now() + HOUR * 1_000_000_000 + 123)
            };
            tick();
            with_log(wait_for_echo(&site, &*points, &mut seen, &sent), &stub)?;
        }
    }
    Ok(())
}

pub fn transforms_of_all_publishers_arrive(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(service(ros).0)?;
    let transforms = find_type(ros, "tf2_msgs/TFMessage")?;
    let transform = |child: &str| {
        let mut out = MessageLayout::new(ros);
        out.u32(1).header_at(link::clock::now(), "map").text(child);
        for _ in 0..7 {
            out.f64(0.0);
        }
        out.finish()
    };
    let site = Site::with_ros(ros)?;
    // Latched by two publishers before the stub starts.
    let mut fixed = Vec::new();
    for name in ["base", "laser"] {
        let node = site.join(&format!("/{name}"))?;
        let publisher = advertise(&site, &node, "/tf_static", &transforms, true)?;
        publisher.publish(transform(name));
        fixed.push((node, publisher));
    }
    let app = site.join("/app")?;
    let moving = advertise(&site, &app, "/tf", &transforms, false)?;
    let robot = robot_name(ros, "transforms");
    let stub = crossing(&site, &daemon.address, &robot, 0, "")?;
    with_log(wait_until_ready(&site, &app), &stub)?;
    site.wait_for_subscribers(&*moving, 1)?;
    let mut frames = site.subscribe_latched(&app, "/crossing/frames")?;
    moving.publish(transform("odometry"));
    let wanted = "fixed:base fixed:laser moving:odometry";
    loop {
        let told = with_log(site.next_message(&mut frames), &stub)?;
        let told = string_text(ros, &told.bytes, 0)?;
        if told == wanted {
            return Ok(());
        }
        ensure!(told.len() < wanted.len(), "{told}");
    }
}

pub fn explain_names_a_clock_and_a_queue(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(service(ros).0)?;
    let stamped = find_type(ros, "geometry_msgs/PointStamped")?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = &*robot_name(ros, "explained");
    let settings = "desire = 20.0\nmax = 20.0\nrequest = \"/crossing/work -> /crossing/worked\"";
    let stub = crossing(&site, &daemon.address, robot, HOUR, settings)?;
    with_log(wait_until_ready(&site, &app), &stub)?;
    let points = advertise(&site, &app, "/crossing/work", &stamped, false)?;
    site.wait_for_subscribers(&*points, 1)?;
    let mut worked = site.subscribe(&app, "/crossing/worked")?;
    let now = link::clock::now() + HOUR * 1_000_000_000;
    let say = || points.publish(point_message(ros, now));
    with_log(wait_for_answer(&site, say, &mut worked), &stub)?;
    // Each message takes the node 50 ms, and all are sent at once.
    let bursts = 2;
    for burst in 0..bursts {
        let sent: Vec<i64> = (1..=8).map(|number| now + burst * 100 + number).collect();
        for at in &sent {
            points.publish(point_message(ros, *at));
        }
        let last = point_message(ros, *sent.last().context("some")?);
        while !is_same(&with_log(site.next_message(&mut worked), &stub)?.bytes, &last) {}
    }
    let path = format!("/api/v1/robots/{robot}/explain");
    let explained = daemon.wait_for(&path, "a queue and a clock among the causes", |explained| {
        let causes = explained["causes"].to_string();
        let named = |words: &str| causes.contains(words);
        let both = named("in the queue of /crossing") && named("the robot's clock is 3600");
        both.then(|| explained.clone())
    });
    let explained = with_log(explained, &stub)?;
    let causes = explained["causes"].to_string();
    ensure!(causes.contains("ms ahead of the server's"), "{causes}");
    let phases = &explained["servants"][0]["links"][0]["phases"];
    let milliseconds = |name: &str, of: &str| -> Option<f64> {
        let mut parts = phases.as_array()?.iter().filter(|part| part["name"] == name);
        parts.next()?[of].as_f64()
    };
    // The messages that were sent until the first answer came waited for nobody.
    let (longest, compute) = (milliseconds("queue", "max"), milliseconds("compute", "p50"));
    ensure!(longest > compute && compute > Some(0.0), "{phases:#}");
    Ok(())
}

pub fn settings_are_changed_through_dynamic_reconfigure() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let site = Site::new()?;
    let app: Arc<Ros1Bus> = site.node("/app")?;
    let stub = site.start_stub(
        &daemon,
        ("opencv_apps", "opencv_apps", "people_detect"),
        "crossing-settings",
        &["__name:=people", "_debug_view:=false"],
    )?;
    let there = site.wait_for_graph(&app, "the service", |graph| {
        graph.services.contains_key("/people/set_parameters") && graph.topics.contains_key("/people/parameter_updates")
    });
    with_log(there, &stub)?;
    let mut updates = site.subscribe(&app, "/people/parameter_updates")?;
    // The current settings are latched.
    with_log(site.next_message(&mut updates), &stub)?;
    // dynamic_reconfigure/Config: bools · ints { name, value } · strs · doubles · groups
    let config = MessageBytes::default().word(0).word(1).text("padding").word(16);
    let request = config.word(0).word(0).word(0).0;
    let response = with_log(site.call_service(&app, "/people/set_parameters", &request), &stub)?;
    let padding = MessageBytes::default().text("padding").word(16).0;
    let holds = |bytes: &[u8]| bytes.windows(padding.len()).any(|part| part == padding);
    ensure!(holds(&response), "{response:?}");
    // At startup the node publishes its settings more than once.
    while !holds(&with_log(site.next_message(&mut updates), &stub)?.bytes) {}
    // The node has written the setting to the robot's parameter server as well.
    support::wait_until("the node's setting on the robot's parameter server", || {
        let value = site.runtime.block_on(app.get("/people/padding"))?;
        let is = value == ParamValue::Int(16);
        Ok(is.then_some(()).ok_or_else(|| format!("{value:?}")))
    })
}

/// Serializes a sensor_msgs/Image of a wall with a moving shadow.
fn image_bytes(number: u32) -> Vec<u8> {
    const SIZE: (u32, u32) = (320, 240);
    let mut pixels = Vec::new();
    for row in 0..SIZE.1 {
        for column in 0..SIZE.0 {
            let shade = (row / 2 + (column + number).abs_diff(SIZE.0 / 2) / 3) as u8;
            pixels.extend([shade, shade / 2 + (column * row % 3) as u8, 200 - shade / 2]);
        }
    }
    let head = MessageBytes::default().word(0).time(1_700_000_000_000_000_000 + i64::from(number));
    let mut picture = head.text("camera").word(SIZE.1).word(SIZE.0).text("rgb8");
    picture = picture.zeros(1).word(SIZE.0 * 3).word(SIZE.0 * SIZE.1 * 3);
    picture.0.extend(pixels);
    picture.0
}

/// Minimum number of images to publish, and number of the last ones that must be encoded as expected.
pub const TRIED: u32 = 40;
pub const SETTLED: usize = 5;

pub fn pictures_are_made_smaller_where_the_link_is_slow() -> Verdict {
    let daemon = world().daemon_with(CROSSING)?;
    let types = message_types()?;
    let image = types.message("sensor_msgs/Image")?;
    for (codec, smaller) in [("auto", true), ("none", false)] {
        let cable = Cable::new(&daemon.address)?;
        cable.degrade(NetworkImpairment::SLOW)?;
        let site = Site::new()?;
        let app = site.node("/app")?;
        let server = cable.server.to_string();
        let settings = format!("codec = \"{codec}\"");
        let robot = format!("crossing-pictures-{codec}");
        let stub = crossing(&site, &server, &robot, 0, &settings)?;
        with_log(wait_until_ready(&site, &app), &stub)?;
        let pictures = advertise(&site, &app, "/crossing/picture", &image, false)?;
        site.wait_for_subscribers(&*pictures, 1)?;
        let mut mirrored = site.subscribe(&app, "/crossing/mirrored")?;
        let first = image_bytes(0);
        let say = || pictures.publish(first.clone().into());
        with_log(wait_for_answer(&site, say, &mut mirrored), &stub)?;
        // The link first measures its rate and tries the codecs.
        let size = first.len() as u64;
        let mut carried = Vec::new();
        let settled = |carried: &[(u64, u64)]| {
            let last = &carried[carried.len().saturating_sub(SETTLED)..];
            let is = |bytes: u64| {
                if smaller { bytes < size / 2 } else { bytes >= size }
            };
            last.len() == SETTLED && last.iter().all(|(up, down)| is(*up) && is(*down))
        };
        let deadline = Deadline::begin();
        let mut number = 0;
        while number < TRIED || !settled(&carried) {
            deadline.check(|| format!("codec {codec}: pictures of {size} bytes took {carried:?}"))?;
            number += 1;
            let before = cable.transferred_bytes()?;
            let sent = image_bytes(number);
            pictures.publish(sent.clone().into());
            loop {
                let came = with_log(site.next_message(&mut mirrored), &stub)?;
                if came.bytes[4..12] == sent[4..12] {
                    ensure!(came.bytes[4..] == sent[4..], "picture {number} is another");
                    break;
                }
            }
            let after = cable.transferred_bytes()?;
            carried.push((after.0 - before.0, after.1 - before.1));
        }
    }
    Ok(())
}
