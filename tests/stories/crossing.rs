//! What crosses the link beside plain messages: time, transforms, settings. Actions are told in [`crate::goals`].

use std::sync::Arc;

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{
    GlobalParameters, Message, ParamValue, Publisher, Qos, RosVersion, Subscription, WireType,
};
use ros::ros1::Ros1Bus;
use ros::schema::{MessageType, Registry};
use support::Verdict;
use support::cable::{Badness, Cable};
use support::layout::Layout;
use support::patience::{Deadline, wait_for};
use support::ros_system::Node;
use support::site::{Running, Site, text_of};
use support::twins::triggered;
use support::world::{CROSSING, CROSSING_TWO, PEOPLE, Service, world};

const NODE: &str = "/crossing";
/// In seconds.
pub const HOUR: i64 = 3600;

/// The definitions of what is published here.
pub fn types() -> anyhow::Result<Registry> {
    types_of(RosVersion::One)
}

/// The same of either ROS.
pub fn types_of(ros: RosVersion) -> anyhow::Result<Registry> {
    let registry = Registry::of(ros);
    for (key, text) in [
        (
            "geometry_msgs/PointStamped",
            "std_msgs/Header header\nPoint point",
        ),
        ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z"),
        (
            "tf2_msgs/TFMessage",
            "geometry_msgs/TransformStamped[] transforms",
        ),
        (
            "geometry_msgs/TransformStamped",
            "std_msgs/Header header\nstring child_frame_id\nTransform transform",
        ),
        (
            "geometry_msgs/Transform",
            "Vector3 translation\nQuaternion rotation",
        ),
        ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
        (
            "geometry_msgs/Quaternion",
            "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        ),
        (
            "sensor_msgs/Image",
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
        ),
    ] {
        registry.insert(&named(ros, key), text)?;
    }
    let (time, action, text) = match ros {
        RosVersion::One => ("time", "actionlib/action/Test", ["int32"; 3]),
        RosVersion::Two => (
            "builtin_interfaces/Time",
            "test_msgs/action/Fibonacci",
            ["int32", "int32[]", "int32[]"],
        ),
    };
    registry.insert(&named(ros, "rosgraph_msgs/Clock"), &format!("{time} clock"))?;
    let names = match ros {
        RosVersion::One => ["goal", "result", "feedback"],
        RosVersion::Two => ["order", "sequence", "sequence"],
    };
    let parts = text
        .iter()
        .zip(names)
        .map(|(of, name)| format!("{of} {name}\n"));
    registry.insert(action, &parts.collect::<Vec<_>>().join("---\n"))?;
    Ok(registry)
}

/// A type's name in this ROS.
fn named(ros: RosVersion, name: &str) -> String {
    match ros {
        RosVersion::One => name.to_owned(),
        RosVersion::Two => name.replacen('/', "/msg/", 1),
    }
}

/// The type of this name.
fn of(ros: RosVersion, name: &str) -> anyhow::Result<Arc<MessageType>> {
    Ok(types_of(ros)?.message(&named(ros, name))?)
}

pub fn advertises(
    site: &Site,
    node: &(impl Node + ?Sized),
    topic: &str,
    of: &MessageType,
    latch: bool,
) -> anyhow::Result<Box<dyn Publisher>> {
    Ok(site.runtime.block_on(node.bus().advertise(
        topic,
        WireType::of(of),
        Qos::keep_last(10).latching(latch),
    ))?)
}

/// A serialized message, written field by field.
#[derive(Default)]
pub struct Written(pub Vec<u8>);

impl Written {
    pub fn word(mut self, word: u32) -> Self {
        self.0.extend(word.to_le_bytes());
        self
    }

    pub fn text(self, text: &str) -> Self {
        let mut written = self.word(u32::try_from(text.len()).unwrap_or(0));
        written.0.extend(text.as_bytes());
        written
    }

    /// `at`: nanoseconds since 1970.
    pub fn time(self, at: i64) -> Self {
        let part = |part: i64| u32::try_from(part).unwrap_or(0);
        self.word(part(at / 1_000_000_000))
            .word(part(at % 1_000_000_000))
    }

    pub fn zeros(mut self, count: usize) -> Self {
        self.0.resize(self.0.len() + count, 0);
        self
    }
}

/// A geometry_msgs/PointStamped.
fn point(ros: RosVersion, at: i64) -> Bytes {
    let mut out = Layout::of(ros);
    out.header_of(at, "map").f64(0.0).f64(0.0).f64(0.0).finish()
}

/// Whether they are the same, but for the first four bytes: what rospy fills in, or how CDR is written.
fn is_same(one: &[u8], other: &[u8]) -> bool {
    one.get(4..) == other.get(4..)
}

/// The service of the crossing node in this ROS, and its executable in the package of the same name.
pub fn service(ros: RosVersion) -> (Service, &'static str) {
    match ros {
        RosVersion::One => (CROSSING, "crossing.py"),
        RosVersion::Two => (CROSSING_TWO, "crossing"),
    }
}

/// A robot's name in the story of this ROS.
pub fn robot_of(ros: RosVersion, robot: &str) -> String {
    format!("crossing-{robot}-{}", ros.number())
}

/// Its command line.
pub fn argv(ros: RosVersion) -> &'static [&'static str] {
    match ros {
        RosVersion::One => &["__name:=crossing"],
        RosVersion::Two => &[],
    }
}

