//! Reports for diagnostics.

use std::time::Instant;

use super::Governor;
use crate::decider::{LocalState, QosEvent};
use crate::report::{QosReport, TimedEvent};
use crate::sla::{LocalPolicy, Measure, Mode};

impl<P: Clone> Governor<P> {
    /// Returns a snapshot for diagnostics.
    pub fn report(&self, now: Instant) -> QosReport {
        let event = |(at, event): &(Instant, QosEvent)| TimedEvent {
            ago: now.saturating_duration_since(*at).as_secs_f64(),
            event: event.clone(),
        };
        QosReport {
            t_desire: self.sla.t_desire.as_secs_f64(),
            t_max: self.sla.t_max.as_secs_f64(),
            q: self.satisfaction.q(),
            threshold: self.satisfaction.threshold(),
            mode: self.sla.mode,
            local: self.sla.local,
            local_state: self.decider.state(),
            fed: self.decider.is_fed(),
            link: self.link,
            fallback_after: match self.sla.measure {
                Measure::Link { after } => Some(after.as_secs_f64()),
                _ => None,
            },
            pairs: self.pairs.iter().map(|stream| stream.describe()).collect(),
            counts: self.counts,
            phases: self.phases.quantiles(),
            events: self.events.iter().map(event).collect(),
            lost: None,
            summary: self.summary(),
        }
    }

    fn summary(&self) -> String {
        let q = match self.sla.measure {
            Measure::Link { after } => format!(
                "no response time set; the local original takes over {} s after the link is lost",
                after.as_secs_f64()
            ),
            _ => format!("Q {:.1}, threshold {:.1}", self.satisfaction.q(), self.satisfaction.threshold()),
        };
        let who = match (self.link, self.decider.is_fed(), self.decider.state()) {
            (true, false, _) if self.sla.is_link_based() || !self.satisfaction.wants_local() => "the cloud answers",
            (true, false, LocalState::Missing) => "the cloud is slow, and there is no local original",
            (true, false, _) if self.sla.local == LocalPolicy::None => {
                "the cloud is slow, the local original is disabled"
            }
            (true, false, _) if self.sla.mode == Mode::Stateful => {
                "the cloud is slow, but answers alone because the service is stateful"
            }
            (true, false, _) => "the cloud is slow, and the local original is starting",
            (true, true, _) if self.sla.is_link_based() => "the cloud takes over again",
            (true, true, _) => "the cloud is slow, so both are asked and the first answer is used",
            (false, true, _) => "the link is down, the local original answers",
            (false, false, LocalState::Missing) => "the link is down, and there is no local original: nobody answers",
            (false, false, _) => "the link is down, the local original does not answer yet",
        };
        match self.phases.dominant() {
            Some((phase, share)) => {
                format!("{who} ({q}); {:.0}% of the cloud's response time is {phase}", share * 100.0)
            }
            None => format!("{who} ({q})"),
        }
    }
}
