//! Actions: executed in the cloud, cancelled, and executed by the original on the robot while the cloud is slow.

use std::sync::Arc;

use anyhow::{Context, ensure};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionClient, Bus, GoalEnd, GoalError, GoalEvents, GoalOutcome, RosVersion};
use ros::schema::{ActionDef, Registry};
use support::Verdict;
use support::cable::{Cable, NetworkImpairment};
use support::cutter::Cutter;
use support::layout::MessageLayout;
use support::patience::{Deadline, patience};
use support::site::{NodeProcess, Site};
use support::world::{StoryService, world};

use crate::crossing::{HOUR, argv, crossing, robot_name, service, wait_until_ready, with_log};

const ACTION: &str = "/crossing/act";

/// Feedback and end of a goal.
#[derive(Default)]
pub struct GoalRecord {
    steps: Mutex<Vec<i32>>,
    end: Mutex<Option<Result<GoalEnd, GoalError>>>,
}

impl GoalEvents for GoalRecord {
    fn on_feedback(&self, feedback: Bytes) {
        self.steps.lock().extend(last_number(&feedback));
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        *self.end.lock() = Some(end);
    }
}

/// Returns the number at the end of a goal, feedback or result.
pub fn last_number(message: &[u8]) -> Option<i32> {
    Some(i32::from_le_bytes(*message.last_chunk()?))
}

/// Returns the action of the crossing node of ROS `there`, as nodes of ROS `here` know it.
pub fn action_type(here: RosVersion, there: RosVersion) -> anyhow::Result<Arc<ActionDef>> {
    let (package, name, text) = match there {
        RosVersion::One => ("actionlib", "Test", "int32 goal\n---\nint32 result\n---\nint32 feedback\n"),
        RosVersion::Two => ("test_msgs", "Fibonacci", "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"),
    };
    let registry = Registry::for_version(here);
    registry.insert(&format!("{package}/action/{name}"), text)?;
    Ok(registry.action(&format!("{package}/{name}"))?)
}

/// An application that sends goals to the crossing node of a stub.
pub struct GoalApplication<'a> {
    pub client: Box<dyn ActionClient>,
    ros: RosVersion,
    site: &'a Site,
    stub: &'a NodeProcess,
}

impl<'a> GoalApplication<'a> {
    fn new(site: &'a Site, app: &Arc<dyn Bus>, stub: &'a NodeProcess) -> anyhow::Result<Self> {
        Self::for_node_of(site.system.version(), site, app, stub)
    }

    /// Creates the application for the node of this ROS version, whichever the robot's is.
    pub fn for_node_of(
        node: RosVersion,
        site: &'a Site,
        app: &Arc<dyn Bus>,
        stub: &'a NodeProcess,
    ) -> anyhow::Result<Self> {
        let ros = site.system.version();
        let _runtime = site.runtime.enter();
        let client = app.action_client(ACTION, &action_type(ros, node)?)?;
        with_log(site.runtime.block_on(client.wait_for_server(patience())).map_err(Into::into), stub)?;
        Ok(Self { client, ros, site, stub })
    }

    pub fn send(&self, id: &str, steps: u32) -> Arc<GoalRecord> {
        let _runtime = self.site.runtime.enter();
        let goal = Arc::new(GoalRecord::default());
        let events = Arc::clone(&goal);
        self.client.send_goal(id, MessageLayout::new(self.ros).u32(steps).finish(), events);
        goal
    }

    /// Waits until a goal has sent `count` feedbacks.
    pub fn wait_for_steps(&self, goal: &GoalRecord, count: usize) -> anyhow::Result<Vec<i32>> {
        let steps = support::wait_until(&format!("{count} steps"), || {
            let steps = goal.steps.lock().clone();
            Ok(if steps.len() >= count { Ok(steps) } else { Err(format!("{steps:?}")) })
        });
        with_log(steps, self.stub)
    }

