//! Asking the node: once it is connected, one request after the other's answer, or at the recorded times; and whether it is still there.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use ros::bus::Matched;
use support::site::{Running, Site};
use tokio::sync::watch::Receiver;
use tokio::time::{Instant as At, timeout};

use super::answers::answered;
use super::ends::Ends;
use super::{FIRST, Pace, Plan, WARM_UP, carried};
use crate::recording::Step;
use crate::trace::{Request, Trace};

/// An answer to a request of the warm-up; a node of several seconds' start is waited for.
const BEGINNING: Duration = Duration::from_secs(40);
/// For the node to connect to what it is asked by, and the robot to its answers.
const CONNECTION: Duration = Duration::from_secs(120);
/// For the node to connect to what comes with requests.
const OTHERS: Duration = Duration::from_secs(5);
/// Between two looks at whether the node is still there.
pub(super) const LOOK: Duration = Duration::from_millis(500);
/// For what a node tells besides its last answer.
const BESIDES: Duration = Duration::from_millis(300);
/// For answers that are under way after the last request that is played at a rate.
const STRAGGLERS: Duration = Duration::from_secs(10);

pub(super) fn ask(
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
pub(super) fn let_go(node: &Running, trace: &mut Trace) -> Result<bool> {
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