/// A stub of the crossing node, whose clock is `ahead` seconds ahead of the machine's.
pub fn crossing(
    site: &Site,
    server: &str,
    robot: &str,
    ahead: i64,
    settings: &str,
) -> anyhow::Result<Running> {
    let argv = argv(site.system.version());
    crossing_with(site, (server, robot), ahead, settings, argv)
}

/// The same with a command line of one's own.
fn crossing_with(
    site: &Site,
    (server, robot): (&str, &str),
    ahead: i64,
    settings: &str,
    argv: &[&str],
) -> anyhow::Result<Running> {
    let (Service { name, .. }, executable) = service(site.system.version());
    let toml = format!(
        "server = \"ws://{server}\"\nservice = \"{name}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n{settings}\n"
    );
    let ahead = ahead.to_string();
    let environment = [("CLOUDROID_TEST_CLOCK_SHIFT", ahead.as_str())];
    site.stub_among(&environment, &toml, name, executable, argv)
}

/// Waits until the node has all that it makes.
pub fn is_there(site: &Site, app: &(impl Node + ?Sized)) -> anyhow::Result<()> {
    site.until(app, "the node", |graph| match site.system.version() {
        RosVersion::One => {
            let result = graph.topics.get(&format!("{NODE}/act/result"));
            let publishes =
                result.is_some_and(|ends| ends.publishers.iter().any(|node| node == NODE));
            publishes && graph.services.contains_key(&format!("{NODE}/ask"))
        }
        RosVersion::Two => graph.ends.get(NODE).is_some_and(|ends| {
            let serves = |name: &str| ends.services.contains_key(&format!("{NODE}/{name}"));
            serves("now") && serves("act/_action/get_result") && serves("set_parameters")
        }),
    })?;
    Ok(())
}

pub fn with_log<T>(outcome: anyhow::Result<T>, stub: &Running) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", stub.said()))
}

/// Publishes until there is an answer: as in every ROS, what is published before all are connected is lost.
pub fn answers(
    site: &Site,
    publish: impl Fn(),
    subscription: &mut Subscription,
) -> anyhow::Result<Message> {
    let ask = || {
        publish();
        Ok(())
    };
    site.asks_until(subscription, ask, |_| Ok(true))
}

/// Publishes until this comes back as it was sent; others may come before it.
fn comes_back(
    site: &Site,
    points: &dyn Publisher,
    subscription: &mut Subscription,
    sent: &Bytes,
) -> Verdict {
    let ask = || {
        points.publish(sent.clone());
        Ok(())
    };
    site.asks_until(subscription, ask, |came| Ok(is_same(&came.bytes, sent)))
        .map(drop)
}

/// Subscribes, and waits until the node's stub is connected.
pub fn listens(
    site: &Site,
    app: &(impl Node + ?Sized),
    topic: &str,
) -> anyhow::Result<Subscription> {
    let mut subscription = site.hears(app, topic)?;
    let connected = site.runtime.block_on(async {
        let connected = subscription.matched.wait_for(|now| now.connected() > 0);
        wait_for(connected).await.is_ok()
    });
    ensure!(connected, "nobody publishes {topic}");
    Ok(subscription)
}

