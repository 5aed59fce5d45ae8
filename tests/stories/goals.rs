//! Actions: carried out in the cloud, cancelled, and carried out by the original on the robot while the cloud is slow.

use std::sync::Arc;

use anyhow::{Context, ensure};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionClient, Bus, GoalEnd, GoalEvents, Outcome, RosVersion};
use support::Verdict;
use support::cable::{Badness, Cable};
use support::cutter::Cutter;
use support::layout::Layout;
use support::patience::{Deadline, patience};
use support::site::{Running, Site};
use support::world::{Service, world};

use crate::crossing::{HOUR, argv, crossing, is_there, robot_of, service, types_of, with_log};

const ACTION: &str = "/crossing/act";

/// What came of a goal.
#[derive(Default)]
struct Goal {
    steps: Mutex<Vec<i32>>,
    end: Mutex<Option<Result<GoalEnd, String>>>,
}

impl GoalEvents for Goal {
    fn feedback(&self, feedback: Bytes) {
        self.steps.lock().extend(number(&feedback));
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        *self.end.lock() = Some(end);
    }
}

/// Feedback and results end with a number.
fn number(message: &[u8]) -> Option<i32> {
    Some(i32::from_le_bytes(*message.last_chunk()?))
}

/// An application that sends goals to the crossing node of a stub.
struct Sender<'a> {
    client: Box<dyn ActionClient>,
    ros: RosVersion,
    site: &'a Site,
    stub: &'a Running,
}

impl<'a> Sender<'a> {
    fn new(site: &'a Site, app: &Arc<dyn Bus>, stub: &'a Running) -> anyhow::Result<Self> {
        let ros = site.system.version();
        let action = match ros {
            RosVersion::One => "actionlib/Test",
            RosVersion::Two => "test_msgs/action/Fibonacci",
        };
        let _runtime = site.runtime.enter();
        let client = app.action_client(ACTION, &types_of(ros)?.action(action)?)?;
        with_log(
            site.runtime
                .block_on(client.ready(patience()))
                .map_err(Into::into),
            stub,
        )?;
        Ok(Self {
            client,
            ros,
            site,
            stub,
        })
    }

    fn sends(&self, id: &str, steps: u32) -> Arc<Goal> {
        let _runtime = self.site.runtime.enter();
        let goal = Arc::new(Goal::default());
        let events = Arc::clone(&goal);
        self.client
            .send(id, Layout::of(self.ros).u32(steps).finish(), events);
        goal
    }

    /// Waits until the goal has got on so far.
    fn steps(&self, goal: &Goal, count: usize) -> anyhow::Result<Vec<i32>> {
        let steps = support::until(&format!("{count} steps"), || {
            let steps = goal.steps.lock().clone();
            Ok(match steps.len() >= count {
                true => Ok(steps),
                false => Err(format!("{steps:?}")),
            })
        });
        with_log(steps, self.stub)
    }

    /// Sends goals of so many steps until all steps of one were told; how many goals that took. A result may overtake the last steps,
    /// since it comes by a connection of its own, and who has the result hears of no more steps.
    fn tells_all_steps(&self, id: &str, count: u32) -> anyhow::Result<usize> {
        let all: Vec<i32> = (0..i32::try_from(count)?).collect();
        let mut sent = 0;
        support::until("all steps of a goal", || {
            sent += 1;
            let goal = self.sends(&format!("{id}-{sent}"), count);
            let end = self.ends(&goal)?;
            let whole = end == (Outcome::Succeeded, i32::try_from(count)?);
            let steps = goal.steps.lock().clone();
            ensure!(whole && all.starts_with(&steps), "{end:?} after {steps:?}");
            Ok((steps == all)
                .then_some(())
                .ok_or_else(|| format!("{steps:?}")))
        })?;
        Ok(sent)
    }

