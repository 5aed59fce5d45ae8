//! The network of a robot becomes bad: its application is answered all the same.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{Message, RosVersion, Subscription};
use support::Verdict;
use support::cable::{Badness, Cable};
use support::daemon::Daemon;
use support::patience::Deadline;
use support::people::{self, Camera, picture_of};
use support::site::{Running, Site};
use support::world::world;

/// Generous: these machines are slow, and the network is worse yet.
const T_MAX: f64 = 5.0;
const SLOW: Badness = Badness {
    rate: 100_000,
    delay: 15_000,
    jitter: 0,
    loss: 0.0,
    limit: 10_000,
};
/// Between two looks at what a stub says.
const MOMENT: Duration = Duration::from_millis(50);
const SILENT: Badness = Badness { loss: 1.0, ..SLOW };

/// A camera and a listener before a people_detect that runs in the cloud, behind a cable.
struct Scene {
    // In the order in which they end.
    camera: Camera,
    stub: Running,
    site: Site,
    cable: Cable,
    daemon: Arc<Daemon>,
    robot: String,
    answers: BTreeMap<u32, usize>,
    sent: u32,
}

impl Scene {
    /// With these lines in `stub.toml`.
    fn new(ros: RosVersion, robot: &str, more: &str) -> anyhow::Result<Self> {
        let service = people::service(ros);
        let daemon = world().with(service)?;
        let robot = named(robot, ros);
        Self::before(ros, daemon, &robot, |site, daemon, cable| {
            people::stub(site, daemon, cable, (service.name, &robot), more, &[])
        })
    }

    /// With a stub that is started so.
    fn before(
        ros: RosVersion,
        daemon: Arc<Daemon>,
        robot: &str,
        start: impl FnOnce(&Site, &Daemon, &Cable) -> anyhow::Result<Running>,
    ) -> anyhow::Result<Self> {
        let cable = Cable::new(&daemon.address)?;
        let site = Site::of(ros)?;
        let stub = start(&site, &daemon, &cable)?;
        let camera = Camera::new(&site, 10);
        let camera = camera.with_context(|| format!("the stub said:\n{}", stub.said()))?;
        Ok(Self {
            camera,
            stub,
            site,
            cable,
            daemon,
            robot: robot.to_owned(),
            answers: BTreeMap::new(),
            sent: 0,
        })
    }

    /// Shows a picture; its number.
    fn asks(&mut self) -> u32 {
        self.sent += 1;
        let picture = black(self.site.system.version(), self.sent);
        self.camera.image.publish(picture);
        self.sent
    }

    /// Waits until this picture is answered; others are noted.
    fn hears(&mut self, number: u32) -> Verdict {
        while !self.answers.contains_key(&number) {
            let message = self.site.next(&mut self.camera.found);
            let message = message.with_context(|| {
                let said = self.stub.said();
                format!(
                    "picture {number} of {}: {:?}\n{said}",
                    self.sent, self.answers
                )
            })?;
            self.notes(&message)?;
        }
        Ok(())
    }

    fn notes(&mut self, answer: &Message) -> Verdict {
        let answered = people::number(answer).context("a stamp")?;
        *self.answers.entry(answered).or_default() += 1;
        Ok(())
    }

    /// Shows pictures that nobody answers in time until the local original is started, for so many times. Two suffice, unless one is answered all the same: by
    /// a local original that has not ended yet.
    fn asks_until_started(&mut self, times: usize) -> Verdict {
        let deadline = Deadline::begin();
        self.asks();
        let mut next = Instant::now();
        while self.count("the local original is started") < times {
            deadline.check(|| format!("{:?}\n{}", self.answers, self.stub.said()))?;
            if Instant::now() >= next {
                self.asks();
                next += Duration::from_secs_f64(T_MAX + 1.0);
            }
            self.listens()?;
        }
        Ok(())
    }

    /// Notes the next answer, if one comes in a moment.
    fn listens(&mut self) -> Verdict {
        if let Some(answer) = self.site.next_within(&mut self.camera.found, MOMENT)? {
            self.notes(&answer)?;
        }
        Ok(())
    }

    /// Shows pictures, not too many at once, until the local original has been stopped as often as it was started: pictures that gave way to newer ones while the
    /// network was slow are late one by one, and may start it once more.
    fn asks_until_stopped(&mut self) -> Verdict {
        let deadline = Deadline::begin();
        let starts = |scene: &Self| scene.count("the local original is started");
        while self.count("the local original is stopped") < starts(self) {
            deadline.check(|| format!("it should be stopped:\n{}", self.stub.said()))?;
            let number = self.asks();
            self.hears(number)?;
            self.listens()?;
        }
        Ok(())
    }

