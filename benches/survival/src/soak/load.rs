//! The load: twenty robots of several kinds, half of them with a service of ROS 1 and half with one of ROS 2, and an
//! operator who queries the API.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::Scope;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use ros::bus::RosVersion;
use serde_json::json;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::Site;
use support::twins::{self, Twin};

use crate::greeters;

/// Versions of ROS of the services.
pub(super) const BOTH: [RosVersion; 2] = [RosVersion::One, RosVersion::Two];
/// Robots of each kind for each version of ROS; twenty in all, with one without a name and one with a stub for each.
const CALLERS: usize = 4;
const TALKERS: usize = 2;
const RETURNERS: usize = 2;
/// Interval between two actions of a robot.
const PACE: Duration = Duration::from_millis(100);
/// Interval for robots that return, or have no name and are given a servant of their own.
const VISIT: Duration = Duration::from_secs(2);
/// Interval for the operator.
const LOOK: Duration = Duration::from_secs(1);
/// Size in bytes of a message that a talker publishes and receives.
const MESSAGE: usize = 100_000;

/// Results of all robots.
#[derive(Debug, Default)]
pub(super) struct Tally {
    pub(super) done: u64,
    /// Failures, in words.
    pub(super) failures: Vec<String>,
    /// Calls of the callers: time and duration.
    pub(super) calls: Vec<CallSample>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct CallSample {
    pub(super) ros: RosVersion,
    pub(super) made: Instant,
    pub(super) took: Duration,
}

/// Publishes the node of ROS 2.
pub(super) fn publish_twin(daemon: &Daemon) -> Result<()> {
    let service = Twin::greeter(RosVersion::Two).service;
    eprintln!("pushing {}", service.name);
    let package = service.package.context("a package of ours")?;
    daemon.deployer().push(package, &["--node", "greeter"])?.expect_success().map(drop)
}

/// Returns the URL path of a robot's servant.
fn robot_path(ros: RosVersion, robot: &str) -> String {
    format!("{}?robot={robot}", Twin::greeter(ros).service.name)
}

/// Calls the node.
fn call_node(robot: &mut Robot, ros: RosVersion) -> Result<()> {
    match ros {
        RosVersion::One => greeters::greeting_count(robot).map(drop),
        RosVersion::Two => {
            let answer = robot.call("/greeter/count", json!({}))?;
            ensure!(answer["values"]["success"] == true, "{answer}");
            Ok(())
        }
    }
}

/// All robots at work.
pub(super) struct MixedLoad<'a> {
    daemon: &'a Daemon,
    over: AtomicBool,
    tally: Mutex<Tally>,
}

impl<'a> MixedLoad<'a> {
    pub(super) fn new(daemon: &'a Daemon) -> Self {
        Self { daemon, over: AtomicBool::new(false), tally: Mutex::default() }
    }

