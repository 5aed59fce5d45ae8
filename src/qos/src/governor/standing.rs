//! How it stands, for diagnostics.

use std::time::Instant;

use super::Governor;
use crate::decider::{Event, LocalState};
use crate::report::{Report, TimedEvent};
use crate::sla::{Local, Measure, Mode};

impl<P: Clone> Governor<P> {
    /// A snapshot for diagnostics.
    pub fn report(&self, now: Instant) -> Report {
        let event = |(at, event): &(Instant, Event)| TimedEvent {
            ago: now.saturating_duration_since(*at).as_secs_f64(),
            event: event.clone(),
        };
        Report {
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
            pairs: self.pairs.iter().map(|stream| stream.shown()).collect(),
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
                "no response time is promised; the local original stands in {} s after the link is lost",
                after.as_secs_f64()
            ),
            _ => format!(
                "Q {:.1} of threshold {:.1}",
                self.satisfaction.q(),
                self.satisfaction.threshold()
            ),
        };
        let who = match (self.link, self.decider.is_fed(), self.decider.state()) {
            (true, false, _) if self.sla.is_of_link() || !self.satisfaction.wants_local() => {
                "the cloud answers"
            }
            (true, false, LocalState::Missing) => {
                "the cloud is slow, and there is no local original"
            }
            (true, false, _) if self.sla.local == Local::None => {
                "the cloud is slow, and no local original is to be used"
            }
            (true, false, _) if self.sla.mode == Mode::Stateful => {
                "the cloud is slow; stateful, so it answers alone"
            }
            (true, false, _) => "the cloud is slow, and the local original is starting",
            (true, true, _) if self.sla.is_of_link() => "the cloud takes over again",
            (true, true, _) => "the cloud is slow, so both are asked and the first answer is taken",
            (false, true, _) => "the link is down, the local original answers",
            (false, false, LocalState::Missing) => {
                "the link is down, and there is no local original: nobody answers"
            }
            (false, false, _) => "the link is down, and the local original does not answer yet",
        };
        match self.phases.dominant() {
            Some((phase, share)) => {
                format!(
                    "{who} ({q}); of the cloud's time {:.0}% is {phase}",
                    share * 100.0
                )
            }
            None => format!("{who} ({q})"),
        }
    }
}
