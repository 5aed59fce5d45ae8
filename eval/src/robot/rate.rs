//! Requests at a fixed rate while the network changes, and the stub's log about each request.

use std::time::{Duration, Instant};

use anyhow::Result;
use support::site::NodeProcess;
use tokio::time::Instant as At;

use super::RobotPlan;
use super::answers::record_answer;
use super::asking::note_node_exit;
use super::ends::RobotEndpoints;
use super::numbers::{FIRST, WARM_UP};
use crate::place::request_network;
use crate::recording::RecordedStep;
use crate::trace::{RequestSample, Trace};

/// Number of consecutive answers in time after which requests are counted.
const AWAKE: usize = 6;
/// Maximum time for the warm-up; after that requests are counted anyway.
const PATIENCE: Duration = Duration::from_secs(30);

impl RobotEndpoints {
    /// Publishes the steps at a rate (requests per second, and seconds within which an answer is in time).
    pub(super) async fn ask_at_rate(
        &mut self,
        plan: &RobotPlan,
        (hertz, in_time): (f64, f64),
        steps: &[&RecordedStep<'_>],
        node: &mut NodeProcess,
    ) -> Result<Trace> {
        let mut trace = Trace { late_before: !self.warm_up(steps, (hertz, in_time)).await?, ..Trace::default() };
        let begun = At::now();
        let mut sent: Vec<At> = Vec::new();
        for (index, step) in steps.iter().enumerate() {
            let due = begun + Duration::from_secs_f64(index as f64 / hertz);
            self.collect_answers(&mut trace.requests, &sent, due).await;
            for (_, network) in plan.changes.iter().filter(|(at, _)| *at == index + 1) {
                request_network(*network)?;
            }
            trace.requests.push(RequestSample {
                at: begun.elapsed().as_secs_f64(),
                stamp: step.at,
                ..RequestSample::default()
            });
            sent.push(At::now());
            self.publish(step, FIRST + index as u32)?;
            self.collect_other_topics(&mut trace);
        }
        let until = At::now() + Duration::from_secs_f64(plan.give_up);
        self.collect_until_answered(&mut trace.requests, &sent, until).await;
        note_node_exit(node, &mut trace)?;
        trace.lasted = begun.elapsed().as_secs_f64();
        Ok(trace)
    }

    /// Sends requests at that rate until enough answers in a row are in time, which shows that everything is warmed up;
    /// returns whether that happened.
    async fn warm_up(&mut self, steps: &[&RecordedStep<'_>], (hertz, in_time): (f64, f64)) -> Result<bool> {
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

    /// Records answers until `until`, or until none is missing.
    async fn collect_until_answered(&mut self, requests: &mut [RequestSample], sent: &[At], until: At) {
        while requests.iter().any(|request| request.response.is_none()) {
            let waited = tokio::time::timeout_at(until, self.answers.messages.recv());
            let Ok(Some(message)) = waited.await else {
                return;
            };
            record_answer(requests, sent, &message);
        }
    }
}

/// Adds information from the stub's log: who gave the first answer to a request, and Q once it was counted.
pub(super) fn apply_stub_log(log: &str, requests: &mut [RequestSample]) {
    for line in log.lines() {
        let after = |key: &str| line.split(key).nth(1);
        let stamp = after("stamp=Some((").and_then(|rest| rest.split(',').next());
        let number = stamp.and_then(|number| number.parse::<u32>().ok());
        let index = number.and_then(|number| number.checked_sub(FIRST));
        let Some(request) = index.and_then(|index| requests.get_mut(index as usize)) else {
            continue;
        };
        request.local = line.contains("answer=Some((Local");
        let q = after(" q=").and_then(|rest| rest.split(' ').next()?.parse().ok());
        // Later log lines about a request do not change the value that Q had when it was counted.
        request.satisfaction = request.satisfaction.or(q);
    }
}

/// Counts in the stub's log, from the first measured request on, how often it asked the local original as well, no
/// longer asked it, started its process, and stopped it.
pub(super) fn count_handovers(log: &str) -> [usize; 4] {
    let begins = log.find(&format!("stamp=Some(({FIRST},")).unwrap_or(0);
    [
        "the local original answers, too",
        "the cloud answers alone",
        "the local original is started",
        "the local original is stopped",
    ]
    .map(|words| log[begins..].matches(words).count())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stubs_log_tells_who_answered_and_q() {
        let log = "DEBUG requests: id=1 name=/image stamp=Some((3, 0)) answer=Some((Cloud, 0.2)) cloud=Some(0.2) \
            q=15.5 phases=None\n\
            DEBUG requests: id=2 name=/image stamp=Some((1001, 0)) answer=Some((Local, 0.3)) cloud=None q=7.5 \
            phases=None\n\
            DEBUG requests: id=2 name=/image stamp=Some((1001, 0)) answer=Some((Local, 0.3)) cloud=Some(2.5) q=3.75 \
            phases=None\n\
            INFO something else\n\
            DEBUG requests: id=9 name=/image stamp=Some((1009, 0)) answer=None cloud=None q=1 phases=None\n";
        let mut requests = vec![RequestSample::default(); 2];
        apply_stub_log(log, &mut requests);
        assert_eq!(requests[0], RequestSample::default());
        assert!(requests[1].local);
        assert_eq!(requests[1].satisfaction, Some(7.5));
    }

    #[test]
    fn handovers_count_from_the_first_measured_request_on() {
        let log = "INFO the cloud answers alone\nDEBUG requests: stamp=Some((1000, 0)) answer=None\n\
            INFO the local original is started\nINFO the local original answers, too\nINFO the cloud answers alone\n";
        assert_eq!(count_handovers(log), [1, 1, 1, 0]);
    }
}
