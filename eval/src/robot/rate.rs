//! Requests at a rate, while the network changes, and what the stub tells of each.

use std::time::{Duration, Instant};

use anyhow::Result;
use support::site::Running;
use tokio::time::Instant as At;

use super::answers::note;
use super::asking::let_go;
use super::ends::Ends;
use super::{FIRST, Plan, WARM_UP};
use crate::place::asks_for;
use crate::recording::Step;
use crate::trace::{Request, Trace};

/// So many answers in a row are in time before requests are counted.
const AWAKE: usize = 6;
/// For that; then they are counted all the same.
const PATIENCE: Duration = Duration::from_secs(30);

impl Ends {
    /// Publishes the steps at a rate (requests per second, and seconds within which an answer is in time).
    pub(super) async fn at_a_rate(
        &mut self,
        plan: &Plan,
        (hertz, in_time): (f64, f64),
        steps: &[&Step<'_>],
        node: &mut Running,
    ) -> Result<Trace> {
        let mut trace = Trace {
            late_before: !self.wakes(steps, (hertz, in_time)).await?,
            ..Trace::default()
        };
        let begun = At::now();
        let mut sent: Vec<At> = Vec::new();
        for (index, step) in steps.iter().enumerate() {
            let due = begun + Duration::from_secs_f64(index as f64 / hertz);
            self.collect(&mut trace.requests, &sent, due).await;
            for (_, network) in plan.changes.iter().filter(|(at, _)| *at == index + 1) {
                asks_for(*network)?;
            }
            trace.requests.push(Request {
                at: begun.elapsed().as_secs_f64(),
                stamp: step.at,
                ..Request::default()
            });
            sent.push(At::now());
            self.publish(step, FIRST + index as u32)?;
            self.besides(&mut trace);
        }
        let until = At::now() + Duration::from_secs_f64(plan.give_up);
        self.collect_all(&mut trace.requests, &sent, until).await;
        let_go(node, &mut trace)?;
        trace.lasted = begun.elapsed().as_secs_f64();
        Ok(trace)
    }

    /// Asks at that rate until enough answers in a row are in time: by then all are awake. Whether that came about.
    async fn wakes(&mut self, steps: &[&Step<'_>], (hertz, in_time): (f64, f64)) -> Result<bool> {
        let begun = Instant::now();
        let (mut awake, mut number) = (0, WARM_UP as u32);
        while awake < AWAKE {
            if begun.elapsed() > PATIENCE || number + 1 >= FIRST {
                return Ok(false);
            }
            number += 1;
            let (step, asked) = (steps[number as usize % steps.len()], At::now());
            self.publish(step, number)?;
            let came = self.answer(number, Duration::from_secs_f64(in_time)).await;
            awake = if came.is_some() { awake + 1 } else { 0 };
            tokio::time::sleep_until(asked + Duration::from_secs_f64(1.0 / hertz)).await;
        }
        Ok(true)
    }

    /// Notes answers until then, or until none is missing.
    async fn collect_all(&mut self, requests: &mut [Request], sent: &[At], until: At) {
        while requests.iter().any(|request| request.response.is_none()) {
            let waited = tokio::time::timeout_at(until, self.answers.messages.recv());
            let Ok(Some(message)) = waited.await else {
                return;
            };
            note(requests, sent, &message);
        }
    }
}

/// Adds what a stub's log tells of requests: whose answer was the first, and Q once it was counted.
pub(super) fn told(log: &str, requests: &mut [Request]) {
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
        // What is told later of a request does not change what Q was when it counted.
        request.satisfaction = request.satisfaction.or(q);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stubs_log_tells_who_answered_and_q() {
        let log = "DEBUG requests: id=1 name=/image stamp=Some((3, 0)) answer=Some((Cloud, 0.2)) cloud=Some(0.2) q=15.5 phases=None\n\
            DEBUG requests: id=2 name=/image stamp=Some((1001, 0)) answer=Some((Local, 0.3)) cloud=None q=7.5 phases=None\n\
            DEBUG requests: id=2 name=/image stamp=Some((1001, 0)) answer=Some((Local, 0.3)) cloud=Some(2.5) q=3.75 phases=None\n\
            INFO something else\n\
            DEBUG requests: id=9 name=/image stamp=Some((1009, 0)) answer=None cloud=None q=1 phases=None\n";
        let mut requests = vec![Request::default(); 2];
        told(log, &mut requests);
        assert_eq!(requests[0], Request::default());
        assert!(requests[1].local);
        assert_eq!(requests[1].satisfaction, Some(7.5));
    }
}