    /// Sends goals with `count` steps until all steps of one were reported; returns the number of goals. A result may
    /// overtake the last steps, because it arrives on a connection of its own, and a client with a result gets no
    /// further steps.
    pub fn send_until_all_steps(&self, id: &str, count: u32) -> anyhow::Result<usize> {
        let all: Vec<i32> = (0..i32::try_from(count)?).collect();
        let mut sent = 0;
        support::wait_until("all steps of a goal", || {
            sent += 1;
            let goal = self.send(&format!("{id}-{sent}"), count);
            let end = self.wait_for_end(&goal)?;
            let whole = end == (GoalOutcome::Succeeded, i32::try_from(count)?);
            let steps = goal.steps.lock().clone();
            ensure!(whole && all.starts_with(&steps), "{end:?} after {steps:?}");
            Ok((steps == all).then_some(()).ok_or_else(|| format!("{steps:?}")))
        })?;
        Ok(sent)
    }

    /// Waits for the end of a goal; returns the outcome and the number in its result.
    pub fn wait_for_end(&self, goal: &GoalRecord) -> anyhow::Result<(GoalOutcome, i32)> {
        let end = support::wait_until("the end of a goal", || {
            let end = goal.end.lock().clone();
            Ok(end.ok_or_else(|| format!("{:?}", goal.steps.lock())))
        });
        let end = with_log(end, self.stub)?;
        let end = with_log(end.map_err(anyhow::Error::from), self.stub)?;
        Ok((end.outcome, last_number(&end.result).context("a number")?))
    }
}

pub fn an_action_is_carried_out_in_the_cloud(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(service(ros).0)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = robot_name(ros, "action");
    let stub = crossing(&site, &daemon.address, &robot, HOUR, "")?;
    with_log(wait_until_ready(&site, &app), &stub)?;
    let sender = GoalApplication::new(&site, &app, &stub)?;
    // header { seq, stamp … } · … in ROS 1; in ROS 2 the states of all goals: uuid, stamp, state of each.
    let (topic, stamp) = match ros {
        RosVersion::One => ("result", 4),
        RosVersion::Two => ("_action/status", 4 + 4 + 16),
    };
    let mut stamped = site.subscribe_latched(&app, &format!("{ACTION}/{topic}"))?;
    site.wait_for_publishers(&stamped, 1)?;
    sender.send_until_all_steps("three", 3)?;
    // Stamps of the node are in the robot's time.
    let now = link::clock::now() / 1_000_000_000 + HOUR;
    let seconds = loop {
        let told = with_log(site.next_message(&mut stamped), &stub)?;
        if let Some(word) = told.bytes.get(stamp..stamp + 4) {
            break i64::from(u32::from_le_bytes(word.try_into()?));
        }
    };
    ensure!(seconds.abs_diff(now) < HOUR.unsigned_abs() / 2, "{seconds} is not about {now}");
    // A goal that never ends is cancelled while it is in progress.
    let long = sender.send("long", 1_000_000);
    sender.wait_for_steps(&long, 1)?;
    sender.client.cancel_goal("long");
    let (outcome, steps) = sender.wait_for_end(&long)?;
    ensure!(outcome == GoalOutcome::Canceled && steps < 0, "{steps}");
    Ok(())
}

/// Number of cuts of the link, and maximum number of bytes between two: one or two goals.
const CUTS: usize = 20;
const STRETCH: usize = 6_000;

pub fn a_goal_is_carried_out_once_however_often_the_link_is_cut(ros: RosVersion) -> Verdict {
    const STEPS: u32 = 5;
    let daemon = world().daemon_with(service(ros).0)?;
    let cutter = Cutter::new(&daemon.address, CUTS, STRETCH, 0x90a1)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = robot_name(ros, "cut-goals");
    let stub = crossing(&site, &cutter.server.to_string(), &robot, 0, "")?;
    with_log(wait_until_ready(&site, &app), &stub)?;
    let sender = GoalApplication::new(&site, &app, &stub)?;
    cutter.begin();
    let mut goals = Vec::new();
    while cutter.cuts() < CUTS {
        let goal = sender.send(&format!("goal-{}", goals.len()), STEPS);
        let end = sender.wait_for_end(&goal)?;
        let steps = i32::try_from(STEPS)?;
        ensure!(end == (GoalOutcome::Succeeded, steps), "{end:?}");
        goals.push(goal);
    }
    // Messages about earlier goals have arrived before this result.
    sender.wait_for_end(&sender.send("last", 0))?;
    let all: Vec<i32> = (0..i32::try_from(STEPS)?).collect();
    for (number, goal) in goals.iter().enumerate() {
        // No step is reported twice or left out; a result may overtake the last steps, because it arrives on a
        // connection of its own.
        let steps = goal.steps.lock().clone();
        let told = format!("{steps:?} of goal {number}\n{}", stub.output());
        ensure!(all.starts_with(&steps), told);
    }
    println!("{CUTS} cuts: {} goals", goals.len());
    Ok(())
}

