//! Fails requests that no side will answer.

use super::{Effect, Governor, RequestChannel};
use crate::arbiter::{Kind, Record};
use crate::decider::LocalState;
use crate::request::{RequestId, RequestLeg};
use crate::sla::LocalPolicy;

impl<P: Clone> Governor<P> {
    /// Fails a call that no side can answer any more. While the link is down the cloud may come back, so a call waits
    /// for it until T_max.
    pub(super) fn fail_if_hopeless(&mut self, id: RequestId) {
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        // Goals on topics have no caller that could be told, so they stay open.
        if !record.has_caller() || !record.is_open() {
            return;
        }
        let local = match &record.local {
            RequestLeg::Asked => return,
            RequestLeg::NotAsked if self.decider.is_coming() => return,
            RequestLeg::Failed(reason) => reason.clone(),
            _ => match (self.sla.local, self.decider.state()) {
                (LocalPolicy::None, _) => "the local original is disabled".to_owned(),
                (_, LocalState::Missing) => "there is no local original".to_owned(),
                _ => "the local original is not running".to_owned(),
            },
        };
        let cloud = match &record.cloud {
            RequestLeg::Failed(reason) => reason.clone(),
            // The cloud carries it out, and its result comes when the link is back.
            RequestLeg::Lost if record.kind == Kind::Goal => return,
            RequestLeg::NotAsked | RequestLeg::Lost if !self.link && record.overdue => {
                format!("the link is down and did not recover within {:?}", record.deadline - record.asked_at)
            }
            _ => return,
        };
        let channel = record.channel.clone();
        self.give_up(id, channel, format!("cloud: {cloud}; local: {local}"));
    }

    pub(super) fn give_up(&mut self, request: RequestId, channel: RequestChannel, reason: String) {
        if self.arbiter.fail(request) {
            self.counts.failed += 1;
            self.effects.push_back(Effect::Fail { request, channel, reason });
        }
    }

    pub(super) fn forget(&mut self, request: RequestId, record: Record<P>) {
        if let Kind::Input(pair) = record.kind {
            for queue in &mut self.pairs[pair].queues {
                queue.waiting.retain(|waiting| *waiting != request);
            }
        }
        if record.is_open() && (record.missed || record.is_call() || !record.overdue) {
            self.counts.failed += 1;
            let reason = "no answer arrived before the request was discarded".to_owned();
            self.effects.push_back(Effect::Fail { request, channel: record.channel, reason });
        }
    }
}