pub fn stamps_mean_the_same_where_clocks_differ(ros: RosVersion) -> Verdict {
    let daemon = world().with(service(ros).0)?;
    let stamped = of(ros, "geometry_msgs/PointStamped")?;
    for (settings, understood) in [("", true), ("stamps = \"keep\"", false)] {
        let site = Site::of(ros)?;
        let app = site.joins("/app")?;
        let robot = robot_of(ros, &format!("clock-{understood}"));
        let stub = crossing(&site, &daemon.address, &robot, HOUR, settings)?;
        with_log(is_there(&site, &app), &stub)?;
        let points = advertises(&site, &app, "/crossing/point", &stamped, false)?;
        site.connected(&*points, 1)?;
        let mut seen = site.hears(&app, "/crossing/seen")?;
        let mut refused = site.hears(&app, "/crossing/refused")?;
        let sent = point(ros, link::clock::now() + HOUR * 1_000_000_000 + 123);
        let say = || points.publish(sent.clone());
        if understood {
            let answer = with_log(answers(&site, say, &mut seen), &stub)?;
            // The stamp first of all is as the robot sent it.
            ensure!(
                is_same(&answer.bytes, &sent),
                "{answer:?} is not {sent:?}\n{}",
                stub.said()
            );
        } else {
            let answer = with_log(answers(&site, say, &mut refused), &stub)?;
            let answer = text_of(ros, &answer.bytes, 0)?;
            // It is an hour ahead, less the time that the message took.
            let age = answer
                .split_whitespace()
                .find_map(|word| word.parse::<f64>().ok());
            ensure!(
                age.is_some_and(|age| (-3600.5..-3000.0).contains(&age)),
                "{answer}"
            );
        }
    }
    Ok(())
}

pub fn simulated_time_is_the_robot_s(ros: RosVersion) -> Verdict {
    let daemon = world().with(service(ros).0)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    // In ROS 1 all nodes are told so, in ROS 2 each is.
    if let Ok(parameters) = app.parameters() {
        let simulated = parameters.set("/use_sim_time", ParamValue::Bool(true));
        site.runtime.block_on(simulated)?;
    }
    let argv = match ros {
        RosVersion::One => argv(ros),
        RosVersion::Two => &["--ros-args", "-p", "use_sim_time:=true"],
    };
    let clock = of(ros, "rosgraph_msgs/Clock")?;
    let clock = advertises(&site, &app, "/clock", &clock, true)?;
    // More than the clocks differ, so that it could be shifted by that.
    let simulated = 1_000_000 * 1_000_000_000 + 5;
    let tick = || clock.publish(Layout::of(ros).time(simulated).finish());
    tick();
    let robot = robot_of(ros, "simulated");
    let stub = crossing_with(&site, (&daemon.address, &robot), HOUR, "", argv)?;
    with_log(is_there(&site, &app), &stub)?;
    let stamped = of(ros, "geometry_msgs/PointStamped")?;
    let points = advertises(&site, &app, "/crossing/point", &stamped, false)?;
    site.connected(&*points, 1)?;
    let mut seen = site.hears(&app, "/crossing/seen")?;
    // The clock stands until the next tick, so it is asked for, not waited for.
    let told = || Ok(triggered(&site, &app, "/crossing/now")?.1);
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
    let sent = point(ros, simulated - 1);
    let say = || points.publish(sent.clone());
    let answer = with_log(answers(&site, say, &mut seen), &stub)?;
    ensure!(is_same(&answer.bytes, &sent), "{answer:?} is not {sent:?}");
    // A node of ROS 2 is told otherwise while it runs.
    if let Ok(parameters) = app.node_parameters() {
        for is_simulated in [false, true] {
            let change = (
                "use_sim_time".to_owned(),
                Some(ParamValue::Bool(is_simulated)),
            );
            let set = site.runtime.block_on(parameters.set(NODE, vec![change]))?;
            ensure!(set == [Ok(())], "{set:?}");
            let sent = match is_simulated {
                true => point(ros, simulated - 2),
                false => point(ros, link::clock::now() + HOUR * 1_000_000_000 + 123),
            };
            tick();
            with_log(comes_back(&site, &*points, &mut seen, &sent), &stub)?;
        }
    }
    Ok(())
}