/// A network on which nothing arrives in time.
const LATE: NetworkImpairment = NetworkImpairment { rate: 100_000, delay: 15_000, jitter: 0, loss: 0.0, limit: 10_000 };

pub fn an_action_is_carried_out_by_the_original_while_the_cloud_is_slow(ros: RosVersion) -> Verdict {
    let (crossing, executable) = service(ros);
    let daemon = world().daemon_with(crossing)?;
    let cable = Cable::new(&daemon.address)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let StoryService { name, .. } = crossing;
    let program = format!("/opt/cloudroid/install/lib/{name}/{executable}");
    let workspace = site.install_original(&daemon, name, (name, executable), &program)?;
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{name}\"\nrobot = \"{}\"\nlocal = \"cold\"\n\
         desire = 5.0\nmax = 5.0\nthreshold = 4.0\ninitial = 15.0\n",
        cable.server,
        robot_name(ros, "late-action")
    );
    let workspace = workspace.to_string_lossy();
    let workspaces = match ros {
        RosVersion::One => "CMAKE_PREFIX_PATH",
        RosVersion::Two => "AMENT_PREFIX_PATH",
    };
    let environment = [(workspaces, &*workspace), ("NO_COLOR", "1")];
    let stub = site.start_stub_with_environment(&environment, &toml, name, executable, argv(ros))?;
    with_log(wait_until_ready(&site, &app), &stub)?;
    let sender = GoalApplication::new(&site, &app, &stub)?;
    // In ROS 1 results are published on a topic: two for one goal would be visible.
    let mut results = match ros {
        RosVersion::One => Some(site.subscribe(&app, &format!("{ACTION}/result"))?),
        RosVersion::Two => None,
    };
    let ends = |goal: &GoalRecord, steps: i32| -> Verdict {
        let end = sender.wait_for_end(goal)?;
        let whole = end == (GoalOutcome::Succeeded, steps);
        ensure!(whole, "{end:?} after {steps} steps\n{}", stub.output());
        Ok(())
    };
    ends(&sender.send("quick", 2), 2)?;
    cable.degrade(LATE)?;
    // Two late goals start the original, which executes them as well.
    let late = ["late-1", "late-2"].map(|id| sender.send(id, 1));
    stub.wait_for_output("the local original answers, too")?;
    // Both arrive at the original at once, and a simple action server of ROS 1 executes the newest.
    let [first, second] = &late;
    let end = sender.wait_for_end(first)?;
    let is_preempted = ros == RosVersion::One && end.0 == GoalOutcome::Canceled;
    ensure!(is_preempted || end == (GoalOutcome::Succeeded, 1), "{end:?}\n{}", stub.output());
    ends(second, 1)?;
    // The first side to send feedback for a goal continues to send it.
    let told = sender.send_until_all_steps("steps", 3);
    let told = told.with_context(|| stub.output())?;
    ensure!(!stub.output().contains("is stopped"), "{}", stub.output());
    cable.restore()?;
    let deadline = Deadline::begin();
    let mut asked = 0;
    while !stub.output().contains("the local original is stopped") {
        deadline.check(|| stub.output())?;
        asked += 1;
        ends(&sender.send(&format!("good-{asked}."), 0), 0)?;
    }
    // All earlier messages of the cloud have arrived before this result.
    ends(&sender.send("last", 1), 1)?;
    if let Some(results) = &mut results {
        let mut times = Vec::new();
        while times.last() != Some(&"last".to_owned()) {
            let result = with_log(site.next_message(results), &stub)?;
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
