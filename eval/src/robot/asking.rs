//! Sends requests to the node once it is connected: one after the other's answer, or at the recorded times; and checks
//! that the node is still running.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use ros::bus::MatchedPeers;
use support::procfs;
use support::site::{NodeProcess, Site};
use tokio::sync::watch::Receiver;
use tokio::time::{Instant as At, timeout};

use super::answers::fill_answer;
use super::carried;
use super::ends::RobotEndpoints;
use super::plan::{FIRST, RequestPacing, RobotPlan, WARM_UP};
use crate::place::request_network;
use crate::recording::RecordedStep;
use crate::trace::{RequestSample, Trace};

/// Timeout of an answer during warm-up; nodes may take several seconds to start.
const BEGINNING: Duration = Duration::from_secs(40);
/// Maximum time for the node to connect to its requests, and for the robot to its answers.
const CONNECTION: Duration = Duration::from_secs(120);
/// Maximum time for the node to connect to the accompanying topics.
const OTHERS: Duration = Duration::from_secs(5);
/// Polling interval for the end of the node.
pub(super) const LOOK: Duration = Duration::from_millis(500);
/// Time for messages of other topics after the last answer.
const BESIDES: Duration = Duration::from_millis(300);
/// Number of consecutive answers in time after which requests at a rate are counted, and maximum time for that.
const AWAKE: usize = 6;
const PATIENCE: Duration = Duration::from_secs(30);

