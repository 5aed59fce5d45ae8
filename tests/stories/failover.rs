//! The network of a robot is degraded, and its application still gets answers.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{RosVersion, SerializedMessage, Subscription};
use support::Verdict;
use support::cable::{Cable, NetworkImpairment};
use support::daemon::Daemon;
use support::patience::{self, Deadline};
use support::people::{self, PeopleCamera, picture_of};
use support::site::{NodeProcess, Site};
use support::world::world;

/// Generous, because these machines are slow and the network is worse.
const T_MAX: f64 = 5.0;
const SLOW: NetworkImpairment = NetworkImpairment { rate: 100_000, delay: 15_000, jitter: 0, loss: 0.0, limit: 10_000 };
/// Polling interval for the stub's log.
const MOMENT: Duration = Duration::from_millis(50);
const SILENT: NetworkImpairment = NetworkImpairment { loss: 1.0, ..SLOW };

/// A camera and a subscriber for a people_detect that runs in the cloud, behind a cable.
struct FailoverScene {
    // Fields are in the order in which they must be dropped.
    camera: PeopleCamera,
    stub: NodeProcess,
    site: Site,
    cable: Cable,
    daemon: Arc<Daemon>,
    robot: String,
    answers: BTreeMap<u32, usize>,
    sent: u32,
}

impl FailoverScene {
    /// Creates a scene with these lines in `stub.toml`.
    fn new(ros: RosVersion, robot: &str, more: &str) -> anyhow::Result<Self> {
        let service = people::service(ros);
        let daemon = world().daemon_with(service)?;
        let robot = robot_name(robot, ros);
        Self::with_stub(ros, daemon, &robot, |site, daemon, cable| {
            people::stub(site, daemon, cable, (service.name, &robot), more, &[])
        })
    }

    /// Creates a scene with a stub that `start` starts.
    fn with_stub(
        ros: RosVersion,
        daemon: Arc<Daemon>,
        robot: &str,
        start: impl FnOnce(&Site, &Daemon, &Cable) -> anyhow::Result<NodeProcess>,
    ) -> anyhow::Result<Self> {
        let cable = Cable::new(&daemon.address)?;
        let site = Site::with_ros(ros)?;
        let stub = start(&site, &daemon, &cable)?;
        let camera = PeopleCamera::new(&site, 10);
        let camera = camera.with_context(|| format!("the stub said:\n{}", stub.output()))?;
        Ok(Self { camera, stub, site, cable, daemon, robot: robot.to_owned(), answers: BTreeMap::new(), sent: 0 })
    }

    /// Publishes an image; returns its number.
    fn publish_picture(&mut self) -> u32 {
        self.sent += 1;
        let picture = black_picture(self.site.system.version(), self.sent);
        self.camera.image.publish(picture);
        self.sent
    }

    /// Publishes images until one of them is answered: what is on its way at a hand-over may be lost.
    fn publish_until_answered(&mut self) -> Verdict {
        let first = self.sent + 1;
        let deadline = Deadline::begin();
        let mut next = Instant::now();
        while self.answers.range(first..).next().is_none() {
            deadline.check(|| format!("{:?}\n{}", self.answers, self.stub.output()))?;
            if Instant::now() >= next {
                self.publish_picture();
                next = Instant::now() + Duration::from_secs_f64(T_MAX);
            }
            self.receive_answer()?;
        }
        Ok(())
    }

    /// Waits until an image is answered, and records answers to others.
    fn wait_for_answer(&mut self, number: u32) -> Verdict {
        while !self.answers.contains_key(&number) {
            let message = self.site.next_message(&mut self.camera.found);
            let message = message.with_context(|| {
                let said = self.stub.output();
                format!("picture {number} of {}: {:?}\n{said}", self.sent, self.answers)
            })?;
            self.record_answer(&message)?;
        }
        Ok(())
    }

    fn record_answer(&mut self, answer: &SerializedMessage) -> Verdict {
        let answered = people::number(answer).context("a stamp")?;
        *self.answers.entry(answered).or_default() += 1;
        Ok(())
    }