    /// Waits for its end: how it came about, and the number of its result.
    fn ends(&self, goal: &Goal) -> anyhow::Result<(Outcome, i32)> {
        let end = support::until("the end of a goal", || {
            let end = goal.end.lock().clone();
            Ok(end.ok_or_else(|| format!("{:?}", goal.steps.lock())))
        });
        let end = with_log(end, self.stub)?;
        let end = with_log(end.map_err(anyhow::Error::msg), self.stub)?;
        Ok((end.outcome, number(&end.result).context("a number")?))
    }
}

pub fn an_action_is_carried_out_in_the_cloud(ros: RosVersion) -> Verdict {
    let daemon = world().with(service(ros).0)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = robot_of(ros, "action");
    let stub = crossing(&site, &daemon.address, &robot, HOUR, "")?;
    with_log(is_there(&site, &app), &stub)?;
    let sender = Sender::new(&site, &app, &stub)?;
    // header { seq, stamp … } · … in ROS 1; in ROS 2 the states of all goals: uuid, stamp, state of each.
    let (topic, stamp) = match ros {
        RosVersion::One => ("result", 4),
        RosVersion::Two => ("_action/status", 4 + 4 + 16),
    };
    let mut stamped = site.hears_latched(&app, &format!("{ACTION}/{topic}"))?;
    site.fed(&stamped, 1)?;
    sender.tells_all_steps("three", 3)?;
    // What the node stamps is the robot's time.
    let now = link::clock::now() / 1_000_000_000 + HOUR;
    let seconds = loop {
        let told = with_log(site.next(&mut stamped), &stub)?;
        if let Some(word) = told.bytes.get(stamp..stamp + 4) {
            break i64::from(u32::from_le_bytes(word.try_into()?));
        }
    };
    ensure!(
        seconds.abs_diff(now) < HOUR.unsigned_abs() / 2,
        "{seconds} is not about {now}"
    );
    // One without end is cancelled once it is under way.
    let long = sender.sends("long", 1_000_000);
    sender.steps(&long, 1)?;
    sender.client.cancel("long");
    let (outcome, steps) = sender.ends(&long)?;
    ensure!(outcome == Outcome::Canceled && steps < 0, "{steps}");
    Ok(())
}

/// How often the link is cut, and the longest stretch between two cuts, bytes: one or two goals.
const CUTS: usize = 20;
const STRETCH: usize = 6_000;