pub fn transforms_of_all_publishers_arrive(ros: RosVersion) -> Verdict {
    let daemon = world().with(service(ros).0)?;
    let transforms = of(ros, "tf2_msgs/TFMessage")?;
    let transform = |child: &str| {
        let mut out = Layout::of(ros);
        out.u32(1).header_of(link::clock::now(), "map").text(child);
        for _ in 0..7 {
            out.f64(0.0);
        }
        out.finish()
    };
    let site = Site::of(ros)?;
    // Latched, by two publishers, before the stub is there.
    let mut fixed = Vec::new();
    for name in ["base", "laser"] {
        let node = site.joins(&format!("/{name}"))?;
        let publisher = advertises(&site, &node, "/tf_static", &transforms, true)?;
        publisher.publish(transform(name));
        fixed.push((node, publisher));
    }
    let app = site.joins("/app")?;
    let moving = advertises(&site, &app, "/tf", &transforms, false)?;
    let robot = robot_of(ros, "transforms");
    let stub = crossing(&site, &daemon.address, &robot, 0, "")?;
    with_log(is_there(&site, &app), &stub)?;
    site.connected(&*moving, 1)?;
    let mut frames = site.hears_latched(&app, "/crossing/frames")?;
    moving.publish(transform("odometry"));
    let wanted = "fixed:base fixed:laser moving:odometry";
    loop {
        let told = with_log(site.next(&mut frames), &stub)?;
        let told = text_of(ros, &told.bytes, 0)?;
        if told == wanted {
            return Ok(());
        }
        ensure!(told.len() < wanted.len(), "{told}");
    }
}

pub fn explain_names_a_clock_and_a_queue(ros: RosVersion) -> Verdict {
    let daemon = world().with(service(ros).0)?;
    let stamped = of(ros, "geometry_msgs/PointStamped")?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = &*robot_of(ros, "explained");
    let settings = "desire = 20.0\nmax = 20.0\nrequest = \"/crossing/work -> /crossing/worked\"";
    let stub = crossing(&site, &daemon.address, robot, HOUR, settings)?;
    with_log(is_there(&site, &app), &stub)?;
    let points = advertises(&site, &app, "/crossing/work", &stamped, false)?;
    site.connected(&*points, 1)?;
    let mut worked = site.hears(&app, "/crossing/worked")?;
    let now = link::clock::now() + HOUR * 1_000_000_000;
    let say = || points.publish(point(ros, now));
    with_log(answers(&site, say, &mut worked), &stub)?;
    // Each takes the node 50 ms, and they come all at once.
    let bursts = 2;
    for burst in 0..bursts {
        let sent: Vec<i64> = (1..=8).map(|number| now + burst * 100 + number).collect();
        for at in &sent {
            points.publish(point(ros, *at));
        }
        let last = point(ros, *sent.last().context("some")?);
        while !is_same(&with_log(site.next(&mut worked), &stub)?.bytes, &last) {}
    }
    let path = format!("/api/v1/robots/{robot}/explain");
    let explained = daemon.awaits(&path, "a queue and a clock among the causes", |explained| {
        let causes = explained["causes"].to_string();
        let named = |words: &str| causes.contains(words);
        let both = named("requests queue before /crossing: ") && named("the robot's clock is 3600");
        both.then(|| explained.clone())
    });
    let explained = with_log(explained, &stub)?;
    let causes = explained["causes"].to_string();
    ensure!(causes.contains("ms ahead of the server's"), "{causes}");
    let phases = &explained["servants"][0]["links"][0]["phases"];
    let median = |name: &str| -> Option<f64> {
        let all = phases.as_array()?.iter();
        let mut parts = all.filter(|part| part["name"] == name);
        parts.next()?["p50"].as_f64()
    };
    let (queue, compute) = (median("queue"), median("compute"));
    ensure!(queue > compute && compute > Some(0.0), "{phases:#}");
    Ok(())
}

