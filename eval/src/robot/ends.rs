//! The robot's own node: publishes requests, and receives answers, timings and maps.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use ros::bus::{Bus, Publisher, QosProfile, SerializedMessage, Subscription};
use ros::ros1::Ros1Bus;
use support::site::{NodeProcess, Site};
use tokio::time::{Instant as At, sleep_until, timeout};

use super::answers::{read_grid, record_answer, request_number};
use super::asking::{LOOK, has_ended};
use super::plan::{FIRST, RobotPlan};
use crate::recording::{RecordedStep, Recording, read_floats, read_header, with_relative_stamp, with_stamp};
use crate::trace::{ComputationPhases, RequestSample, Trace};

/// Publishers and subscriptions of the robot's node.
pub(super) struct RobotEndpoints {
    pub(super) inputs: Vec<(Arc<str>, Box<dyn Publisher>)>,
    pub(super) answers: Subscription,
    pub(super) timing: Option<Subscription>,
    maps: Option<Subscription>,
    _node: Arc<Ros1Bus>,
}

pub(super) fn create_endpoints(site: &Site, plan: &RobotPlan, recording: &Recording) -> Result<RobotEndpoints> {
    let node = site.node("/robot")?;
    let mut inputs = Vec::new();
    for one in recording.topics(&plan.left_out) {
        let of = (*one.wire_type).clone();
        let advertised = node.advertise(&one.topic, of, QosProfile::keep_last(10));
        inputs.push((one.topic.clone(), site.runtime.block_on(advertised)?));
    }
    let hears = |topic: &Option<String>| -> Result<Option<Subscription>> {
        let topic = topic.as_ref();
        topic.map(|topic| site.subscribe(&node, topic)).transpose()
    };
    Ok(RobotEndpoints {
        inputs,
        answers: site.subscribe(&node, &plan.answer)?,
        timing: hears(&plan.timing)?,
        maps: hears(&plan.map)?,
        _node: node,
    })
}

impl RobotEndpoints {
    /// Publishes a request with the messages recorded before it.
    pub(super) fn publish(&self, step: &RecordedStep, number: u32) -> Result<()> {
        let send = |topic: &str, bytes| {
            if let Some((_, publisher)) = self.inputs.iter().find(|(name, _)| **name == *topic) {
                publisher.publish(bytes);
            }
        };
        for message in &step.before {
            send(&message.topic, with_relative_stamp(message, step.request, number));
        }
        let request = with_stamp(&step.request.bytes, number);
        let request = request.with_context(|| format!("messages of {} have no header", step.request.topic))?;
        send(&step.request.topic, request);
        Ok(())
    }

    pub(super) async fn wait_for_answer(&mut self, number: u32, give_up: Duration) -> Option<SerializedMessage> {
        let waited = timeout(give_up, async {
            loop {
                let message = self.answers.messages.recv().await?;
                if request_number(&message) == Some(number) {
                    return Some(message);
                }
            }
        });
        waited.await.ok().flatten()
    }

    /// Waits for the first answer to a request, but not after the node has exited.
    pub(super) async fn wait_while_running(
        &mut self,
        number: u32,
        until: At,
        node: &NodeProcess,
    ) -> Option<SerializedMessage> {
        loop {
            let left = until.saturating_duration_since(At::now());
            let message = self.wait_for_answer(number, left.min(LOOK)).await;
            if message.is_some() || left <= LOOK || has_ended(node) {
                return message;
            }
        }
    }

    /// Records answers until `until`, or until the last request is answered.
    pub(super) async fn collect_answers(&mut self, requests: &mut [RequestSample], sent: &[At], until: At) {
        loop {
            let message = tokio::select! {
                biased;
                Some(message) = self.answers.messages.recv() => message,
                () = sleep_until(until) => return,
            };
            record_answer(requests, sent, &message);
        }
    }

    /// Adds messages of other topics that have arrived; their queues hold a hundred messages.
    pub(super) fn collect_other_topics(&mut self, trace: &mut Trace) {
        self.collect_timings(&mut trace.requests);
        if let Some(maps) = &mut self.maps {
            while let Some(message) = maps.messages.try_recv() {
                trace.map = read_grid(&message.bytes).or(trace.map.take());
            }
        }
    }

    fn collect_timings(&mut self, requests: &mut [RequestSample]) {
        let Some(timing) = &mut self.timing else {
            return;
        };
        while let Some(message) = timing.messages.try_recv() {
            let Some(index) = request_number(&message).and_then(|number| number.checked_sub(FIRST)) else {
                continue;
            };
            let from = read_header(&message.bytes).map_or(0, |header| header.end);
            let told = read_floats(&message.bytes, from, 3);
            let (Some(request), Some([acquisition, computation, rendering])) =
                (requests.get_mut(index as usize), told.as_deref())
            else {
                continue;
            };
            request.phases =
                Some(ComputationPhases { acquisition: *acquisition, computation: *computation, rendering: *rendering });
        }
    }
}