    /// Publishes images that are not answered in time until the local original has been started `times` times. Two
    /// suffice, unless one is still answered by a local original that has not ended yet.
    fn publish_until_started(&mut self, times: usize) -> Verdict {
        let deadline = Deadline::begin();
        self.publish_picture();
        let mut next = Instant::now();
        while self.count_in_log("the local original is started") < times {
            deadline.check(|| format!("{:?}\n{}", self.answers, self.stub.output()))?;
            if Instant::now() >= next {
                self.publish_picture();
                next += Duration::from_secs_f64(T_MAX + 1.0);
            }
            self.receive_answer()?;
        }
        Ok(())
    }

    /// Records the next answer, if one arrives within a moment.
    fn receive_answer(&mut self) -> Verdict {
        if let Some(answer) = self.site.next_message_within(&mut self.camera.found, MOMENT)? {
            self.record_answer(&answer)?;
        }
        Ok(())
    }

    /// Publishes images at a limited rate until the local original has been stopped as often as it was started: images
    /// that were replaced by newer ones while the network was slow become late one by one, and may start it once more.
    fn publish_until_stopped(&mut self) -> Verdict {
        let deadline = Deadline::begin();
        let starts = |scene: &Self| scene.count_in_log("the local original is started");
        while self.count_in_log("the local original is stopped") < starts(self) {
            deadline.check(|| format!("it should be stopped:\n{}", self.stub.output()))?;
            let number = self.publish_picture();
            self.wait_for_answer(number)?;
            self.receive_answer()?;
        }
        Ok(())
    }

    /// Waits until the stub has logged these words a number of times.
    fn wait_for_log(&self, words: &str, times: usize) -> Verdict {
        self.stub.wait_for_output_times(words, times)
    }

    fn count_in_log(&self, words: &str) -> usize {
        self.stub.output().matches(words).count()
    }

    /// Publishes images, each after the answer to the previous one, until the stub has logged these words a number of
    /// times.
    fn publish_until_log(&mut self, words: &str, times: usize) -> Verdict {
        let deadline = Deadline::begin();
        while self.count_in_log(words) < times {
            deadline.check(|| format!("it should say {words:?}:\n{}", self.stub.output()))?;
            let number = self.publish_picture();
            self.wait_for_answer(number)?;
        }
        Ok(())
    }

    /// Waits until `explain` lists this cause.
    fn wait_for_cause(&self, words: &str) -> Verdict {
        let what = format!("an explanation that names {words:?}");
        self.daemon.wait_for(&self.explain_path(), &what, |explained| {
            explained["causes"].to_string().contains(words).then_some(())
        })
    }

    /// Waits until the last events about this robot's local original are of these kinds.
    fn wait_for_events(&self, kinds: &[&str]) -> Verdict {
        support::wait_until(&format!("events that end with {kinds:?}"), || {
            let events = self.daemon.api("/api/v1/events?limit=10000")?;
            let mine = events.as_array().context("a list")?.iter();
            let mine = mine.filter(|event| event["robot"] == *self.robot);
            let told: Vec<&str> = mine
                .filter_map(|event| event["kind"].as_str())
                .filter(|kind| kind.starts_with("local-") || kind.starts_with("cloud-"))
                .collect();
            Ok(if told.ends_with(kinds) { Ok(()) } else { Err(format!("{told:?}")) })
        })
    }

    /// Waits until the robot's diagnostics contain these words.
    fn wait_for_diagnostics(&self, diagnostics: &mut Subscription, words: &str) -> Verdict {
        let deadline = Deadline::begin();
        loop {
            let message = self.site.next_message(diagnostics)?;
            let said = String::from_utf8_lossy(&message.bytes);
            if said.contains(words) {
                return Ok(());
            }
            deadline.check(|| format!("diagnostics should say {words:?}: {said}"))?;
        }
    }

    /// Waits until `explain` reports this value for the link.
    fn wait_for_link_value(&self, key: &str, value: f64) -> Verdict {
        let what = format!("a link whose {key} is {value}");
        self.daemon.wait_for(&self.explain_path(), &what, |explained| {
            (explained["servants"][0]["links"][0][key] == value).then_some(())
        })
    }

    /// Returns how many of the latest requests were late.
    fn late_requests(&self) -> anyhow::Result<u64> {
        self.daemon.wait_for(&self.explain_path(), "a link that counts late requests", |explained| {
            explained["servants"][0]["links"][0]["late"].as_u64()
        })
    }

    /// Returns the API path that explains this robot.
    fn explain_path(&self) -> String {
        format!("/api/v1/robots/{}/explain", self.robot)
    }

