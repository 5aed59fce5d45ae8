//! The robot's own node: it publishes requests, and hears answers, timings and maps.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use ros::bus::{Bus, Message, Publisher, Qos, Subscription};
use ros::ros1::Ros1Bus;
use support::site::{Running, Site};
use tokio::time::{Instant as At, sleep_until, timeout};

use super::answers::{grid, note, number_of};
use super::asking::{LOOK, has_ended};
use super::{FIRST, Plan};
use crate::recording::{Recording, Step, header, numbers, restamped, stamped_before};
use crate::trace::{Phases, Request, Trace};

/// The robot's ends of everything.
pub(super) struct Ends {
    pub(super) inputs: Vec<(Arc<str>, Box<dyn Publisher>)>,
    pub(super) answers: Subscription,
    pub(super) timing: Option<Subscription>,
    maps: Option<Subscription>,
    _node: Arc<Ros1Bus>,
}

pub(super) fn ends(site: &Site, plan: &Plan, recording: &Recording) -> Result<Ends> {
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

impl Ends {
    /// Publishes a request with what was recorded before it.
    pub(super) fn publish(&self, step: &Step, number: u32) -> Result<()> {
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
    pub(super) async fn answer(&mut self, number: u32, give_up: Duration) -> Option<Message> {
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
    pub(super) async fn answer_while(
        &mut self,
        number: u32,
        until: At,
        node: &Running,
    ) -> Option<Message> {
        loop {
            let left = until.saturating_duration_since(At::now());
            let message = self.answer(number, left.min(LOOK)).await;
            if message.is_some() || left <= LOOK || has_ended(node) {
                return message;
            }
        }
    }

    /// Notes answers until then, or until the last request is answered.
    pub(super) async fn collect(&mut self, requests: &mut [Request], sent: &[At], until: At) {
        loop {
            let message = tokio::select! {
                biased;
                Some(message) = self.answers.messages.recv() => message,
                () = sleep_until(until) => return,
            };
            note(requests, sent, &message);
        }
    }

    /// Adds what has come on other topics by now; their queues keep a hundred messages.
    pub(super) fn besides(&mut self, trace: &mut Trace) {
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
