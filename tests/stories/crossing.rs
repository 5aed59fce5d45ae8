//! What crosses the link beside plain messages: time, transforms, actions, settings.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use ros::bus::{
    Bus, GlobalParameters, Message, ParamValue, Publisher, Qos, Subscription, WireType,
};
use ros::ros1::Ros1Bus;
use ros::schema::{MessageType, Registry};
use support::Verdict;
use support::cable::{Badness, Cable};
use support::robot::PATIENCE;
use support::site::{Running, Site};
use support::world::{CROSSING, PEOPLE, world};

const NODE: &str = "/crossing";
const HOUR: i64 = 3600;

/// The definitions of what is published here.
pub fn types() -> anyhow::Result<Registry> {
    let registry = Registry::new();
    for (key, text) in [
        ("geometry_msgs/PointStamped", "Header header\nPoint point"),
        ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z"),
        (
            "tf2_msgs/TFMessage",
            "geometry_msgs/TransformStamped[] transforms",
        ),
        (
            "geometry_msgs/TransformStamped",
            "Header header\nstring child_frame_id\nTransform transform",
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
        ("rosgraph_msgs/Clock", "time clock"),
        (
            "sensor_msgs/Image",
            "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
        ),
        (
            "actionlib/action/Test",
            "int32 goal\n---\nint32 result\n---\nint32 feedback",
        ),
    ] {
        registry.insert(key, text)?;
    }
    Ok(registry)
}

pub fn advertises(
    site: &Site,
    node: &Ros1Bus,
    topic: &str,
    of: &MessageType,
    latch: bool,
) -> anyhow::Result<Box<dyn Publisher>> {
    Ok(site.runtime.block_on(node.advertise(
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
fn point(at: i64) -> Vec<u8> {
    Written::default().word(0).time(at).text("map").zeros(24).0
}

/// What std_srvs/Trigger answered.
fn triggers(site: &Site, app: &Ros1Bus, service: &str) -> anyhow::Result<String> {
    let answer = site.calls(app, service, &[])?;
    Ok(String::from_utf8_lossy(answer.get(5..).context("too short")?).into_owned())
}

/// A stub of the crossing node, whose clock is `ahead` seconds ahead of the machine's.
fn crossing(
    site: &Site,
    server: &str,
    robot: &str,
    ahead: i64,
    settings: &str,
) -> anyhow::Result<Running> {
    let toml = format!(
        "server = \"ws://{server}\"\nservice = \"crossing_py\"\nrobot = \"{robot}\"\nlocal = \"none\"\n{settings}\n"
    );
    let ahead = ahead.to_string();
    let environment = [("CLOUDROID_TEST_CLOCK_SHIFT", ahead.as_str())];
    site.stub_among(
        &environment,
        &toml,
        "crossing_py",
        "crossing.py",
        &["__name:=crossing"],
    )
}

fn is_there(site: &Site, app: &Ros1Bus) -> anyhow::Result<()> {
    site.until(app, "the node", |graph| {
        let publishes = |topic: &str| {
            let ends = graph.topics.get(&format!("{NODE}/{topic}"));
            ends.is_some_and(|ends| ends.publishers.iter().any(|node| node == NODE))
        };
        publishes("act/result") && graph.services.contains_key(&format!("{NODE}/ask"))
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
    let deadline = Instant::now() + PATIENCE;
    while Instant::now() < deadline {
        publish();
        let next = site.runtime.block_on(async {
            tokio::time::timeout(Duration::from_millis(200), subscription.messages.recv()).await
        });
        if let Ok(Some(message)) = next {
            return Ok(message);
        }
    }
    anyhow::bail!("there was no answer")
}

/// Subscribes, and waits until the node's stub is connected.
pub fn listens(site: &Site, app: &Ros1Bus, topic: &str) -> anyhow::Result<Subscription> {
    let mut subscription = site.hears(app, topic)?;
    let connected = site.runtime.block_on(async {
        let connected = subscription.matched.wait_for(|now| now.connected() > 0);
        tokio::time::timeout(PATIENCE, connected).await.is_ok()
    });
    ensure!(connected, "nobody publishes {topic}");
    Ok(subscription)
}

pub fn stamps_mean_the_same_where_clocks_differ() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let stamped = types.message("geometry_msgs/PointStamped")?;
    for (settings, understood) in [("", true), ("stamps = \"keep\"", false)] {
        let site = Site::new()?;
        let app = site.node("/app")?;
        let robot = format!("crossing-clock-{understood}");
        let stub = crossing(&site, &daemon.address, &robot, HOUR, settings)?;
        with_log(is_there(&site, &app), &stub)?;
        let points = advertises(&site, &app, "/crossing/point", &stamped, false)?;
        site.connected(&*points, 1)?;
        let mut seen = site.hears(&app, "/crossing/seen")?;
        let mut refused = site.hears(&app, "/crossing/refused")?;
        let sent = point(link::clock::now() + HOUR * 1_000_000_000 + 123);
        let say = || points.publish(sent.clone().into());
        if understood {
            let answer = with_log(answers(&site, say, &mut seen), &stub)?;
            // rospy fills in `seq`; all else, the stamp first, is as the robot sent it.
            ensure!(answer.bytes[4..] == sent[4..], "{answer:?} is not {sent:?}");
        } else {
            let answer = with_log(answers(&site, say, &mut refused), &stub)?;
            let answer = String::from_utf8_lossy(&answer.bytes).into_owned();
            ensure!(
                answer.contains("-3599.") || answer.contains("-3600."),
                "{answer}"
            );
        }
    }
    Ok(())
}

pub fn simulated_time_is_the_robot_s() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    site.runtime
        .block_on(app.set("/use_sim_time", ParamValue::Bool(true)))?;
    let clock = types.message("rosgraph_msgs/Clock")?;
    let clock = advertises(&site, &app, "/clock", &clock, true)?;
    let simulated = 1234 * 1_000_000_000 + 5;
    clock.publish(Written::default().time(simulated).0.into());
    let stub = crossing(&site, &daemon.address, "crossing-simulated", HOUR, "")?;
    with_log(is_there(&site, &app), &stub)?;
    let stamped = types.message("geometry_msgs/PointStamped")?;
    let points = advertises(&site, &app, "/crossing/point", &stamped, false)?;
    site.connected(&*points, 1)?;
    let mut seen = site.hears(&app, "/crossing/seen")?;
    // The clock stands until the next tick, so it is asked for, not waited for.
    let told = || triggers(&site, &app, "/crossing/now");
    let deadline = Instant::now() + PATIENCE;
    loop {
        let now = with_log(told(), &stub)?;
        if now == simulated.to_string() {
            break;
        }
        let late = || anyhow::anyhow!("it is {now} in the cloud, and should be {simulated}");
        with_log(
            (Instant::now() < deadline).then_some(()).ok_or_else(late),
            &stub,
        )?;
        clock.publish(Written::default().time(simulated).0.into());
    }
    let say = || points.publish(point(simulated - 1).into());
    let answer = with_log(answers(&site, say, &mut seen), &stub)?;
    ensure!(answer.bytes[4..] == point(simulated - 1)[4..], "{answer:?}");
    Ok(())
}

pub fn transforms_of_all_publishers_arrive() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let transforms = types.message("tf2_msgs/TFMessage")?;
    let transform = |child: &str| {
        Written::default()
            .word(1)
            .word(0)
            .time(link::clock::now())
            .text("map")
            .text(child)
            .zeros(56)
            .0
    };
    let site = Site::new()?;
    // Latched, by two publishers, before the stub is there.
    let mut fixed = Vec::new();
    for name in ["base", "laser"] {
        let node = site.node(&format!("/{name}"))?;
        let publisher = advertises(&site, &node, "/tf_static", &transforms, true)?;
        publisher.publish(transform(name).into());
        fixed.push((node, publisher));
    }
    let app = site.node("/app")?;
    let moving = advertises(&site, &app, "/tf", &transforms, false)?;
    let stub = crossing(&site, &daemon.address, "crossing-transforms", 0, "")?;
    with_log(is_there(&site, &app), &stub)?;
    site.connected(&*moving, 1)?;
    let mut frames = site.hears(&app, "/crossing/frames")?;
    moving.publish(transform("odometry").into());
    let wanted = "fixed:base fixed:laser moving:odometry";
    loop {
        let told = with_log(site.next(&mut frames), &stub)?;
        let told = String::from_utf8_lossy(&told.bytes[4..]).into_owned();
        if told == wanted {
            return Ok(());
        }
        ensure!(told.len() < wanted.len(), "{told}");
    }
}

pub fn an_action_is_carried_out_in_the_cloud() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let action = types.action("actionlib/Test")?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let stub = crossing(&site, &daemon.address, "crossing-action", HOUR, "")?;
    with_log(is_there(&site, &app), &stub)?;
    let goals = advertises(
        &site,
        &app,
        "/crossing/act/goal",
        &action.action_goal,
        false,
    )?;
    let stop = types.message("actionlib_msgs/GoalID")?;
    let stop = advertises(&site, &app, "/crossing/act/cancel", &stop, false)?;
    site.connected(&*goals, 1)?;
    site.connected(&*stop, 1)?;
    let mut results = listens(&site, &app, "/crossing/act/result")?;
    let mut feedback = listens(&site, &app, "/crossing/act/feedback")?;
    // As clients of actions do: once the status comes, so will the others.
    let mut status = listens(&site, &app, "/crossing/act/status")?;
    with_log(site.next(&mut status), &stub)?;
    let now = link::clock::now() + HOUR * 1_000_000_000;
    let goal = |id: &str, steps: u32| {
        let goal = Written::default().word(0).time(now).text("");
        goal.time(now).text(id).word(steps).0
    };
    goals.publish(goal("three", 3).into());
    // header · status { goal_id { stamp, id }, status, text } · result
    let told = Written::default().time(now).text("three").0;
    let result = with_log(site.next(&mut results), &stub)?;
    let holds = |bytes: &[u8]| bytes.windows(told.len()).any(|part| part == told);
    ensure!(
        holds(&result.bytes) && result.bytes.ends_with(&[3, 0, 0, 0]),
        "{result:?}"
    );
    for step in 0..3_u8 {
        let step_done = with_log(site.next(&mut feedback), &stub)?;
        ensure!(
            holds(&step_done.bytes) && step_done.bytes.ends_with(&[step, 0, 0, 0]),
            "{step_done:?}"
        );
    }
    // One without end is cancelled once it is under way.
    goals.publish(goal("long", 1_000_000).into());
    with_log(site.next(&mut feedback), &stub)?;
    stop.publish(Written::default().time(0).text("long").0.into());
    let result = with_log(site.next(&mut results), &stub)?;
    let steps = i32::from_le_bytes(*result.bytes.last_chunk().context("a number")?);
    ensure!(steps < 0, "{result:?}");
    Ok(())
}

/// A network over which nothing comes in time.
const LATE: Badness = Badness {
    rate: 100_000,
    delay: 15_000,
    jitter: 0,
    loss: 0.0,
    limit: 10_000,
};

pub fn an_action_is_carried_out_by_the_original_while_the_cloud_is_slow() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let action = types.action("actionlib/Test")?;
    let cable = Cable::new(&daemon.address)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let node = ("crossing_py", "crossing.py");
    let program = "/opt/cloudroid/install/lib/crossing_py/crossing.py";
    let workspace = site.installs_original(&daemon, "crossing_py", node, program)?;
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"crossing_py\"\nrobot = \"crossing-late-action\"\nlocal = \"cold\"\n\
         desire = 5.0\nmax = 5.0\nthreshold = 4.0\ninitial = 15.0\n",
        cable.server
    );
    let workspace = workspace.to_string_lossy();
    let environment = [("CMAKE_PREFIX_PATH", &*workspace), ("NO_COLOR", "1")];
    let stub = site.stub_among(&environment, &toml, node.0, node.1, &["__name:=crossing"])?;
    with_log(is_there(&site, &app), &stub)?;
    let goals = "/crossing/act/goal";
    let goals = advertises(&site, &app, goals, &action.action_goal, false)?;
    site.connected(&*goals, 1)?;
    let mut results = listens(&site, &app, "/crossing/act/result")?;
    let mut feedback = listens(&site, &app, "/crossing/act/feedback")?;
    let mut status = listens(&site, &app, "/crossing/act/status")?;
    with_log(site.next(&mut status), &stub)?;
    let now = link::clock::now();
    let asks = |id: &str, steps: u32| {
        let goal = Written::default().word(0).time(now).text("").time(now);
        goals.publish(goal.text(id).word(steps).0.into());
    };
    let is_of = |message: &Message, id: &str| {
        let told = Written::default().time(now).text(id).0;
        message.bytes.windows(told.len()).any(|part| part == told)
    };
    let mut all: Vec<Message> = Vec::new();
    let mut hears = |id: &str| -> Verdict {
        while !all.iter().any(|result| is_of(result, id)) {
            let result = with_log(site.next(&mut results), &stub)?;
            all.push(result);
        }
        Ok(())
    };
    asks("quick", 2);
    hears("quick")?;
    cable.degrade(LATE)?;
    // Two that are late, and it is started; it carries them out as well.
    asks("late-1", 1);
    asks("late-2", 1);
    stub.says("the local original answers, too")?;
    hears("late-1")?;
    hears("late-2")?;
    // Whoever is first with a goal's feedback goes on with it.
    asks("steps", 3);
    hears("steps")?;
    let mut steps = Vec::new();
    while steps.len() < 3 {
        let step = with_log(site.next(&mut feedback), &stub)?;
        if is_of(&step, "steps") {
            steps.push(i32::from_le_bytes(
                *step.bytes.last_chunk().context("a number")?,
            ));
        }
    }
    ensure!(steps == [0, 1, 2], "{steps:?}");
    ensure!(!stub.said().contains("is stopped"), "{}", stub.said());
    cable.restore()?;
    let deadline = Instant::now() + PATIENCE;
    let mut asked = 0;
    while !stub.said().contains("the local original is stopped") {
        ensure!(Instant::now() < deadline, "{}", stub.said());
        asked += 1;
        let id = format!("good-{asked}.");
        asks(&id, 0);
        hears(&id)?;
    }
    // What the cloud still owed has come before this.
    asks("last", 1);
    hears("last")?;
    let mut ids: Vec<String> = ["quick", "late-1", "late-2", "steps", "last"]
        .map(str::to_owned)
        .into();
    ids.extend((1..=asked).map(|number| format!("good-{number}.")));
    for id in ids {
        let times = all.iter().filter(|result| is_of(result, &id)).count();
        ensure!(times == 1, "{id}: {times} results\n{}", stub.said());
    }
    Ok(())
}

pub fn explain_names_a_clock_and_a_queue() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let types = types()?;
    let stamped = types.message("geometry_msgs/PointStamped")?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let robot = "crossing-explained";
    let settings = "desire = 20.0\nmax = 20.0\nrequest = \"/crossing/work -> /crossing/worked\"";
    let stub = crossing(&site, &daemon.address, robot, HOUR, settings)?;
    with_log(is_there(&site, &app), &stub)?;
    let points = advertises(&site, &app, "/crossing/work", &stamped, false)?;
    site.connected(&*points, 1)?;
    let mut worked = site.hears(&app, "/crossing/worked")?;
    let now = link::clock::now() + HOUR * 1_000_000_000;
    let say = || points.publish(point(now).into());
    with_log(answers(&site, say, &mut worked), &stub)?;
    // Each takes the node 50 ms, and they come all at once.
    let bursts = 2;
    for burst in 0..bursts {
        let sent: Vec<i64> = (1..=8).map(|number| now + burst * 100 + number).collect();
        for at in &sent {
            points.publish(point(*at).into());
        }
        let last = point(*sent.last().context("some")?);
        while with_log(site.next(&mut worked), &stub)?.bytes[4..] != last[4..] {}
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
        let mut carried = Vec::new();
        for number in 1..=40 {
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
        let size = first.len() as u64;
        let last = &carried[carried.len() - 5..];
        let all =
            |holds: &dyn Fn(u64) -> bool| last.iter().all(|(up, down)| holds(*up) && holds(*down));
        ensure!(
            if smaller {
                all(&|bytes| bytes < size / 2)
            } else {
                all(&|bytes| bytes >= size)
            },
            "codec {codec}: pictures of {size} bytes took {carried:?}"
        );
    }
    Ok(())
}