    fn explain(&self) -> anyhow::Result<serde_json::Value> {
        self.daemon.api(&self.explain_path())
    }
}

pub fn a_slow_network_costs_few_requests(ros: RosVersion) -> Verdict {
    // Slow starts of the servant should not matter here.
    let more = format!("local = \"cold\"\ndesire = {T_MAX:?}\nmax = {T_MAX:?}\nfallback_after = 300.0");
    let mut scene = FailoverScene::new(ros, "failover-slow", &more)?;
    for _ in 0..3 {
        let number = scene.publish_picture();
        scene.wait_for_answer(number)?;
    }
    ensure!(scene.count_in_log("local original is started") == 0, "{}", scene.stub.output());
    for _ in 0..2 {
        let answers = "the local original answers, too";
        let times = scene.count_in_log(answers) + 1;
        scene.cable.degrade(SLOW)?;
        // Two late answers start it; it answers all further requests.
        scene.publish_until_started(scene.count_in_log("the local original is started") + 1)?;
        scene.wait_for_log(answers, times)?;
        let number = scene.publish_picture();
        for asked in 1..=number {
            scene.wait_for_answer(asked)?;
        }
        scene.cable.restore()?;
        scene.publish_until_stopped()?;
    }
    // The parts of the time are known for late answers that arrived; an image that was replaced by a newer one has
    // none.
    scene.wait_for_cause("requests of /people_detect exceeded T_max (5000 ms)")?;
    scene.wait_for_events(&["local-answers-too", "cloud-answers-alone"])?;
    // From the cloud alone: all of its earlier answers have arrived before this one.
    let last = scene.publish_picture();
    scene.wait_for_answer(last)?;
    let once: BTreeMap<u32, usize> = (1..=last).map(|number| (number, 1)).collect();
    ensure!(scene.answers == once, "{:?}\n{}", scene.answers, scene.stub.output());
    Ok(())
}

pub fn a_lost_link_hands_over_and_back(ros: RosVersion) -> Verdict {
    let daemon = world().ensure_shared()?;
    let robot = &*robot_name("failover-lost", ros);
    let service = &*format!("people_stateful{}", ros.number());
    let detector = people::service(ros);
    let stateful = ["--stateful", "--name", service];
    let arguments = [&stateful, detector.arguments].concat();
    match detector.package {
        Some(package) => daemon.deployer().push(package, &arguments)?,
        None => daemon.deployer().run(&[&["push"], &arguments[..]].concat())?,
    }
    .expect_success()?;
    // Late answers should not matter here: a busy machine must not cause a handover.
    let more = "local = \"warm\"\ndesire = 300.0\nmax = 300.0";
    let mut scene = FailoverScene::with_stub(ros, daemon, robot, |site, daemon, cable| {
        people::installed_stub(site, daemon, cable, (service, robot), more)
    })?;
    let watcher = scene.site.join("/watcher")?;
    let mut diagnostics = scene.site.subscribe(&watcher, "/diagnostics")?;
    scene.publish_until_answered()?;
    // Before the link was up for the first time the local original may have answered as well.
    let (over, back) = ("the local original answers, too why=LinkDown", "the cloud answers alone why=LinkUp");
    let before = scene.count_in_log(over);
    scene.wait_for_log(back, before)?;
    for round in 1..=2 {
        scene.cable.degrade(SILENT)?;
        scene.wait_for_log(over, before + round)?;
        scene.publish_until_answered()?;
        scene.wait_for_diagnostics(&mut diagnostics, "the link is down")?;
        scene.wait_for_cause("is down")?;
        scene.cable.restore()?;
        scene.wait_for_log(back, before + round)?;
        scene.publish_until_answered()?;
        scene.wait_for_diagnostics(&mut diagnostics, "the cloud answers")?;
    }
    let both = ["local-takes-over", "local-hands-back"];
    scene.wait_for_events(&both.repeat(before + 2))?;
    // The history shows when and why this happened.
    let history = scene.daemon.api(&format!("/api/v1/history/servants?robot={robot}"))?;
    let periods = history[0]["local"].as_array().context("periods")?;
    ensure!(periods.len() == before + 2, "{history:#}");
    for period in periods {
        let (began, ended) = (period["began"].as_u64(), period["ended"].as_u64());
        ensure!(began < ended && period["node"] == "/people_detect", "{history:#}");
        let why = period["why"].as_str().context("why")?;
        ensure!(why.ends_with("the link is down"), "{history:#}");
    }
    let listed = scene.daemon.deployer().run(&["events"])?.expect_success()?;
    for words in [
        "the local original takes over: the link is down",
        "the local original hands back: the link is up again",
        // For a stateful node: each side has processed images that the other has not.
        "the local original takes over without having received: ",
        "the cloud takes over without having received: ",
    ] {
        let words = format!("robot {robot}: /people_detect: {words}");
        ensure!(listed.stdout.contains(&words), "{words}: {}", listed.stdout);
    }
    let lost = " of /image since ";
    ensure!(listed.stdout.contains(lost), "{}", listed.stdout);
    scene.wait_for_cause("the cloud takes over without having received")?;
    scene.wait_for_diagnostics(&mut diagnostics, "lost at the last hand-over")?;
    ensure!(scene.answers.values().all(|times| *times == 1), "{:?}", scene.answers);
    Ok(())
}