pub fn a_goal_is_carried_out_once_however_often_the_link_is_cut(ros: RosVersion) -> Verdict {
    const STEPS: u32 = 5;
    let daemon = world().with(service(ros).0)?;
    let cutter = Cutter::new(&daemon.address, CUTS, STRETCH, 0x90a1)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = robot_of(ros, "cut-goals");
    let stub = crossing(&site, &cutter.server.to_string(), &robot, 0, "")?;
    with_log(is_there(&site, &app), &stub)?;
    let sender = Sender::new(&site, &app, &stub)?;
    cutter.begin();
    let mut goals = Vec::new();
    while cutter.cuts() < CUTS {
        let goal = sender.sends(&format!("goal-{}", goals.len()), STEPS);
        let end = sender.ends(&goal)?;
        let steps = i32::try_from(STEPS)?;
        ensure!(end == (Outcome::Succeeded, steps), "{end:?}");
        goals.push(goal);
    }
    // What was said of earlier goals has come before this.
    sender.ends(&sender.sends("last", 0))?;
    let all: Vec<i32> = (0..i32::try_from(STEPS)?).collect();
    for (number, goal) in goals.iter().enumerate() {
        // Nothing is told twice or left out; a result may overtake the last steps, since it comes by a connection of its own.
        let steps = goal.steps.lock().clone();
        let told = format!("{steps:?} of goal {number}\n{}", stub.said());
        ensure!(all.starts_with(&steps), told);
    }
    println!("{CUTS} cuts: {} goals", goals.len());
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

pub fn an_action_is_carried_out_by_the_original_while_the_cloud_is_slow(
    ros: RosVersion,
) -> Verdict {
    let (crossing, executable) = service(ros);
    let daemon = world().with(crossing)?;
    let cable = Cable::new(&daemon.address)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let Service { name, .. } = crossing;
    let program = format!("/opt/cloudroid/install/lib/{name}/{executable}");
    let workspace = site.installs_original(&daemon, name, (name, executable), &program)?;
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{name}\"\nrobot = \"{}\"\nlocal = \"cold\"\n\
         desire = 5.0\nmax = 5.0\nthreshold = 4.0\ninitial = 15.0\n",
        cable.server,
        robot_of(ros, "late-action")
    );
    let workspace = workspace.to_string_lossy();
    let workspaces = match ros {
        RosVersion::One => "CMAKE_PREFIX_PATH",
        RosVersion::Two => "AMENT_PREFIX_PATH",
    };
    let environment = [(workspaces, &*workspace), ("NO_COLOR", "1")];
    let stub = site.stub_among(&environment, &toml, name, executable, argv(ros))?;
    with_log(is_there(&site, &app), &stub)?;
    let sender = Sender::new(&site, &app, &stub)?;
    // Results are a topic in ROS 1: two of a goal would be seen there.
    let mut results = match ros {
        RosVersion::One => Some(site.hears(&app, &format!("{ACTION}/result"))?),
        RosVersion::Two => None,
    };
    let ends = |goal: &Goal, steps: i32| -> Verdict {
        let end = sender.ends(goal)?;
        let whole = end == (Outcome::Succeeded, steps);
        ensure!(whole, "{end:?} after {steps} steps\n{}", stub.said());
        Ok(())
    };
    ends(&sender.sends("quick", 2), 2)?;
    cable.degrade(LATE)?;
    // Two that are late, and it is started; it carries them out as well.
    let late = ["late-1", "late-2"].map(|id| sender.sends(id, 1));
    stub.says("the local original answers, too")?;
    // Both come to it at once, and a simple action server of ROS 1 carries out the newest.
    let [first, second] = &late;
    let end = sender.ends(first)?;
    let is_preempted = ros == RosVersion::One && end.0 == Outcome::Canceled;
    ensure!(
        is_preempted || end == (Outcome::Succeeded, 1),
        "{end:?}\n{}",
        stub.said()
    );
    ends(second, 1)?;
    // Whoever is first with a goal's feedback goes on with it.
    let told = sender.tells_all_steps("steps", 3);
    let told = told.with_context(|| stub.said())?;
    ensure!(!stub.said().contains("is stopped"), "{}", stub.said());
    cable.restore()?;
    let deadline = Deadline::begin();
    let mut asked = 0;
    while !stub.said().contains("the local original is stopped") {
        deadline.check(|| stub.said())?;
        asked += 1;
        ends(&sender.sends(&format!("good-{asked}."), 0), 0)?;
    }
    // What the cloud still owed has come before this.
    ends(&sender.sends("last", 1), 1)?;
    if let Some(results) = &mut results {
        let mut times = Vec::new();
        while times.last() != Some(&"last".to_owned()) {
            let result = with_log(site.next(results), &stub)?;
            // header { seq, stamp, frame } · status { goal_id { stamp, id … } }
            let word = |at: usize| -> anyhow::Result<usize> {
                let word = result.bytes.get(at..at + 4).context("too short")?;
                Ok(u32::from_le_bytes(word.try_into()?) as usize)
            };
            let at = 12 + 4 + word(12)? + 8;
            let id = result.bytes.get(at + 4..at + 4 + word(at)?);
            times.push(String::from_utf8_lossy(id.context("too short")?).into_owned());
        }
        let all = times.len();
        times.sort_unstable();
        times.dedup();
        ensure!(all == times.len() && all == 4 + told + asked, "{times:?}");
    }
    Ok(())
}