    /// Waits until the stub has said this so many times.
    fn says(&self, words: &str, times: usize) -> Verdict {
        self.stub.says_times(words, times)
    }

    fn count(&self, words: &str) -> usize {
        self.stub.said().matches(words).count()
    }

    /// Shows pictures, one after the other is answered, until the stub has said this so many times.
    fn asks_until(&mut self, words: &str, times: usize) -> Verdict {
        let deadline = Deadline::begin();
        while self.count(words) < times {
            deadline.check(|| format!("it should say {words:?}:\n{}", self.stub.said()))?;
            let number = self.asks();
            self.hears(number)?;
        }
        Ok(())
    }

    /// Waits until `explain` names this.
    fn explains(&self, words: &str) -> Verdict {
        let what = format!("an explanation that names {words:?}");
        self.daemon.awaits(&self.explanation(), &what, |explained| {
            explained["causes"]
                .to_string()
                .contains(words)
                .then_some(())
        })
    }

    /// Waits until the last events of this robot about its local original are of these kinds.
    fn happened(&self, kinds: &[&str]) -> Verdict {
        support::until(&format!("events that end with {kinds:?}"), || {
            let events = self.daemon.api("/api/v1/events?limit=10000")?;
            let mine = events.as_array().context("a list")?.iter();
            let mine = mine.filter(|event| event["robot"] == *self.robot);
            let told: Vec<&str> = mine
                .filter_map(|event| event["kind"].as_str())
                .filter(|kind| kind.starts_with("local-") || kind.starts_with("cloud-"))
                .collect();
            Ok(if told.ends_with(kinds) {
                Ok(())
            } else {
                Err(format!("{told:?}"))
            })
        })
    }

    /// Waits until the robot's diagnostics say this.
    fn diagnosed(&self, diagnostics: &mut Subscription, words: &str) -> Verdict {
        let deadline = Deadline::begin();
        loop {
            let message = self.site.next(diagnostics)?;
            let said = String::from_utf8_lossy(&message.bytes);
            if said.contains(words) {
                return Ok(());
            }
            deadline.check(|| format!("diagnostics should say {words:?}: {said}"))?;
        }
    }

    /// Waits until `explain` has this of the link.
    fn explains_link(&self, key: &str, value: f64) -> Verdict {
        let what = format!("a link whose {key} is {value}");
        self.daemon.awaits(&self.explanation(), &what, |explained| {
            (explained["servants"][0]["links"][0][key] == value).then_some(())
        })
    }

    /// Where the API explains this robot.
    fn explanation(&self) -> String {
        format!("/api/v1/robots/{}/explain", self.robot)
    }

    fn explained(&self) -> anyhow::Result<serde_json::Value> {
        self.daemon.api(&self.explanation())
    }
}

pub fn a_slow_network_costs_few_requests(ros: RosVersion) -> Verdict {
    // A servant that is slow to start is not what this is about.
    let more =
        format!("local = \"cold\"\ndesire = {T_MAX:?}\nmax = {T_MAX:?}\nfallback_after = 300.0");
    let mut scene = Scene::new(ros, "failover-slow", &more)?;
    for _ in 0..3 {
        let number = scene.asks();
        scene.hears(number)?;
    }
    ensure!(
        scene.count("local original is started") == 0,
        "{}",
        scene.stub.said()
    );
    for _ in 0..2 {
        let answers = "the local original answers, too";
        let times = scene.count(answers) + 1;
        scene.cable.degrade(SLOW)?;
        // Two that are late let it start; whatever is asked from then on is answered by it.
        scene.asks_until_started(scene.count("the local original is started") + 1)?;
        scene.says(answers, times)?;
        let number = scene.asks();
        for asked in 1..=number {
            scene.hears(asked)?;
        }
        scene.cable.restore()?;
        scene.asks_until_stopped()?;
    }
    // In which part the time went is known of late answers that came: of a picture that gave way to a newer one none does.
    scene.explains("requests of /people_detect passed T_max (5000 ms)")?;
    scene.happened(&["local-answers-too", "cloud-answers-alone"])?;
    // The cloud alone: what it still owed has come before this.
    let last = scene.asks();
    scene.hears(last)?;
    let once: BTreeMap<u32, usize> = (1..=last).map(|number| (number, 1)).collect();
    ensure!(
        scene.answers == once,
        "{:?}\n{}",
        scene.answers,
        scene.stub.said()
    );
    Ok(())
}

