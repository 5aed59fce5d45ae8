//! The network of a robot becomes bad: its application is answered all the same.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use bytes::{BufMut, Bytes, BytesMut};
use ros::bus::{AdvertiseOptions, Bus, Publisher, Subscription, WireType};
use ros::ros1::Ros1Bus;
use support::Told;
use support::cable::{Badness, Cable};
use support::daemon::Daemon;
use support::robot::PATIENCE;
use support::site::{Running, Site};
use support::world::{PEOPLE, world};

/// Generous: these machines are slow, and the network is worse yet.
const T_MAX: f64 = 5.0;
const SLOW: Badness = Badness {
    rate: 100_000,
    delay: 15_000,
    loss: 0.0,
    limit: 10_000,
};
const SILENT: Badness = Badness { loss: 1.0, ..SLOW };
const ARGUMENTS: [&str; 2] = ["__name:=people_detect", "_debug_view:=false"];
const PROGRAM: &str = "/usr/lib/opencv_apps/people_detect";

/// A camera and a listener before a people_detect that runs in the cloud, behind a cable.
struct Scene {
    // In the order in which they end.
    found: Subscription,
    image: Box<dyn Publisher>,
    app: Arc<Ros1Bus>,
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
    fn new(robot: &str, more: &str) -> anyhow::Result<Self> {
        let daemon = world().with(PEOPLE)?;
        let cable = Cable::new(&daemon.address)?;
        let site = Site::new()?;
        let people = ("opencv_apps", "people_detect");
        let workspace = site.installs_original(&daemon, PEOPLE.name, people, PROGRAM)?;
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{robot}\"\nthreshold = 4.0\ninitial = 15.0\n{more}",
            cable.server, PEOPLE.name
        );
        let workspace = workspace.to_string_lossy().into_owned();
        let environment = [("CMAKE_PREFIX_PATH", workspace.as_str()), ("NO_COLOR", "1")];
        let stub = site.stub_among(&environment, &toml, people.0, people.1, &ARGUMENTS)?;
        let app = site.node("/camera")?;
        let found = site.hears(&app, "/people_detect/found")?;
        let image = AdvertiseOptions {
            wire_type: WireType {
                name: "sensor_msgs/Image".into(),
                md5: "060021388200f6f0f447d0fcd9c64743".into(),
                definition: IMAGE.into(),
            },
            latch: false,
            queue: 10,
        };
        let image = site.runtime.block_on(app.advertise("/image", image))?;
        site.connected(&*image, 1)
            .with_context(|| format!("the stub said:\n{}", stub.said()))?;
        Ok(Self {
            found,
            image,
            app,
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
        self.image.publish(picture(self.sent));
        self.sent
    }

    /// Waits until this picture is answered; others are noted.
    fn hears(&mut self, number: u32) -> Told {
        while !self.answers.contains_key(&number) {
            let message = self.site.next(&mut self.found);
            let message = message.with_context(|| {
                let said = self.stub.said();
                format!(
                    "picture {number} of {}: {:?}\n{said}",
                    self.sent, self.answers
                )
            })?;
            let stamp = message.bytes.get(4..8).context("a stamp")?;
            let stamp = u32::from_le_bytes(stamp.try_into()?);
            *self.answers.entry(stamp).or_default() += 1;
        }
        Ok(())
    }

    /// Waits until the stub has said this so many times.
    fn says(&self, words: &str, times: usize) -> Told {
        let deadline = Instant::now() + PATIENCE;
        while self.count(words) < times {
            ensure!(
                Instant::now() < deadline,
                "it should say {words:?}:\n{}",
                self.stub.said()
            );
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }

    fn count(&self, words: &str) -> usize {
        self.stub.said().matches(words).count()
    }

    /// Shows pictures, one after the other is answered, until the stub has said this so many times.
    fn asks_until(&mut self, words: &str, times: usize) -> Told {
        let deadline = Instant::now() + PATIENCE;
        while self.count(words) < times {
            if Instant::now() > deadline {
                bail!("it should say {words:?}:\n{}", self.stub.said());
            }
            let number = self.asks();
            self.hears(number)?;
        }
        Ok(())
    }

    /// Waits until `explain` names this.
    fn explains(&self, words: &str) -> Told {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let explained = self.explained()?;
            let causes = explained["causes"].to_string();
            if causes.contains(words) {
                return Ok(());
            }
            ensure!(
                Instant::now() < deadline,
                "it should name {words:?}: {explained:#}"
            );
        }
    }

    /// Waits until the robot's diagnostics say this.
    fn diagnosed(&self, diagnostics: &mut Subscription, words: &str) -> Told {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let message = self.site.next(diagnostics)?;
            ensure!(
                Instant::now() < deadline,
                "diagnostics should say {words:?}: {}",
                String::from_utf8_lossy(&message.bytes)
            );
            if String::from_utf8_lossy(&message.bytes).contains(words) {
                return Ok(());
            }
        }
    }

    fn explained(&self) -> anyhow::Result<serde_json::Value> {
        self.daemon.deployer().asks(&["explain", &self.robot])
    }
}