pub(super) fn ask(
    site: &Site,
    ends: &mut RobotEndpoints,
    plan: &RobotPlan,
    steps: &[RecordedStep],
    node: &mut NodeProcess,
) -> Result<Trace> {
    let request = ends.inputs.iter().find(|(name, _)| **name == *plan.request);
    let (_, publisher) = request.context("the topic of requests is recorded")?;
    // Messages published before the other end is connected are lost, and answers would differ between runs.
    let connects = (publisher.matched_subscribers(), ends.answers.matched.clone());
    let mut ended = Trace::default();
    if !wait_until_connected(site, connects, node, &mut ended)? {
        return Ok(ended);
    }
    for (_, publisher) in &ends.inputs {
        let mut now = publisher.matched_subscribers();
        let others = now.wait_for(|now| now.connected_count() > 0);
        // A package need not subscribe to everything that was recorded.
        let _ = site.runtime.block_on(async { timeout(OTHERS, others).await.is_ok() });
    }
    site.runtime.block_on(async {
        let (warm_up, measured) = steps.split_at(WARM_UP);
        for (index, step) in warm_up.iter().enumerate() {
            let number = index as u32 + 1;
            ends.publish(step, number)?;
            // Warm-up requests do not count, answered or not.
            let mut ended = Trace::default();
            if ends.wait_for_answer(number, BEGINNING).await.is_none() && note_node_exit(node, &mut ended)? {
                return Ok(ended);
            }
        }
        let chosen = measured.iter().step_by(plan.every).take(plan.most);
        let chosen: Vec<&RecordedStep> = chosen.collect();
        let mut trace = match plan.pace {
            RequestPacing::OneByOne => ends.ask_one_by_one(plan, &chosen, node).await?,
            RequestPacing::Recorded(speed) => {
                let first = chosen.first().map_or(0.0, |step| step.at);
                let due: Vec<_> = chosen.iter().map(|step| ((step.at - first) / speed, *step)).collect();
                // The last answer ends the wait: earlier ones will not arrive any more.
                ends.ask_when_due(plan, &due, |all| all.last().is_none_or(|last| last.response.is_some())).await?
            }
            RequestPacing::Played(_) => bail!("rosbag plays by itself"),
            RequestPacing::Rate { hertz, in_time } => {
                let cycle: Vec<&RecordedStep> = measured.iter().cycle().take(plan.most).collect();
                let late_before = !ends.warm_up(&cycle, hertz, in_time).await?;
                let due: Vec<_> = (0..).zip(cycle).map(|(index, step)| (f64::from(index) / hertz, step)).collect();
                let ask = ends.ask_when_due(plan, &due, |all| all.iter().all(|one| one.response.is_some()));
                Trace { late_before, ..ask.await? }
            }
        };
        note_node_exit(node, &mut trace)?;
        // Messages of other topics arrive on other connections, possibly a little later than the last answer.
        let until = At::now() + BESIDES;
        let unheard = |trace: &Trace| {
            let last = trace.requests.last();
            last.is_some_and(|last| last.response.is_some() && last.phases.is_none())
        };
        while ends.timing.is_some() && unheard(&trace) && At::now() < until {
            ends.collect_other_topics(&mut trace);
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        ends.collect_other_topics(&mut trace);
        Ok(trace)
    })
}

impl RobotEndpoints {
    async fn ask_one_by_one(
        &mut self,
        plan: &RobotPlan,
        steps: &[&RecordedStep<'_>],
        node: &mut NodeProcess,
    ) -> Result<Trace> {
        let begun = Instant::now();
        let mut trace = Trace::default();
        for (index, step) in steps.iter().enumerate() {
            let number = FIRST + index as u32;
            let sent = Instant::now();
            self.publish(step, number)?;
            let until = At::now() + Duration::from_secs_f64(plan.give_up);
            let at = (sent - begun).as_secs_f64();
            let mut request = RequestSample { at, stamp: step.at, ..RequestSample::default() };
            if let Some(message) = self.wait_while_running(number, until, node).await {
                fill_answer(&mut request, &message, sent.elapsed());
                request.pose = request.pose.filter(|_| plan.tells_pose);
                request.carried = carried::read_counters()?;
            }
            let is_lost = request.response.is_none();
            trace.requests.push(request);
            self.collect_other_topics(&mut trace);
            if is_lost && has_ended(node) {
                break;
            }
        }
        trace.lasted = begun.elapsed().as_secs_f64();
        Ok(trace)
    }

    /// Publishes each step when it is due, in seconds after the first one, then waits for late answers until `is_over`,
    /// at most for the plan's time.
    async fn ask_when_due(
        &mut self,
        plan: &RobotPlan,
        steps: &[(f64, &RecordedStep<'_>)],
        is_over: fn(&[RequestSample]) -> bool,
    ) -> Result<Trace> {
        let begun = At::now();
        let mut trace = Trace::default();
        let mut sent: Vec<At> = Vec::new();
        for (index, (due, step)) in steps.iter().enumerate() {
            self.collect_answers(&mut trace.requests, &sent, begun + Duration::from_secs_f64(*due)).await;
            for (_, network) in plan.changes.iter().filter(|(at, _)| *at == index + 1) {
                request_network(*network)?;
            }
            let at = begun.elapsed().as_secs_f64();
            trace.requests.push(RequestSample { at, stamp: step.at, ..RequestSample::default() });
            sent.push(At::now());
            self.publish(step, FIRST + index as u32)?;
            self.collect_other_topics(&mut trace);
        }
        let until = At::now() + Duration::from_secs_f64(plan.give_up);
        while !is_over(&trace.requests) && At::now() < until {
            self.collect_answers(&mut trace.requests, &sent, until.min(At::now() + LOOK)).await;
        }
        // The last map is on the way.
        self.collect_answers(&mut trace.requests, &sent, At::now() + LOOK).await;
        trace.lasted = begun.elapsed().as_secs_f64();
        Ok(trace)
    }

    /// Sends requests at a rate until enough answers in a row are in time, which shows that everything is warmed up;
    /// returns whether that happened.
    async fn warm_up(&mut self, steps: &[&RecordedStep<'_>], hertz: f64, in_time: f64) -> Result<bool> {
        let begun = Instant::now();
        let (mut awake, mut number) = (0, WARM_UP as u32);
        while awake < AWAKE {
            if begun.elapsed() > PATIENCE || number + 1 >= FIRST {
                return Ok(false);
            }
            number += 1;
            let (step, asked) = (steps[number as usize % steps.len()], At::now());
            self.publish(step, number)?;
            let came = self.wait_for_answer(number, Duration::from_secs_f64(in_time)).await;
            awake = if came.is_some() { awake + 1 } else { 0 };
            tokio::time::sleep_until(asked + Duration::from_secs_f64(1.0 / hertz)).await;
        }
        Ok(true)
    }
}

/// Waits until the node is connected to the requests and the robot to the answers; returns false, with a note in the
/// trace, if the node has exited.
fn wait_until_connected(
    site: &Site,
    (mut requests, mut answers): (Receiver<MatchedPeers>, Receiver<MatchedPeers>),
    node: &NodeProcess,
    trace: &mut Trace,
) -> Result<bool> {
    let begun = Instant::now();
    loop {
        let both = async {
            let there = |now: &MatchedPeers| now.connected_count() > 0;
            requests.wait_for(there).await.is_ok() && answers.wait_for(there).await.is_ok()
        };
        let reached = site.runtime.block_on(async { timeout(LOOK, both).await });
        if matches!(reached, Ok(true)) {
            return Ok(true);
        }
        if note_node_exit(node, trace)? {
            return Ok(false);
        }
        ensure!(
            begun.elapsed() < CONNECTION,
            "{} s after its start the node is not connected to the robot's topics",
            CONNECTION.as_secs()
        );
    }
}

/// Returns whether the node has exited, and notes that in the trace.
pub(super) fn note_node_exit(node: &NodeProcess, trace: &mut Trace) -> Result<bool> {
    let ended = has_ended(node);
    if ended {
        let said = node.output();
        let last = said.lines().last().unwrap_or("nothing");
        trace.node_ended = Some(format!("the node has ended; its last words: {last}"));
    }
    Ok(ended)
}

pub fn has_ended(node: &NodeProcess) -> bool {
    !procfs::is_running(node.pid() as i32)
}