pub fn a_lost_link_hands_over_and_back(ros: RosVersion) -> Verdict {
    let daemon = world().shared()?;
    let robot = &*named("failover-lost", ros);
    let service = &*format!("people_stateful{}", ros.number());
    let detector = people::service(ros);
    let stateful = ["--stateful", "--name", service];
    let arguments = [&stateful, detector.arguments].concat();
    match detector.package {
        Some(package) => daemon.deployer().pushes(package, &arguments)?,
        None => daemon
            .deployer()
            .types(&[&["push"], &arguments[..]].concat())?,
    }
    .succeeded()?;
    // Lateness is not what this is about: a busy machine must not hand over.
    let more = "local = \"warm\"\ndesire = 300.0\nmax = 300.0";
    let mut scene = Scene::before(ros, daemon, robot, |site, daemon, cable| {
        people::installed_stub(site, daemon, cable, (service, robot), more)
    })?;
    let watcher = scene.site.joins("/watcher")?;
    let mut diagnostics = scene.site.hears(&watcher, "/diagnostics")?;
    let number = scene.asks();
    scene.hears(number)?;
    // Before the link was up for the first time the local original may have answered, too.
    let (over, back) = (
        "the local original answers, too why=LinkDown",
        "the cloud answers alone why=LinkUp",
    );
    let before = scene.count(over);
    scene.says(back, before)?;
    for round in 1..=2 {
        scene.cable.degrade(SILENT)?;
        scene.says(over, before + round)?;
        let number = scene.asks();
        scene.hears(number)?;
        scene.diagnosed(&mut diagnostics, "the link is down")?;
        scene.explains("is down")?;
        scene.cable.restore()?;
        scene.says(back, before + round)?;
        let number = scene.asks();
        scene.hears(number)?;
        scene.diagnosed(&mut diagnostics, "the cloud answers")?;
    }
    let both = ["local-takes-over", "local-hands-back"];
    scene.happened(&both.repeat(before + 2))?;
    // The history tells when it was so, and why.
    let history = scene
        .daemon
        .api(&format!("/api/v1/history/servants?robot={robot}"))?;
    let periods = history[0]["local"].as_array().context("periods")?;
    ensure!(periods.len() == before + 2, "{history:#}");
    for period in periods {
        let (began, ended) = (period["began"].as_u64(), period["ended"].as_u64());
        ensure!(
            began < ended && period["node"] == "/people_detect",
            "{history:#}"
        );
        let why = period["why"].as_str().context("why")?;
        ensure!(why.ends_with("the link is down"), "{history:#}");
    }
    let listed = scene.daemon.deployer().types(&["events"])?.succeeded()?;
    for words in [
        "the local original takes over: the link is down",
        "the local original hands back: the link is up again",
        // Stateful: each has pictures in its state that the other was not given.
        "the local original goes on without what it was not given: ",
        "the cloud goes on without what it was not given: ",
    ] {
        let words = format!("robot {robot}: /people_detect: {words}");
        ensure!(listed.stdout.contains(&words), "{words}: {}", listed.stdout);
    }
    let lost = " of /image since ";
    ensure!(listed.stdout.contains(lost), "{}", listed.stdout);
    scene.explains("the cloud goes on without what it was not given")?;
    scene.diagnosed(&mut diagnostics, "lost at the last hand-over")?;
    ensure!(
        scene.answers.values().all(|times| *times == 1),
        "{:?}",
        scene.answers
    );
    Ok(())
}

pub fn frames_that_stay_away_stop_the_robot_and_wake_its_original(ros: RosVersion) -> Verdict {
    let rate = 1.0 / T_MAX;
    let more = format!(
        "local = \"cold\"\nframes_per_second = {rate}\nfallback_after = 300.0\n\
         safe_stop = {{ topic = \"/cmd_vel\", type = \"geometry_msgs/Twist\", message = {{ linear = {{ x = -0.5 }} }} }}"
    );
    let mut scene = Scene::new(ros, "failover-frames", &more)?;
    let wheels = scene.site.joins("/wheels")?;
    let mut commands = scene.site.hears(&wheels, "/cmd_vel")?;
    let number = scene.asks();
    scene.hears(number)?;
    scene.cable.degrade(SILENT)?;
    // Nobody shows a picture, or nobody could answer: no frame comes in time.
    let command = scene.site.next(&mut commands)?;
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
    scene.says("the local original answers, too", 1)?;
    let number = scene.asks();
    scene.hears(number)?;
    scene.cable.restore()?;
    scene.asks_until("the local original is stopped", 1)
}

