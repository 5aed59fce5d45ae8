//! Promises about the rate or the age of an output.

use std::time::{Duration, Instant};

use super::Governor;
use crate::measure::Meter;

/// What the cloud's outputs are measured by.
#[derive(Debug)]
pub(super) struct Metered {
    pub(super) output: String,
    pub(super) cloud: Meter,
    /// Of what the application got: when that stops, the robot must.
    pub(super) delivered: Meter,
}

impl<P: Clone> Governor<P> {
    /// Somebody listens to an output, or nobody does: frames that nobody wants are not missed.
    pub fn wanted(&mut self, now: Instant, output: &str, wanted: bool) {
        self.tick(now);
        if wanted {
            self.listened.insert(output.to_owned());
        } else {
            self.listened.remove(output);
        }
        self.await_frames(now);
    }

    pub(super) fn await_frames(&mut self, now: Instant) {
        if let Some(metered) = &mut self.meter {
            let wanted = self.listened.contains(&metered.output);
            for meter in [&mut metered.cloud, &mut metered.delivered] {
                if wanted {
                    meter.start(now)
                } else {
                    meter.stop()
                }
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