pub fn frames_that_stay_away_stop_the_robot_and_wake_its_original(ros: RosVersion) -> Verdict {
    let rate = 1.0 / T_MAX;
    let more = format!(
        "local = \"cold\"\nframes_per_second = {rate}\nfallback_after = 300.0\n\
         safe_stop = {{ topic = \"/cmd_vel\", type = \"geometry_msgs/Twist\", message = {{ linear = {{ x = -0.5 }} }} \
         }}"
    );
    let mut scene = FailoverScene::new(ros, "failover-frames", &more)?;
    let wheels = scene.site.join("/wheels")?;
    let mut commands = scene.site.subscribe(&wheels, "/cmd_vel")?;
    let number = scene.publish_picture();
    scene.wait_for_answer(number)?;
    scene.cable.degrade(SILENT)?;
    // Without images, or without answers: no frame arrives in time.
    let command = scene.site.next_message(&mut commands)?;
    let (name, header) = match ros {
        RosVersion::One => ("geometry_msgs/Twist", 0),
        RosVersion::Two => ("geometry_msgs/msg/Twist", 4),
    };
    ensure!(
        command.wire_type.name == name
            && command.bytes.len() == header + 48
            && command.bytes[header..header + 8] == (-0.5_f64).to_le_bytes(),
        "{command:?}"
    );
    scene.wait_for_log("the local original answers, too", 1)?;
    let number = scene.publish_picture();
    scene.wait_for_answer(number)?;
    scene.cable.restore()?;
    scene.publish_until_log("the local original is stopped", 1)
}

pub fn outputs_that_become_too_old_wake_the_original(ros: RosVersion) -> Verdict {
    let desired = T_MAX / 2.0;
    let more = format!("local = \"cold\"\nage = {T_MAX:?}\ndesired_age = {desired:?}\nfallback_after = 300.0");
    let mut scene = FailoverScene::new(ros, "failover-age", &more)?;
    scene.wait_for_link_value("age", T_MAX * 1e3)?;
    scene.wait_for_link_value("desired_age", desired * 1e3)?;
    // The stamps of these images are in 1970, so any answer to them is too old.
    let number = scene.publish_picture();
    scene.wait_for_answer(number)?;
    scene.wait_for_log("the local original answers, too", 1)?;
    // Images with the current time are recent enough, as long as they arrive.
    scene.sent = unix_seconds()?;
    scene.publish_until_log("the local original is stopped", 1)?;
    let number = scene.publish_picture();
    scene.wait_for_answer(number)?;
    // Then none arrives.
    scene.cable.degrade(SILENT)?;
    scene.wait_for_log("the local original answers, too", 2)
}