pub fn settings_are_changed_through_dynamic_reconfigure() -> Verdict {
    let daemon = world().with(PEOPLE)?;
    let site = Site::new()?;
    let app: Arc<Ros1Bus> = site.node("/app")?;
    let stub = site.stub(
        &daemon,
        ("opencv_apps", "opencv_apps", "people_detect"),
        "crossing-settings",
        &["__name:=people", "_debug_view:=false"],
    )?;
    let there = site.until(&app, "the service", |graph| {
        graph.services.contains_key("/people/set_parameters")
            && graph.topics.contains_key("/people/parameter_updates")
    });
    with_log(there, &stub)?;
    let mut updates = site.hears(&app, "/people/parameter_updates")?;
    // What holds now is latched.
    with_log(site.next(&mut updates), &stub)?;
    // dynamic_reconfigure/Config: bools · ints { name, value } · strs · doubles · groups
    let config = Written::default().word(0).word(1).text("padding").word(16);
    let request = config.word(0).word(0).word(0).0;
    let response = with_log(site.calls(&app, "/people/set_parameters", &request), &stub)?;
    let padding = Written::default().text("padding").word(16).0;
    let holds = |bytes: &[u8]| bytes.windows(padding.len()).any(|part| part == padding);
    ensure!(holds(&response), "{response:?}");
    // At its start the node tells its settings more than once.
    while !holds(&with_log(site.next(&mut updates), &stub)?.bytes) {}
    // The node has written it to the robot's parameter server, too.
    support::until("the node's setting on the robot's parameter server", || {
        let value = site.runtime.block_on(app.get("/people/padding"))?;
        let is = value == ParamValue::Int(16);
        Ok(is.then_some(()).ok_or_else(|| format!("{value:?}")))
    })
}

/// A sensor_msgs/Image: a wall with a shadow on it, which moves.
fn picture(number: u32) -> Vec<u8> {
    const SIZE: (u32, u32) = (320, 240);
    let mut pixels = Vec::new();
    for row in 0..SIZE.1 {
        for column in 0..SIZE.0 {
            let shade = (row / 2 + (column + number).abs_diff(SIZE.0 / 2) / 3) as u8;
            pixels.extend([shade, shade / 2 + (column * row % 3) as u8, 200 - shade / 2]);
        }
    }
    let head = Written::default()
        .word(0)
        .time(1_700_000_000_000_000_000 + i64::from(number));
    let mut picture = head.text("camera").word(SIZE.1).word(SIZE.0).text("rgb8");
    picture = picture.zeros(1).word(SIZE.0 * 3).word(SIZE.0 * SIZE.1 * 3);
    picture.0.extend(pixels);
    picture.0
}

/// So many pictures are shown at least, and so many of the last are carried as they are to be.
pub const TRIED: u32 = 40;
pub const SETTLED: usize = 5;

pub fn pictures_are_made_smaller_where_the_link_is_slow() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let image = types.message("sensor_msgs/Image")?;
    for (codec, smaller) in [("auto", true), ("none", false)] {
        let cable = Cable::new(&daemon.address)?;
        cable.degrade(Badness::SLOW)?;
        let site = Site::new()?;
        let app = site.node("/app")?;
        let server = cable.server.to_string();
        let settings = format!("codec = \"{codec}\"");
        let robot = format!("crossing-pictures-{codec}");
        let stub = crossing(&site, &server, &robot, 0, &settings)?;
        with_log(is_there(&site, &app), &stub)?;
        let pictures = advertises(&site, &app, "/crossing/picture", &image, false)?;
        site.connected(&*pictures, 1)?;
        let mut mirrored = site.hears(&app, "/crossing/mirrored")?;
        let first = picture(0);
        let say = || pictures.publish(first.clone().into());
        with_log(answers(&site, say, &mut mirrored), &stub)?;
        // The link has to be measured, and the codecs to be tried, before one is settled on.
        let size = first.len() as u64;
        let mut carried = Vec::new();
        let settled = |carried: &[(u64, u64)]| {
            let last = &carried[carried.len().saturating_sub(SETTLED)..];
            let is = |bytes: u64| {
                if smaller {
                    bytes < size / 2
                } else {
                    bytes >= size
                }
            };
            last.len() == SETTLED && last.iter().all(|(up, down)| is(*up) && is(*down))
        };
        let deadline = Deadline::begin();
        let mut number = 0;
        while number < TRIED || !settled(&carried) {
            deadline
                .check(|| format!("codec {codec}: pictures of {size} bytes took {carried:?}"))?;
            number += 1;
            let before = cable.carried()?;
            let sent = picture(number);
            pictures.publish(sent.clone().into());
            loop {
                let came = with_log(site.next(&mut mirrored), &stub)?;
                if came.bytes[4..12] == sent[4..12] {
                    ensure!(came.bytes[4..] == sent[4..], "picture {number} is another");
                    break;
                }
            }
            let after = cable.carried()?;
            carried.push((after.0 - before.0, after.1 - before.1));
        }
    }
    Ok(())
}
