//! What runs in a robot's place: a ROS Master, the robot's own node, which plays a recording and hears the answers, and the package as it is
//! installed there or its stub.

mod boxes;
mod carried;
mod rate;

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Bus, Matched, Message, Publisher, Qos, Subscription};
use ros::ros1::Ros1Bus;
use serde::{Deserialize, Serialize};
use servant::cgroup::Cgroup;
use support::site::{Running, Site};
use tokio::sync::watch::Receiver;
use tokio::time::{Instant as At, sleep_until, timeout};

use crate::application;
use crate::place::Network;
use crate::recording::{Recording, Step, header, numbers, pose, restamped, stamped_before};
use crate::trace::{Grid, Phases, Request, Trace};

/// Stamps of requests begin after this one.
pub const FIRST: u32 = 1000;
/// Requests whose answers are not counted: by then all are connected and awake.
pub const WARM_UP: usize = 3;
/// An answer to a request of the warm-up; a node of several seconds' start is waited for.
const BEGINNING: Duration = Duration::from_secs(40);
/// For the node to connect to what it is asked by, and the robot to its answers.
const CONNECTION: Duration = Duration::from_secs(120);
/// For the node to connect to what comes with requests.
const OTHERS: Duration = Duration::from_secs(5);
/// Between two looks at whether the node is still there.
const LOOK: Duration = Duration::from_millis(500);
/// For what a node tells besides its last answer.
const BESIDES: Duration = Duration::from_millis(300);
/// For answers that are under way after the last request that is played at a rate.
const STRAGGLERS: Duration = Duration::from_secs(10);

/// What a robot does.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Plan {
    /// Where its stub finds the server; the place says it.
    pub server: String,
    /// Who answers.
    pub node: Node,
    /// A rosbag file.
    pub recording: PathBuf,
    /// The topic whose messages are requests; they begin with a header.
    pub request: String,
    /// Recorded topics that are no inputs.
    pub left_out: Vec<String>,
    /// Recorded topics that `rosbag play` plays beside the requests.
    #[serde(default)]
    pub besides: Vec<String>,
    /// The topic of answers, with the header of what they answer.
    pub answer: String,
    /// Answers begin like a `geometry_msgs/PoseStamped`.
    pub tells_pose: bool,
    /// A topic with a header and three float64, seconds: acquisition, computation, rendering.
    pub timing: Option<String>,
    /// A topic of `nav_msgs/OccupancyGrid`.
    pub map: Option<String>,
    /// One request after the other's answer, or as they were recorded.
    pub pace: Pace,
    /// Every so many of the recorded requests is asked.
    pub every: usize,
    /// Requests at the most, without the first ones, which are not counted.
    pub most: usize,
    /// Seconds after which a request counts as not answered.
    pub give_up: f64,
    /// Seconds after which the whole run does.
    pub patience: f64,
    /// Of requests at a rate: before this one, counted from 1, the network becomes that one.
    #[serde(default)]
    pub changes: Vec<(usize, Network)>,
}

/// When requests are published.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pace {
    /// After the answer to the one before.
    OneByOne,
    /// At their recorded times, so much faster.
    Recorded(f64),
    /// At a rate, all again from the first after the last, once some were answered in time.
    Rate {
        /// Requests per second.
        hertz: f64,
        /// Seconds within which an answer is in time.
        in_time: f64,
    },
    /// By `rosbag play`, at its own rate and with its own stamps, so many seconds of the recording.
    Played(f64),
}

/// Who answers on the robot.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Node {
    /// The package itself, in the file system that was made of it.
    Native {
        /// Shell commands that execute their arguments there.
        script: String,
        /// The node's program in it.
        program: String,
        /// Its arguments.
        argv: Vec<String>,
    },
    /// Its stub.
    Stub {
        /// The package.
        package: String,
        /// The node's program.
        executable: String,
        /// Its arguments.
        argv: Vec<String>,
        /// Lines of `stub.toml` beside the server's address.
        settings: String,
        /// Variables in its environment.
        #[serde(default)]
        environment: Vec<(String, String)>,
    },
}