pub fn a_first_sign_has_the_original_ready_before_it_is_needed(ros: RosVersion) -> Verdict {
    let more = format!("local = \"first-sign\"\ndesire = {T_MAX:?}\nmax = {T_MAX:?}\nfallback_after = 300.0");
    let mut scene = FailoverScene::new(ros, "failover-sign", &more)?;
    let number = scene.publish_picture();
    scene.wait_for_answer(number)?;
    let started = "the local original is started why=FirstSign";
    ensure!(scene.count_in_log("is started") == 0, "{}", scene.stub.output());
    // After one late request it is started, and gets no requests yet.
    scene.cable.degrade(SLOW)?;
    let late = scene.publish_picture();
    scene.wait_for_log(started, 1)?;
    scene.cable.restore()?;
    scene.wait_for_answer(late)?;
    ensure!(scene.count_in_log("answers, too") == 0, "{}", scene.stub.output());
    // After a long time without problems it is not needed any more.
    scene.publish_until_log("the local original is stopped", 1)?;
    ensure!(scene.count_in_log("answers, too") == 0, "{}", scene.stub.output());
    // Two late requests: the first starts it, after the second it answers.
    scene.cable.degrade(SLOW)?;
    scene.publish_picture();
    scene.wait_for_log(started, 2)?;
    scene.publish_picture();
    scene.wait_for_log("the local original answers, too", 1)?;
    let number = scene.publish_picture();
    scene.wait_for_answer(number)?;
    let said = scene.stub.output();
    let place = |words: &str| said.rfind(words);
    ensure!(place(started) < place("answers, too"), "{said}");
    Ok(())
}

/// Number of images of a fast camera, and the interval between two: 30 per second.
const FAST: (u32, Duration) = (150, Duration::from_nanos(33_333_333));
/// Width and height of its images.
const SIZE: (u32, u32) = (640, 480);

/// A camera that publishes at its rate, whether its images are answered or not.
struct FastCamera {
    pixels: Vec<u8>,
    /// When the next image is due.
    next: Instant,
}

impl FastCamera {
    fn new() -> Self {
        Self { pixels: vec![0; (SIZE.0 * SIZE.1 * 3) as usize], next: Instant::now() }
    }

    /// Publishes an image, and records the answers that arrive until the next one is due.
    fn publish(&mut self, scene: &mut FailoverScene) -> Verdict {
        scene.sent += 1;
        let picture = picture_of(scene.site.system.version(), scene.sent, SIZE, &self.pixels);
        scene.camera.image.publish(picture);
        self.next += FAST.1;
        while let Some(left) = self.next.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            if let Some(answer) = scene.site.next_message_within(&mut scene.camera.found, left)? {
                scene.record_answer(&answer)?;
            }
        }
        Ok(())
    }

    /// Publishes until an image is answered: one that is lost on its way is followed by others.
    fn publish_until_answered(&mut self, scene: &mut FailoverScene) -> Verdict {
        let deadline = Deadline::begin();
        while scene.answers.is_empty() {
            let state = || format!("none of {} images is answered:\n{}", scene.sent, scene.stub.output());
            deadline.check(state)?;
            self.publish(scene)?;
        }
        Ok(())
    }
}

pub fn a_camera_faster_than_its_node_stops_nobody(ros: RosVersion) -> Verdict {
    // On a slow machine the node needs longer, as everything does.
    let t_max = patience::scale(Duration::from_secs_f64(T_MAX)).as_secs_f64();
    let more = format!(
        "local = \"none\"\ndesire = {t_max:?}\nmax = {t_max:?}\n\
         safe_stop = {{ topic = \"/cmd_vel\", type = \"geometry_msgs/Twist\" }}"
    );
    let service = people::service(ros);
    let robot = robot_name("failover-camera", ros);
    // Beside servants of other stories this one might have next to no processor time.
    let daemon = Arc::new(world().setup(&robot).start()?);
    service.push_to(&daemon)?;
    let mut scene = FailoverScene::with_stub(ros, daemon, &robot, |site, daemon, cable| {
        people::stub(site, daemon, cable, (service.name, &robot), &more, &[])
    })?;
    FastCamera::new().publish_until_answered(&mut scene)?;
    let wheels = scene.site.join("/wheels")?;
    let mut commands = scene.site.subscribe(&wheels, "/cmd_vel")?;
    let before = scene.late_requests()?;
    // The node needs much longer for an image than the interval between two.
    let servant = scene.daemon.servant_of(service.name, &scene.robot)?;
    let id = servant["id"].as_str().context("an id")?;
    let cores = match ros {
        RosVersion::One => "0.3",
        RosVersion::Two => "0.1",
    };
    let less = ["set", id, "--cpus", cores];
    scene.daemon.deployer().run(&less)?.expect_success()?;
    let first = scene.sent + 1;
    let mut camera = FastCamera::new();
    for _ in 0..FAST.0 {
        camera.publish(&mut scene)?;
    }
    // The newest image is always answered.
    scene.wait_for_answer(scene.sent)?;
    // The camera of a slow machine is slow, too.
    let pictures = FAST.0 as usize;
    let left_out = pictures.saturating_sub(scene.answers.range(first..).count());
    ensure!(left_out >= 10, "{left_out} of {pictures} are left out: no story of a slow node");
    let stopped = scene.site.next_message_within(&mut commands, MOMENT)?;
    ensure!(stopped.is_none(), "{stopped:?}\n{}", scene.stub.output());
    // Earlier requests may have been late; they are forgotten as newer ones come.
    let late = scene.late_requests()?;
    ensure!(late <= before, "{late} requests were late, before {before}: {:#}", scene.explain()?);
    Ok(())
}