pub fn a_slow_network_costs_few_requests() -> Told {
    let more = format!("local = \"cold\"\ndesire = {T_MAX:?}\nmax = {T_MAX:?}");
    let mut scene = Scene::new("failover-slow", &more)?;
    for _ in 0..3 {
        let number = scene.asks();
        scene.hears(number)?;
    }
    ensure!(
        scene.count("local original is started") == 0,
        "{}",
        scene.stub.said()
    );
    for onset in 1..=2 {
        scene.cable.degrade(SLOW)?;
        // Two that are late let it start; whatever is asked from then on is answered by it.
        for _ in 0..2 {
            scene.asks();
        }
        scene.says("the local original is started", onset)?;
        scene.says("the local original answers, too", onset)?;
        let number = scene.asks();
        scene.hears(number)?;
        for late in [number - 2, number - 1] {
            scene.hears(late)?;
        }
        scene.cable.restore()?;
        scene.asks_until("the local original is stopped", onset)?;
        ensure!(
            scene.count("the local original is started") == onset,
            "{}",
            scene.stub.said()
        );
    }
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

pub fn a_lost_link_hands_over_and_back() -> Told {
    let more = format!("local = \"warm\"\nstateful = true\ndesire = {T_MAX:?}\nmax = {T_MAX:?}");
    let mut scene = Scene::new("failover-lost", &more)?;
    let watcher = scene.site.node("/watcher")?;
    let mut diagnostics = scene.site.hears(&watcher, "/diagnostics")?;
    let number = scene.asks();
    scene.hears(number)?;
    // Before the link was up for the first time the local original may have answered, too.
    let (over, back) = (
        "the local original answers, too why=LinkDown",
        "the cloud answers alone why=LinkUp",
    );
    let before = (scene.count(over), scene.count(back));
    for round in 1..=2 {
        scene.cable.degrade(SILENT)?;
        scene.says(over, before.0 + round)?;
        let number = scene.asks();
        scene.hears(number)?;
        scene.diagnosed(&mut diagnostics, "the link is down")?;
        scene.explains("is down")?;
        scene.cable.restore()?;
        scene.says(back, before.1 + round)?;
        let number = scene.asks();
        scene.hears(number)?;
        scene.diagnosed(&mut diagnostics, "the cloud answers")?;
    }
    ensure!(
        scene.answers.values().all(|times| *times == 1),
        "{:?}",
        scene.answers
    );
    Ok(())
}

pub fn frames_that_stay_away_stop_the_robot_and_wake_its_original() -> Told {
    let rate = 1.0 / T_MAX;
    let more = format!(
        "local = \"cold\"\nframes_per_second = {rate}\n\
         safe_stop = {{ topic = \"/cmd_vel\", type = \"geometry_msgs/Twist\", message = {{ linear = {{ x = -0.5 }} }} }}"
    );
    let mut scene = Scene::new("failover-frames", &more)?;
    let wheels = scene.site.node("/wheels")?;
    let mut commands = scene.site.hears(&wheels, "/cmd_vel")?;
    let number = scene.asks();
    scene.hears(number)?;
    scene.cable.degrade(SILENT)?;
    // Nobody shows a picture, or nobody could answer: no frame comes in time.
    let command = scene.site.next(&mut commands)?;
    ensure!(
        command.wire_type.name == "geometry_msgs/Twist"
            && command.bytes.len() == 48
            && command.bytes[..8] == (-0.5_f64).to_le_bytes(),
        "{command:?}"
    );
    scene.says("the local original answers, too", 1)?;
    let number = scene.asks();
    scene.hears(number)?;
    scene.cable.restore()?;
    scene.asks_until("the local original is stopped", 1)
}

pub fn explain_says_why() -> Told {
    let more = format!("local = \"none\"\ndesire = 0.001\nmax = {T_MAX:?}");
    let mut scene = Scene::new("failover-why", &more)?;
    for _ in 0..3 {
        let number = scene.asks();
        scene.hears(number)?;
    }
    // Where the time went has been told.
    let deadline = Instant::now() + PATIENCE;
    loop {
        let explained = scene.explained()?;
        let link = &explained["servants"][0]["links"][0];
        let phases = link["phases"].as_array().map_or(0, Vec::len);
        if link["requests"] == 3 && phases == 6 {
            ensure!(link["max"] == T_MAX * 1e3, "the SLA is known: {link:#}");
            break;
        }
        ensure!(
            Instant::now() < deadline,
            "{explained:#}\n{}",
            scene.stub.said()
        );
    }
    // A topic that is named otherwise than it is published.
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{}\"\nlocal = \"none\"\n",
        scene.daemon.address, PEOPLE.name, scene.robot
    );
    let argv = ["__name:=astray", "image:=/nowhere"];
    let _astray = scene
        .site
        .stub_with(&toml, "opencv_apps", "people_detect", &argv)?;
    let _listener = scene.site.hears(&scene.app, "/astray/found")?;
    scene.explains("/nowhere, which nobody on the robot publishes")?;
    // Less of a core than it needs.
    let servant = scene.daemon.servant_of(PEOPLE.name, &scene.robot)?;
    let id = servant["id"].as_str().context("an id")?;
    let less = ["set", id, "--cpus", "0.05"];
    scene.daemon.deployer().types(&less)?.succeeded()?;
    for _ in 0..50 {
        scene.asks();
    }
    scene.explains("held back by its CPU limit")
}

/// A `sensor_msgs/Image` of 160x120, black.
fn picture(number: u32) -> Bytes {
    const SIZE: (u32, u32) = (160, 120);
    let pixels = vec![0; (SIZE.0 * SIZE.1 * 3) as usize];
    let mut out = BytesMut::with_capacity(pixels.len() + 64);
    let text = |out: &mut BytesMut, text: &str| {
        out.put_u32_le(text.len() as u32);
        out.put_slice(text.as_bytes());
    };
    for word in [number, number, 0] {
        out.put_u32_le(word);
    }
    text(&mut out, "camera");
    out.put_u32_le(SIZE.1);
    out.put_u32_le(SIZE.0);
    text(&mut out, "bgr8");
    out.put_u8(0);
    out.put_u32_le(SIZE.0 * 3);
    out.put_u32_le(pixels.len() as u32);
    out.put_slice(&pixels);
    out.freeze()
}

const IMAGE: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
    uint32 step\nuint8[] data\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n";