    /// Starts all robots, each on a thread of its own; they work until [`MixedLoad::end`].
    pub(super) fn start<'scope>(&'scope self, scope: &'scope Scope<'scope, '_>) {
        for ros in BOTH {
            for number in 0..CALLERS {
                scope.spawn(move || self.run_caller(ros, &format!("caller-{number}-{}", ros.number())));
            }
            for number in 0..TALKERS {
                scope.spawn(move || self.run_talker(ros, &format!("talker-{number}-{}", ros.number())));
            }
            for number in 0..RETURNERS {
                scope.spawn(move || self.run_returner(ros, &format!("returner-{number}-{}", ros.number())));
            }
            scope.spawn(move || self.run_visitor(ros));
            scope.spawn(move || {
                if let Err(error) = self.run_link(ros) {
                    self.fail("a robot with a stub", &error);
                }
            });
        }
        scope.spawn(|| self.run_operator());
    }

    /// Ends the load.
    pub(super) fn end(&self) {
        self.over.store(true, Ordering::Relaxed);
    }

    /// Returns the results.
    pub(super) fn into_tally(self) -> Result<Tally> {
        self.tally.into_inner().map_err(|_| anyhow!("a robot panicked"))
    }

    fn record(&self, note: impl FnOnce(&mut Tally)) {
        if let Ok(mut tally) = self.tally.lock() {
            note(&mut tally);
        }
    }

    fn fail(&self, who: &str, error: &anyhow::Error) {
        eprintln!("{who}: {error:#}");
        self.record(|tally| tally.failures.push(format!("{who}: {error:#}")));
    }

    /// Repeats an action until the load ends.
    fn repeat(&self, who: &str, pause: Duration, mut act: impl FnMut() -> Result<()>) {
        while !self.over.load(Ordering::Relaxed) {
            match act() {
                Ok(()) => self.record(|tally| tally.done += 1),
                Err(error) => self.fail(who, &error),
            }
            std::thread::sleep(pause);
        }
    }

    /// Repeats an action on one connection for as long as that works.
    fn repeat_connected(
        &self,
        (ros, robot): (RosVersion, &str),
        begin: impl Fn(&mut Robot) -> Result<()>,
        act: impl Fn(&mut Robot) -> Result<()>,
    ) {
        let mut connection = None;
        self.repeat(robot, PACE, || {
            let mut connected = match connection.take() {
                Some(connected) => connected,
                None => {
                    let mut connected = self.connect(&robot_path(ros, robot))?;
                    begin(&mut connected)?;
                    connected
                }
            };
            act(&mut connected)?;
            connection = Some(connected);
            Ok(())
        });
    }

    fn connect(&self, path: &str) -> Result<Robot> {
        Robot::connect(&self.daemon.url(path))
    }

    /// Calls the service, publishes a name, sets a parameter and queries topics.
    fn run_caller(&self, ros: RosVersion, robot: &str) {
        let (name, value) = match ros {
            RosVersion::One => ("/kept", "[1, 2]"),
            RosVersion::Two => ("/greeter:word", "\"hi\""),
        };
        let begin = |robot: &mut Robot| {
            robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))
        };
        self.repeat_connected((ros, robot), begin, |robot| {
            let made = Instant::now();
            call_node(robot, ros)?;
            let took = made.elapsed();
            self.record(|tally| tally.calls.push(CallSample { ros, made, took }));
            robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
            let set = json!({"name": name, "value": value});
            let set = robot.call("/rosapi/set_param", set)?;
            let topics = robot.call("/rosapi/topics", json!({}))?;
            ensure!(set["result"] == true && topics["result"] == true, "{set} {topics}");
            Ok(())
        });
    }

    /// Receives its own publications, which are large.
    fn run_talker(&self, ros: RosVersion, robot: &str) {
        let begin = |robot: &mut Robot| {
            robot.send(json!({"op": "advertise", "topic": "/talk", "type": "std_msgs/String"}))?;
            robot.subscribe("/talk")
        };
        let message = json!({"op": "publish", "topic": "/talk", "msg": {"data": "x".repeat(MESSAGE)}});
        self.repeat_connected((ros, robot), begin, |robot| {
            let is_it = |heard: &serde_json::Value| heard["topic"] == "/talk";
            robot.send_until(&message, "its own words", is_it)?;
            Ok(())
        });
    }

    /// Leaves and resumes its session with the previous subscriptions.
    fn run_returner(&self, ros: RosVersion, robot: &str) {
        let path = format!("{}&resume=a-secret-of-{robot}", robot_path(ros, robot));
        self.repeat(robot, VISIT, || {
            let mut robot = self.connect(&path)?;
            robot.subscribe("/greeter/greeting")?;
            call_node(&mut robot, ros)?;
            robot.leave()
        });
    }

    /// Connects without a name, so that its servant ends when it leaves.
    fn run_visitor(&self, ros: RosVersion) {
        self.repeat("a robot without a name", VISIT, || {
            let mut robot = self.connect(Twin::greeter(ros).service.name)?;
            call_node(&mut robot, ros)?;
            robot.leave()
        });
    }

    /// Makes calls through a stub.
    fn run_link(&self, ros: RosVersion) -> Result<()> {
        let (site, twin) = (Site::with_ros(ros)?, Twin::greeter(ros));
        let app = site.join("/app")?;
        let ask = || twins::greeting_count(&site, &app, "/link");
        let argv = twin.argv("link", &[]);
        let stub = twin.stub(&site, (&self.daemon.address, &twin.robot_name("soaked")), "", &argv)?;
        support::wait_until("a link", || Ok(ask().map_err(|error| format!("{error:#}"))))
            .with_context(|| stub.output())?;
        self.repeat("a robot with a stub", PACE, || ask().map(drop));
        Ok(())
    }

    /// Queries everything that the API offers.
    fn run_operator(&self) {
        let paths = ["status", "services", "servants", "events?limit=100"];
        self.repeat("an operator", LOOK, || {
            for path in paths {
                self.daemon.api(&format!("/api/v1/{path}"))?;
            }
            let (status, said) = self.daemon.get("/metrics")?;
            ensure!(status == 200, "/metrics: {status} {said}");
            Ok(())
        });
    }
}