pub fn explain_says_why(ros: RosVersion) -> Verdict {
    let service = people::service(ros).name;
    let more = format!("local = \"none\"\ndesire = 0.001\nmax = {T_MAX:?}");
    let mut scene = FailoverScene::new(ros, "failover-why", &more)?;
    for _ in 0..3 {
        let number = scene.publish_picture();
        scene.wait_for_answer(number)?;
    }
    // The report contains where the time was spent.
    let path = format!("/api/v1/robots/{}/explain", scene.robot);
    let link = scene.daemon.wait_for(&path, "three requests", |explained| {
        let link = &explained["servants"][0]["links"][0];
        let phases = link["phases"].as_array().map_or(0, Vec::len);
        (link["requests"] == 3 && phases == 6).then(|| link.clone())
    })?;
    ensure!(link["max"] == T_MAX * 1e3, "the SLA is known: {link:#}");
    let (_, metrics) = scene.daemon.request("GET", "/metrics", &[])?;
    for family in ["cloudroid_request_seconds", "cloudroid_request_phase_seconds"] {
        let counted = metrics.lines().any(|line| {
            let count = line.rsplit(' ').next().and_then(|count| count.parse().ok());
            let of = format!("{family}_count{{service=\"{service}\"");
            line.starts_with(&of) && count >= Some(3)
        });
        ensure!(counted, "{family}: {metrics}");
    }
    // A topic name that does not match the publisher's.
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{}\"\nlocal = \"none\"\n",
        scene.daemon.address, service, scene.robot
    );
    let (package, argv): (_, &[&str]) = match ros {
        RosVersion::One => ("opencv_apps", &["__name:=astray", "image:=/nowhere"]),
        RosVersion::Two => ("seer_ros2", &["--ros-args", "-r", "__node:=astray", "-r", "image:=/nowhere"]),
    };
    let _astray = scene.site.start_stub_with_config(&toml, package, "people_detect", argv)?;
    let _listener = scene.site.subscribe(&scene.camera.node, "/astray/found")?;
    scene.wait_for_cause("/nowhere, which no node on the robot publishes")?;
    // Less of a core than the node needs.
    let servant = scene.daemon.servant_of(service, &scene.robot)?;
    let id = servant["id"].as_str().context("an id")?;
    let less = ["set", id, "--cpus", "0.05"];
    scene.daemon.deployer().run(&less)?.expect_success()?;
    // Each image takes 50 ms of a whole core.
    let deadline = Deadline::begin();
    while !scene.explain()?["causes"].to_string().contains("throttled by its CPU limit") {
        scene.sent += 1;
        let large = [0; 640 * 480 * 3];
        scene.camera.image.publish(picture_of(ros, scene.sent, (640, 480), &large));
        deadline.check(|| format!("{:#}", scene.explain().unwrap_or_default()))?;
    }
    // More at once than the link can carry: all but the newest are dropped.
    for _ in 0..10 {
        scene.publish_picture();
    }
    scene.wait_for_cause(" inputs of /people_detect were not sent in the last minute")
}

/// Returns the time in seconds since 1970.
fn unix_seconds() -> anyhow::Result<u32> {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?;
    Ok(u32::try_from(since.as_secs())?)
}

/// Returns a robot name that is unique for this version of ROS.
fn robot_name(robot: &str, ros: RosVersion) -> String {
    format!("{robot}-{}", ros.number())
}

/// Serializes a small black image.
fn black_picture(ros: RosVersion, number: u32) -> Bytes {
    const SIZE: (u32, u32) = (160, 120);
    picture_of(ros, number, SIZE, &[0; (SIZE.0 * SIZE.1 * 3) as usize])
}
