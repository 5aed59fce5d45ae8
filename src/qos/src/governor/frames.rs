//! SLAs on the rate or the age of an output.

use std::time::{Duration, Instant};

use super::Governor;
use crate::measure::Meter;

/// Meters for the output that the SLA measures.
#[derive(Debug)]
pub(super) struct OutputMeters {
    pub(super) output: String,
    pub(super) cloud: Meter,
    /// Meter of the outputs delivered to the application: when they stop, the robot must stop.
    pub(super) delivered: Meter,
}

impl<P: Clone> Governor<P> {
    /// Sets whether an output has a subscriber: without one, missing frames do not count.
    pub fn set_listened(&mut self, now: Instant, output: &str, wanted: bool) {
        self.tick(now);
        if wanted {
            self.listened.insert(output.to_owned());
        } else {
            self.listened.remove(output);
        }
        self.update_meters(now);
    }

    pub(super) fn update_meters(&mut self, now: Instant) {
        if let Some(metered) = &mut self.meter {
            let wanted = self.listened.contains(&metered.output);
            for meter in [&mut metered.cloud, &mut metered.delivered] {
                if wanted { meter.start(now) } else { meter.stop() }
            }
        }
    }

    pub(super) fn measure(&mut self, now: Instant, topic: &str, age: Duration) {
        let Some(meter) = self.meter.as_mut().filter(|meter| meter.output == topic) else {
            return;
        };
        if let Some(t) = meter.cloud.output(now, age) {
            self.observe(Some(t), self.sla.t_desire, self.sla.t_max);
            self.decide(now);
        }
    }
}
