//! The load: twenty robots of several kinds, and an operator who queries the API.

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

/// Twenty robots in all.
const CALLERS: usize = 8;
const TALKERS: usize = 4;
const RETURNERS: usize = 4;
const NAMELESS: usize = 2;
const LINKED: usize = 2;
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
    pub(super) made: Instant,
    pub(super) took: Duration,
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
        for number in 0..CALLERS {
            scope.spawn(move || self.run_caller(&format!("caller-{number}")));
        }
        for number in 0..TALKERS {
            scope.spawn(move || self.run_talker(&format!("talker-{number}")));
        }
        for number in 0..RETURNERS {
            scope.spawn(move || self.run_returner(&format!("returner-{number}")));
        }
        for _ in 0..NAMELESS {
            scope.spawn(|| self.run_visitor());
        }
        scope.spawn(|| {
            if let Err(error) = self.run_links() {
                self.fail("robots with stubs", &error);
            }
        });
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
        robot: &str,
        begin: impl Fn(&mut Robot) -> Result<()>,
        act: impl Fn(&mut Robot) -> Result<()>,
    ) {
        let mut connection = None;
        self.repeat(robot, PACE, || {
            let mut connected = match connection.take() {
                Some(connected) => connected,
                None => {
                    let mut connected = self.connect(&greeters::robot_path(robot))?;
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
    fn run_caller(&self, robot: &str) {
        let begin = |robot: &mut Robot| {
            robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))
        };
        self.repeat_connected(robot, begin, |robot| {
            let made = Instant::now();
            greeters::greeting_count(robot)?;
            let took = made.elapsed();
            self.record(|tally| tally.calls.push(CallSample { made, took }));
            robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
            let set = json!({"name": "/kept", "value": "[1, 2]"});
            let set = robot.call("/rosapi/set_param", set)?;
            let topics = robot.call("/rosapi/topics", json!({}))?;
            ensure!(set["result"] == true && topics["result"] == true, "{set} {topics}");
            Ok(())
        });
    }

    /// Receives its own publications, which are large.
    fn run_talker(&self, robot: &str) {
        let begin = |robot: &mut Robot| {
            robot.send(json!({"op": "advertise", "topic": "/talk", "type": "std_msgs/String"}))?;
            robot.subscribe("/talk")
        };
        let message = json!({"op": "publish", "topic": "/talk", "msg": {"data": "x".repeat(MESSAGE)}});
        self.repeat_connected(robot, begin, |robot| {
            let is_it = |heard: &serde_json::Value| heard["topic"] == "/talk";
            robot.send_until(&message, "its own words", is_it)?;
            Ok(())
        });
    }

    /// Leaves and resumes its session with the previous subscriptions.
    fn run_returner(&self, robot: &str) {
        let path = format!("{}&resume=a-secret-of-{robot}", greeters::robot_path(robot));
        self.repeat(robot, VISIT, || {
            let mut robot = self.connect(&path)?;
            robot.subscribe("/greeter/greeting")?;
            greeters::greeting_count(&mut robot)?;
            robot.leave()
        });
    }

    /// Connects without a name, so that its servant ends when it leaves.
    fn run_visitor(&self) {
        self.repeat("a robot without a name", VISIT, || {
            let mut robot = self.connect(greeters::SERVICE)?;
            greeters::greeting_count(&mut robot)?;
            robot.leave()
        });
    }

    /// Makes calls through stubs.
    fn run_links(&self) -> Result<()> {
        let (site, twin) = (Site::new()?, Twin::greeter(RosVersion::One));
        let app = site.node("/app")?;
        let ask = |number: usize| twins::greeting_count(&site, &app, &format!("/link{number}"));
        let mut stubs = Vec::new();
        for number in 0..LINKED {
            let argv = twin.argv(&format!("link{number}"), &[]);
            let robot = format!("soaked-{number}");
            let stub = twin.stub(&site, (&self.daemon.address, &robot), "", &argv)?;
            support::wait_until("a link", || Ok(ask(number).map_err(|error| format!("{error:#}"))))
                .with_context(|| stub.output())?;
            stubs.push(stub);
        }
        self.repeat("robots with stubs", PACE, || (0..LINKED).try_for_each(|number| ask(number).map(drop)));
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
