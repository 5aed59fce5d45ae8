//! Hedged requests: what the cloud has not answered shortly before T_max is also sent to a warm local original.
//!
//! Q is lowered by late requests alone, so without this each hand-over begins with at least one request that nobody
//! answered in time. The cloud's time counts as if there were no hedge. For the idea see Dean and Barroso, "The Tail at
//! Scale" (CACM 56(2), 2013).

use std::time::{Duration, Instant};

use super::Governor;
use crate::arbiter::{Kind, Record};
use crate::decider::LocalState;
use crate::request::{RequestId, RequestLeg, Responder};
use crate::sla::{Measure, Mode, Times};

impl<P: Clone> Governor<P> {
    /// Returns the time after which a request is hedged, if a warm local original waits for work: early enough that two
    /// of its response times, and at least a quarter of T_max, remain until T_max, but never before T_desire. Goals are
    /// not hedged, because two sides would carry them out.
    pub(super) fn hedge_delay(&self, kind: Kind, times: Times) -> Option<Duration> {
        let is_independent = self.sla.mode == Mode::Stateless && self.sla.measure == Measure::Rrt;
        if kind == Kind::Goal || !is_independent || !self.has_idle_original() {
            return None;
        }
        let latest = self.local_time.map(|time| times.t_max.saturating_sub((2 * time).max(times.t_max / 4)));
        let delay = latest.unwrap_or_default().max(times.t_desire);
        (delay < times.t_max).then_some(delay)
    }

    fn has_idle_original(&self) -> bool {
        self.decider.state() == LocalState::Ready && !self.decider.is_fed()
    }

    /// Sends a request to the local original that the cloud has not answered. Of the inputs of a pair the newest one
    /// is sent: its answer shows that the earlier ones were skipped.
    pub(super) fn hedge(&mut self, now: Instant, id: RequestId) {
        let Some(record) = self.arbiter.get(id).filter(|record| self.has_idle_original() && awaits_cloud(record))
        else {
            return;
        };
        let Kind::Input(pair) = record.kind else {
            return self.ask(now, id, Responder::Local);
        };
        let stream = &self.pairs[pair];
        if stream.passed > Some(id) {
            return;
        }
        let cloud = &stream.queues[Responder::Cloud.index()];
        // The node in the cloud may have skipped this one for a later one, which has its time, too.
        let heard = cloud.passed_over_since(id, record.asked_at);
        let delay = self.hedge_delay(record.kind, self.sla.times(record.channel.name()));
        if let Some(later) = heard.zip(delay).map(|(heard, delay)| heard + delay).filter(|later| *later > now) {
            if later <= record.deadline {
                self.arbiter.schedule_hedge(id, later);
            }
            return;
        }
        let is_keyed = record.key.is_some();
        let is_like_it = |record: &Record<P>| record.key.is_some() == is_keyed && awaits_cloud(record);
        let newest = cloud.waiting.iter().rfind(|id| self.arbiter.get(**id).is_some_and(is_like_it)).copied();
        // Without a key an answer belongs to the only one that was sent.
        if let Some(newest) = newest.filter(|_| is_keyed || self.is_free(pair, Responder::Local)) {
            self.ask(now, newest, Responder::Local);
        }
    }
}

/// Returns true if the request is open, the cloud may still answer it, and the local original was not asked.
fn awaits_cloud<P>(record: &Record<P>) -> bool {
    let is_asked = matches!(record.cloud, RequestLeg::Asked | RequestLeg::Lost | RequestLeg::NotAsked);
    record.is_open() && is_asked && record.local == RequestLeg::NotAsked
}
