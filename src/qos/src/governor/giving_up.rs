//! Requests that nobody will answer any more.

use super::{Channel, Effect, Governor};
use crate::arbiter::{Kind, Record};
use crate::decider::LocalState;
use crate::request::{Leg, RequestId};
use crate::sla::Local;

impl<P: Clone> Governor<P> {
    /// Fails a call that nobody can answer any more. While the link is down the cloud may come back, and until its
    /// T_max a call waits for that.
    pub(super) fn fail_if_hopeless(&mut self, id: RequestId) {
        let Some(record) = self.arbiter.get(id) else {
            return;
        };
        // Goals on topics have no caller to tell: they wait for whoever comes.
        if !record.has_caller() || !record.is_open() {
            return;
        }
        let local = match &record.local {
            Leg::Asked => return,
            Leg::NotAsked if self.decider.is_coming() => return,
            Leg::Failed(reason) => reason.clone(),
            _ => match (self.sla.local, self.decider.state()) {
                (Local::None, _) => "no local original is to be used".to_owned(),
                (_, LocalState::Missing) => "there is no local original".to_owned(),
                _ => "the local original does not run".to_owned(),
            },
        };
        let cloud = match &record.cloud {
            Leg::Failed(reason) => reason.clone(),
            // It is being carried out there, and its result comes when the link is back.
            Leg::Lost if record.kind == Kind::Goal => return,
            Leg::NotAsked | Leg::Lost if !self.link && record.overdue => {
                format!(
                    "the link is down and was not up again within {:?}",
                    record.deadline - record.asked_at
                )
            }
            _ => return,
        };
        let channel = record.channel.clone();
        self.give_up(id, channel, format!("cloud: {cloud}; local: {local}"));
    }

    pub(super) fn give_up(&mut self, request: RequestId, channel: Channel, reason: String) {
        if self.arbiter.fail(request) {
            self.counts.failed += 1;
            self.effects.push_back(Effect::Fail {
                request,
                channel,
                reason,
            });
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
            let reason = "nobody answered while it was remembered".to_owned();
            self.effects.push_back(Effect::Fail {
                request,
                channel: record.channel,
                reason,
            });
        }
    }
}
