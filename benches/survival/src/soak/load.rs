//! Twenty robots by what they do, and an operator who looks.

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
/// Between two things that one of them does.
const PACE: Duration = Duration::from_millis(100);
/// The same for who comes again, or comes without a name and is given a servant for itself.
const VISIT: Duration = Duration::from_secs(2);
/// The same for an operator.
const LOOK: Duration = Duration::from_secs(1);
/// Bytes of what a talker publishes and hears again.
const MESSAGE: usize = 100_000;

/// What they have come to.
#[derive(Debug, Default)]
pub(super) struct Tally {
    pub(super) done: u64,
    /// What failed, in words.
    pub(super) failures: Vec<String>,
    /// Callers' calls: when each was made, and how long it took.
    pub(super) calls: Vec<Call>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Call {
    pub(super) made: Instant,
    pub(super) took: Duration,
}

/// All of them at work.
pub(super) struct Load<'a> {
    daemon: &'a Daemon,
    over: AtomicBool,
    tally: Mutex<Tally>,
}

impl<'a> Load<'a> {
    pub(super) fn of(daemon: &'a Daemon) -> Self {
        Self {
            daemon,
            over: AtomicBool::new(false),
            tally: Mutex::default(),
        }
    }

    /// Has all of them work, each in a thread of its own, until [`Load::end`].
    pub(super) fn start<'scope>(&'scope self, scope: &'scope Scope<'scope, '_>) {
        for number in 0..CALLERS {
            scope.spawn(move || self.call(&format!("caller-{number}")));
        }
        for number in 0..TALKERS {
            scope.spawn(move || self.talk(&format!("talker-{number}")));
        }
        for number in 0..RETURNERS {
            scope.spawn(move || self.come_again(&format!("returner-{number}")));
        }
        for _ in 0..NAMELESS {
            scope.spawn(|| self.come_once());
        }
        scope.spawn(|| {
            if let Err(error) = self.link() {
                self.fail("robots with stubs", &error);
            }
        });
        scope.spawn(|| self.look());
    }

    /// Says that it is over.
    pub(super) fn end(&self) {
        self.over.store(true, Ordering::Relaxed);
    }

    /// What they had come to in the end.
    pub(super) fn into_tally(self) -> Result<Tally> {
        self.tally
            .into_inner()
            .map_err(|_| anyhow!("a robot panicked"))
    }

    fn note(&self, note: impl FnOnce(&mut Tally)) {
        if let Ok(mut tally) = self.tally.lock() {
            note(&mut tally);
        }
    }

    fn fail(&self, who: &str, error: &anyhow::Error) {
        eprintln!("{who}: {error:#}");
        self.note(|tally| tally.failures.push(format!("{who}: {error:#}")));
    }

    /// Does something again and again until it is over.
    fn repeat(&self, who: &str, pause: Duration, mut act: impl FnMut() -> Result<()>) {
        while !self.over.load(Ordering::Relaxed) {
            match act() {
                Ok(()) => self.note(|tally| tally.done += 1),
                Err(error) => self.fail(who, &error),
            }
            std::thread::sleep(pause);
        }
    }

    /// The same by one connection, for as long as that works.
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
                    let mut connected = self.connect(&greeters::path(robot))?;
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

    /// Calls the service, says whom to greet, sets a parameter and asks for topics.
    fn call(&self, robot: &str) {
        let begin = |robot: &mut Robot| {
            robot.says(
                json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}),
            )
        };
        self.repeat_connected(robot, begin, |robot| {
            let made = Instant::now();
            greeters::count(robot)?;
            let took = made.elapsed();
            self.note(|tally| tally.calls.push(Call { made, took }));
            robot.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
            let set = json!({"name": "/kept", "value": "[1, 2]"});
            let set = robot.calls("/rosapi/set_param", set)?;
            let topics = robot.calls("/rosapi/topics", json!({}))?;
            ensure!(
                set["result"] == true && topics["result"] == true,
                "{set} {topics}"
            );
            Ok(())
        });
    }

    /// Hears what it publishes, which is much.
    fn talk(&self, robot: &str) {
        let begin = |robot: &mut Robot| {
            robot.says(json!({"op": "advertise", "topic": "/talk", "type": "std_msgs/String"}))?;
            robot.subscribes("/talk")
        };
        let message =
            json!({"op": "publish", "topic": "/talk", "msg": {"data": "x".repeat(MESSAGE)}});
        self.repeat_connected(robot, begin, |robot| {
            let is_it = |heard: &serde_json::Value| heard["topic"] == "/talk";
            robot.says_until(&message, "its own words", is_it)?;
            Ok(())
        });
    }

    /// Leaves, and comes again to what it had subscribed to.
    fn come_again(&self, robot: &str) {
        let path = format!("{}&resume=a-secret-of-{robot}", greeters::path(robot));
        self.repeat(robot, VISIT, || {
            let mut robot = self.connect(&path)?;
            robot.subscribes("/greeter/greeting")?;
            greeters::count(&mut robot)?;
            robot.leaves()
        });
    }

    /// Comes without a name, so that its servant ends when it leaves.
    fn come_once(&self) {
        self.repeat("a robot without a name", VISIT, || {
            let mut robot = self.connect(greeters::SERVICE)?;
            greeters::count(&mut robot)?;
            robot.leaves()
        });
    }

    /// Calls by stubs.
    fn link(&self) -> Result<()> {
        let (site, twin) = (Site::new()?, Twin::greeter(RosVersion::One));
        let app = site.node("/app")?;
        let ask = |number: usize| twins::count(&site, &app, &format!("/link{number}"));
        let mut stubs = Vec::new();
        for number in 0..LINKED {
            let argv = twin.argv(&format!("link{number}"), &[]);
            let robot = format!("soaked-{number}");
            let stub = twin.stub(&site, (&self.daemon.address, &robot), "", &argv)?;
            support::until("a link", || {
                Ok(ask(number).map_err(|error| format!("{error:#}")))
            })
            .with_context(|| stub.said())?;
            stubs.push(stub);
        }
        self.repeat("robots with stubs", PACE, || {
            (0..LINKED).try_for_each(|number| ask(number).map(drop))
        });
        Ok(())
    }

    /// Looks at all there is to see.
    fn look(&self) {
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