pub fn outputs_that_become_too_old_wake_the_original(ros: RosVersion) -> Verdict {
    let desired = T_MAX / 2.0;
    let more = format!(
        "local = \"cold\"\nage = {T_MAX:?}\ndesired_age = {desired:?}\nfallback_after = 300.0"
    );
    let mut scene = Scene::new(ros, "failover-age", &more)?;
    scene.explains_link("age", T_MAX * 1e3)?;
    scene.explains_link("desired_age", desired * 1e3)?;
    // Stamps are when a picture was taken: those of our pictures are of 1970, and any answer to them is too old.
    let number = scene.asks();
    scene.hears(number)?;
    scene.says("the local original answers, too", 1)?;
    // Fresh ones are young enough, as long as they come.
    scene.sent = now()?;
    scene.asks_until("the local original is stopped", 1)?;
    let number = scene.asks();
    scene.hears(number)?;
    // Then none comes.
    scene.cable.degrade(SILENT)?;
    scene.says("the local original answers, too", 2)
}

pub fn a_first_sign_has_the_original_ready_before_it_is_needed(ros: RosVersion) -> Verdict {
    let more = format!(
        "local = \"first-sign\"\ndesire = {T_MAX:?}\nmax = {T_MAX:?}\nfallback_after = 300.0"
    );
    let mut scene = Scene::new(ros, "failover-sign", &more)?;
    let number = scene.asks();
    scene.hears(number)?;
    let started = "the local original is started why=FirstSign";
    ensure!(scene.count("is started") == 0, "{}", scene.stub.said());
    // One late request: it is started, and asked nothing.
    scene.cable.degrade(SLOW)?;
    let late = scene.asks();
    scene.says(started, 1)?;
    scene.cable.restore()?;
    scene.hears(late)?;
    ensure!(scene.count("answers, too") == 0, "{}", scene.stub.said());
    // All is well for long: it is not needed.
    scene.asks_until("the local original is stopped", 1)?;
    ensure!(scene.count("answers, too") == 0, "{}", scene.stub.said());
    // Two late requests: it was started by the first, and answers after the second.
    scene.cable.degrade(SLOW)?;
    scene.asks();
    scene.says(started, 2)?;
    scene.asks();
    scene.says("the local original answers, too", 1)?;
    let number = scene.asks();
    scene.hears(number)?;
    let said = scene.stub.said();
    let place = |words: &str| said.rfind(words);
    ensure!(place(started) < place("answers, too"), "{said}");
    Ok(())
}

/// Pictures of the story of a fast camera, and the time between two: 30 a second.
const FAST: (u32, Duration) = (150, Duration::from_nanos(33_333_333));

pub fn a_camera_faster_than_its_node_stops_nobody(ros: RosVersion) -> Verdict {
    const SIZE: (u32, u32) = (640, 480);
    let more = format!(
        "local = \"none\"\ndesire = {T_MAX:?}\nmax = {T_MAX:?}\n\
         safe_stop = {{ topic = \"/cmd_vel\", type = \"geometry_msgs/Twist\" }}"
    );
    let mut scene = Scene::new(ros, "failover-camera", &more)?;
    let wheels = scene.site.joins("/wheels")?;
    let mut commands = scene.site.hears(&wheels, "/cmd_vel")?;
    let number = scene.asks();
    scene.hears(number)?;
    // A picture takes it much longer than the time to the next one.
    let servant = scene
        .daemon
        .servant_of(people::service(ros).name, &scene.robot)?;
    let id = servant["id"].as_str().context("an id")?;
    let cores = match ros {
        RosVersion::One => "0.3",
        RosVersion::Two => "0.1",
    };
    let less = ["set", id, "--cpus", cores];
    scene.daemon.deployer().types(&less)?.succeeded()?;
    let pixels = vec![0; (SIZE.0 * SIZE.1 * 3) as usize];
    let (pictures, pause) = FAST;
    let mut next = Instant::now();
    for _ in 0..pictures {
        scene.sent += 1;
        let picture = picture_of(ros, scene.sent, SIZE, &pixels);
        scene.camera.image.publish(picture);
        next += pause;
        while let Some(left) = next
            .checked_duration_since(Instant::now())
            .filter(|left| !left.is_zero())
        {
            if let Some(answer) = scene.site.next_within(&mut scene.camera.found, left)? {
                scene.notes(&answer)?;
            }
        }
    }
    // The newest is never left out.
    scene.hears(scene.sent)?;
    let answered = scene.answers.len();
    ensure!(
        answered < pictures as usize / 2,
        "it answers {answered} of {pictures}: no story of a slow node"
    );
    let stopped = scene.site.next_within(&mut commands, MOMENT)?;
    ensure!(stopped.is_none(), "{stopped:?}\n{}", scene.stub.said());
    scene.explains_link("late", 0.0)
}