/// Runs the robot that `order` tells of, in this process, and writes what it saw to `answer`.
pub fn main(order: &Path, answer: &Path) -> Result<()> {
    let (plan, cgroup): (Plan, Cgroup) = serde_json::from_slice(&std::fs::read(order)?)?;
    cgroup.enter(std::process::id())?;
    let trace = run(&plan)?;
    Ok(std::fs::write(answer, serde_json::to_vec(&trace)?)?)
}

/// The robot's ends of everything.
struct Ends {
    inputs: Vec<(Arc<str>, Box<dyn Publisher>)>,
    answers: Subscription,
    timing: Option<Subscription>,
    maps: Option<Subscription>,
    _node: Arc<Ros1Bus>,
}

fn run(plan: &Plan) -> Result<Trace> {
    if let Pace::Played(seconds) = plan.pace {
        let site = Site::new()?;
        let node = start(&site, plan)?;
        let heard = application::run(&site, plan, seconds, &node);
        return heard.with_context(|| format!("the node said: {}", node.said()));
    }
    let recording = Recording::read(&plan.recording)?;
    let steps: Vec<Step> = recording.steps(&plan.request);
    ensure!(
        steps.len() > WARM_UP,
        "{} has {} messages of {}",
        plan.recording.display(),
        steps.len(),
        plan.request
    );
    let site = Site::new()?;
    let mut ends = ends(&site, plan, &recording)?;
    let mut node = start(&site, plan)?;
    let asked = ask(&site, &mut ends, plan, &steps, &mut node);
    let mut trace = asked.with_context(|| format!("the node said: {}", node.said()))?;
    if let Node::Stub { .. } = plan.node {
        trace.answered_locally = node.said().matches("answer=Some((Local").count();
        rate::told(&node.said(), &mut trace.requests);
        let warns = |line: &&str| line.contains(" WARN ");
        trace.warnings = node
            .said()
            .lines()
            .filter(warns)
            .map(str::to_owned)
            .collect();
    }
    if trace.node_ended.is_none() {
        // As roslaunch would.
        node.signal(Signal::SIGINT)?;
        node.ends()?;
    }
    Ok(trace)
}

fn ends(site: &Site, plan: &Plan, recording: &Recording) -> Result<Ends> {
    let node = site.node("/robot")?;
    let mut inputs = Vec::new();
    for one in recording.topics(&plan.left_out) {
        let of = (*one.wire_type).clone();
        let advertised = node.advertise(&one.topic, of, Qos::keep_last(10));
        inputs.push((one.topic.clone(), site.runtime.block_on(advertised)?));
    }
    let hears = |topic: &Option<String>| -> Result<Option<Subscription>> {
        let topic = topic.as_ref();
        topic.map(|topic| site.hears(&node, topic)).transpose()
    };
    Ok(Ends {
        inputs,
        answers: site.hears(&node, &plan.answer)?,
        timing: hears(&plan.timing)?,
        maps: hears(&plan.map)?,
        _node: node,
    })
}

fn start(site: &Site, plan: &Plan) -> Result<Running> {
    match &plan.node {
        Node::Native {
            script,
            program,
            argv,
        } => site.starts_in_image(script, program, argv),
        Node::Stub {
            package,
            executable,
            argv,
            settings,
            environment: besides,
        } => {
            let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
            let toml = format!("server = \"{}\"\n{settings}\n", plan.server);
            let mut environment = vec![
                ("ROS_IP", "127.0.0.1"),
                ("NO_COLOR", "1"),
                ("CLOUDROID_LOG", "info,requests=debug"),
            ];
            environment.extend(besides.iter().map(|(name, value)| (&**name, &**value)));
            site.stub_among(&environment, &toml, package, executable, &argv)
        }
    }
}