pub fn explain_says_why(ros: RosVersion) -> Verdict {
    let service = people::service(ros).name;
    let more = format!("local = \"none\"\ndesire = 0.001\nmax = {T_MAX:?}");
    let mut scene = Scene::new(ros, "failover-why", &more)?;
    for _ in 0..3 {
        let number = scene.asks();
        scene.hears(number)?;
    }
    // Where the time went has been told.
    let path = format!("/api/v1/robots/{}/explain", scene.robot);
    let link = scene.daemon.awaits(&path, "three requests", |explained| {
        let link = &explained["servants"][0]["links"][0];
        let phases = link["phases"].as_array().map_or(0, Vec::len);
        (link["requests"] == 3 && phases == 6).then(|| link.clone())
    })?;
    ensure!(link["max"] == T_MAX * 1e3, "the SLA is known: {link:#}");
    let (_, metrics) = scene.daemon.request("GET", "/metrics", &[])?;
    for family in [
        "cloudroid_request_seconds",
        "cloudroid_request_phase_seconds",
    ] {
        let counted = metrics.lines().any(|line| {
            let count = line.rsplit(' ').next().and_then(|count| count.parse().ok());
            let of = format!("{family}_count{{service=\"{service}\"");
            line.starts_with(&of) && count >= Some(3)
        });
        ensure!(counted, "{family}: {metrics}");
    }
    // A topic that is named otherwise than it is published.
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{}\"\nlocal = \"none\"\n",
        scene.daemon.address, service, scene.robot
    );
    let (package, argv): (_, &[&str]) = match ros {
        RosVersion::One => ("opencv_apps", &["__name:=astray", "image:=/nowhere"]),
        RosVersion::Two => (
            "seer_ros2",
            &[
                "--ros-args",
                "-r",
                "__node:=astray",
                "-r",
                "image:=/nowhere",
            ],
        ),
    };
    let _astray = scene
        .site
        .stub_with(&toml, package, "people_detect", argv)?;
    let _listener = scene.site.hears(&scene.camera.node, "/astray/found")?;
    scene.explains("/nowhere, which nobody on the robot publishes")?;
    // Less of a core than it needs.
    let servant = scene.daemon.servant_of(service, &scene.robot)?;
    let id = servant["id"].as_str().context("an id")?;
    let less = ["set", id, "--cpus", "0.05"];
    scene.daemon.deployer().types(&less)?.succeeded()?;
    // Each takes it half a tenth of a second of a whole core.
    let deadline = Deadline::begin();
    while !scene.explained()?["causes"]
        .to_string()
        .contains("held back by its CPU limit")
    {
        scene.sent += 1;
        let large = [0; 640 * 480 * 3];
        scene
            .camera
            .image
            .publish(picture_of(ros, scene.sent, (640, 480), &large));
        deadline.check(|| format!("{:#}", scene.explained().unwrap_or_default()))?;
    }
    // More at once than the link takes: all but the newest give way.
    for _ in 0..10 {
        scene.asks();
    }
    scene.explains(" inputs of /people_detect were not sent in the last minute")
}

/// Seconds since 1970.
fn now() -> anyhow::Result<u32> {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?;
    Ok(u32::try_from(since.as_secs())?)
}

/// A robot's name in the story of this ROS.
fn named(robot: &str, ros: RosVersion) -> String {
    format!("{robot}-{}", ros.number())
}

/// A small picture.
fn black(ros: RosVersion, number: u32) -> Bytes {
    const SIZE: (u32, u32) = (160, 120);
    picture_of(ros, number, SIZE, &[0; (SIZE.0 * SIZE.1 * 3) as usize])
}