fn ask(
    site: &Site,
    ends: &mut Ends,
    plan: &Plan,
    steps: &[Step],
    node: &mut Running,
) -> Result<Trace> {
    let request = ends.inputs.iter().find(|(name, _)| **name == *plan.request);
    let (_, publisher) = request.context("the topic of requests is recorded")?;
    // What is published before the other end is there is lost, and answers would differ from run to run.
    let connects = (publisher.matched(), ends.answers.matched.clone());
    let mut ended = Trace::default();
    if !connected(site, connects, node, &mut ended)? {
        return Ok(ended);
    }
    for (_, publisher) in &ends.inputs {
        let mut now = publisher.matched();
        let others = now.wait_for(|now| now.connected() > 0);
        // A package need not listen to all that was recorded.
        let _ = site
            .runtime
            .block_on(async { timeout(OTHERS, others).await.is_ok() });
    }
    site.runtime.block_on(async {
        let (warm_up, measured) = steps.split_at(WARM_UP);
        for (index, step) in warm_up.iter().enumerate() {
            let number = index as u32 + 1;
            ends.publish(step, number)?;
            // What is not answered yet is not counted either.
            let mut ended = Trace::default();
            if ends.answer(number, BEGINNING).await.is_none() && let_go(node, &mut ended)? {
                return Ok(ended);
            }
        }
        let chosen = measured.iter().step_by(plan.every).take(plan.most);
        let chosen: Vec<&Step> = chosen.collect();
        let mut trace = match plan.pace {
            Pace::OneByOne => ends.one_by_one(plan, &chosen, node).await?,
            Pace::Recorded(speed) => ends.as_recorded(speed, &chosen, node).await?,
            Pace::Played(_) => bail!("rosbag plays by itself"),
            Pace::Rate { hertz, in_time } => {
                let cycle: Vec<&Step> = measured.iter().cycle().take(plan.most).collect();
                ends.at_a_rate(plan, (hertz, in_time), &cycle, node).await?
            }
        };
        // What the node tells on other topics comes on other connections, and may be a little later than its last answer.
        let until = At::now() + BESIDES;
        let unheard = |trace: &Trace| {
            let last = trace.requests.last();
            last.is_some_and(|last| last.response.is_some() && last.phases.is_none())
        };
        while ends.timing.is_some() && unheard(&trace) && At::now() < until {
            ends.besides(&mut trace);
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        ends.besides(&mut trace);
        Ok(trace)
    })
}

impl Ends {
    /// Publishes a request with what was recorded before it.
    fn publish(&self, step: &Step, number: u32) -> Result<()> {
        let send = |topic: &str, bytes| {
            if let Some((_, publisher)) = self.inputs.iter().find(|(name, _)| **name == *topic) {
                publisher.publish(bytes);
            }
        };
        for message in &step.before {
            send(
                &message.topic,
                stamped_before(message, step.request, number),
            );
        }
        let request = restamped(&step.request.bytes, number);
        let request = request
            .with_context(|| format!("messages of {} have no header", step.request.topic))?;
        send(&step.request.topic, request);
        Ok(())
    }

    /// The first answer to this request.
    async fn answer(&mut self, number: u32, give_up: Duration) -> Option<Message> {
        let waited = timeout(give_up, async {
            loop {
                let message = self.answers.messages.recv().await?;
                if number_of(&message) == Some(number) {
                    return Some(message);
                }
            }
        });
        waited.await.ok().flatten()
    }

    /// The same, but no longer than the node is there.
    async fn answer_while(&mut self, number: u32, until: At, node: &Running) -> Option<Message> {
        loop {
            let left = until.saturating_duration_since(At::now());
            let message = self.answer(number, left.min(LOOK)).await;
            if message.is_some() || left <= LOOK || has_ended(node) {
                return message;
            }
        }
    }

    async fn one_by_one(
        &mut self,
        plan: &Plan,
        steps: &[&Step<'_>],
        node: &mut Running,
    ) -> Result<Trace> {
        let begun = Instant::now();
        let mut trace = Trace::default();
        for (index, step) in steps.iter().enumerate() {
            let number = FIRST + index as u32;
            let sent = Instant::now();
            self.publish(step, number)?;
            let until = At::now() + Duration::from_secs_f64(plan.give_up);
            let mut request = Request {
                at: (sent - begun).as_secs_f64(),
                stamp: step.at,
                ..Request::default()
            };
            if let Some(message) = self.answer_while(number, until, node).await {
                answered(&mut request, &message, sent.elapsed());
                request.pose = request.pose.filter(|_| plan.tells_pose);
                request.carried = carried::so_far()?;
            }
            let lost = request.response.is_none();
            trace.requests.push(request);
            self.besides(&mut trace);
            if lost && let_go(node, &mut trace)? {
                break;
            }
        }
        trace.lasted = begun.elapsed().as_secs_f64();
        Ok(trace)
    }

    async fn as_recorded(
        &mut self,
        speed: f64,
        steps: &[&Step<'_>],
        node: &mut Running,
    ) -> Result<Trace> {
        let begun = At::now();
        let first = steps.first().map_or(0.0, |step| step.at);
        let mut trace = Trace::default();
        let mut sent: Vec<At> = Vec::new();
        for (index, step) in steps.iter().enumerate() {
            let due = begun + Duration::from_secs_f64((step.at - first) / speed);
            self.collect(&mut trace.requests, &sent, due).await;
            trace.requests.push(Request {
                at: begun.elapsed().as_secs_f64(),
                stamp: step.at,
                ..Request::default()
            });
            sent.push(At::now());
            self.publish(step, FIRST + index as u32)?;
            self.besides(&mut trace);
        }
        let until = At::now() + STRAGGLERS;
        loop {
            // The last answer ends it: those before it come no more, and its map is on its way.
            let all = trace
                .requests
                .last()
                .is_none_or(|last| last.response.is_some());
            self.collect(&mut trace.requests, &sent, At::now() + LOOK)
                .await;
            if all || At::now() > until {
                break;
            }
        }
        let_go(node, &mut trace)?;
        trace.lasted = begun.elapsed().as_secs_f64();
        Ok(trace)
    }

    /// Notes answers until then, or until the last request is answered.
    async fn collect(&mut self, requests: &mut [Request], sent: &[At], until: At) {
        loop {
            let message = tokio::select! {
                biased;
                Some(message) = self.answers.messages.recv() => message,
                () = sleep_until(until) => return,
            };
            let index = number_of(&message).and_then(|number| number.checked_sub(FIRST));
            let Some(index) = index.map(|index| index as usize) else {
                continue;
            };
            if let Some(request) = requests.get_mut(index) {
                request.answers += 1;
                if request.response.is_none() {
                    answered(request, &message, sent[index].elapsed());
                }
            }
        }
    }

    /// Adds what has come on other topics by now; their queues keep a hundred messages.
    fn besides(&mut self, trace: &mut Trace) {
        self.timings(&mut trace.requests);
        if let Some(maps) = &mut self.maps {
            while let Some(message) = maps.messages.try_recv() {
                trace.map = grid(&message.bytes).or(trace.map.take());
            }
        }
    }

    fn timings(&mut self, requests: &mut [Request]) {
        let Some(timing) = &mut self.timing else {
            return;
        };
        while let Some(message) = timing.messages.try_recv() {
            let Some(index) = number_of(&message).and_then(|number| number.checked_sub(FIRST))
            else {
                continue;
            };
            let from = header(&message.bytes).map_or(0, |header| header.end);
            let told = numbers(&message.bytes, from, 3);
            let (Some(request), Some([acquisition, computation, rendering])) =
                (requests.get_mut(index as usize), told.as_deref())
            else {
                continue;
            };
            request.phases = Some(Phases {
                acquisition: *acquisition,
                computation: *computation,
                rendering: *rendering,
            });
        }
    }
}

/// Whether the node is connected to requests and the robot to answers; not where the node has ended, which is noted.
fn connected(
    site: &Site,
    (mut requests, mut answers): (Receiver<Matched>, Receiver<Matched>),
    node: &Running,
    trace: &mut Trace,
) -> Result<bool> {
    let begun = Instant::now();
    loop {
        let both = async {
            let there = |now: &Matched| now.connected() > 0;
            requests.wait_for(there).await.is_ok() && answers.wait_for(there).await.is_ok()
        };
        let reached = site.runtime.block_on(async { timeout(LOOK, both).await });
        if matches!(reached, Ok(true)) {
            return Ok(true);
        }
        if let_go(node, trace)? {
            return Ok(false);
        }
        ensure!(
            begun.elapsed() < CONNECTION,
            "{} s after its start the node is not connected to the robot's topics",
            CONNECTION.as_secs()
        );
    }
}

/// Whether the node has ended, which is noted.
fn let_go(node: &Running, trace: &mut Trace) -> Result<bool> {
    let ended = has_ended(node);
    if ended {
        let said = node.said();
        let last = said.lines().last().unwrap_or("nothing");
        trace.node_ended = Some(format!("the node has ended; its last words: {last}"));
    }
    Ok(ended)
}

/// Whether its process is there no more.
pub fn has_ended(node: &Running) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", node.pid()));
    // The state stands behind the name, which is in parentheses (proc(5)).
    let state = stat.as_deref().unwrap_or(") X").rsplit(") ").next();
    state.is_some_and(|state| state.starts_with(['Z', 'X']))
}

fn number_of(message: &Message) -> Option<u32> {
    header(&message.bytes).map(|header| header.stamp.0)
}

fn answered(request: &mut Request, message: &Message, after: Duration) {
    request.response = Some(after.as_secs_f64());
    request.digest = Some(digest(&message.bytes));
    request.boxes = boxes::digest(message);
    request.pose = pose(&message.bytes);
}

/// Of a message without its header's sequence number.
pub fn digest(bytes: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    bytes.get(4..).hash(&mut hasher);
    hasher.finish()
}

/// A serialized `nav_msgs/OccupancyGrid`.
fn grid(bytes: &[u8]) -> Option<Grid> {
    let at = header(bytes)?.end;
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    // map_load_time, resolution, width, height, origin (seven float64), data
    let resolution = f32::from_le_bytes(bytes.get(at + 8..at + 12)?.try_into().ok()?);
    let (width, height) = (word(at + 12)? as usize, word(at + 16)? as usize);
    let origin = numbers(bytes, at + 20, 2)?;
    let count = word(at + 76)? as usize;
    let cells = bytes.get(at + 80..at + 80 + count)?;
    (count == width * height).then(|| Grid {
        width,
        height,
        resolution: resolution.into(),
        origin: [origin[0], origin[1]],
        cells: cells.iter().map(|cell| *cell as i8).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_is_read_by_rows() {
        let mut bytes = Vec::new();
        [1_u32, 2, 3, 0]
            .iter()
            .for_each(|word| bytes.extend(word.to_le_bytes()));
        bytes.extend([0; 8]);
        bytes.extend(0.05_f32.to_le_bytes());
        [2_u32, 3]
            .iter()
            .for_each(|word| bytes.extend(word.to_le_bytes()));
        [-1.0_f64, -2.0, 0.0, 0.0, 0.0, 0.0, 1.0]
            .iter()
            .for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes.extend(6_u32.to_le_bytes());
        bytes.extend([255, 0, 100, 0, 0, 0]);
        let map = grid(&bytes).expect("a map");
        assert_eq!((map.width, map.height, map.origin), (2, 3, [-1.0, -2.0]));
        assert_eq!(map.cells, [-1, 0, 100, 0, 0, 0]);
        assert_eq!(grid(&bytes[..bytes.len() - 1]), None);
    }
}
