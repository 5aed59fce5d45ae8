//! Records the figures of servants and machine, whether or not anybody looks.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Millis;
use store::NewSample;
use tokio::time::MissedTickBehavior;

use super::figures::{self, MACHINE, SERVANT, SampleAccumulator};
use super::{COARSE, FINE};
use crate::app::App;
use crate::errors::Error;
use crate::looks::{self, ServantSampler};

/// Limit on the servants sampled, which bounds the disk usage of a day.
const SERVANTS: usize = 500;
/// Name of the machine among the recorded series.
pub const THE_MACHINE: &str = "";

/// Owner of a series of figures.
struct SeriesOwner {
    service: String,
    robot: String,
    began: Millis,
}

/// Samples since the last coarse step ended.
#[derive(Default)]
struct Minute {
    /// Number of the minute since 1970.
    number: u64,
    gathered: HashMap<String, (SeriesOwner, SampleAccumulator)>,
}

/// Records samples until the daemon stops.
pub async fn record_history(app: Arc<App>) {
    let mut ticks = tokio::time::interval(Duration::from_secs(FINE.seconds.into()));
    // Missed samples leave a gap.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut recorder = Recorder::default();
    loop {
        tokio::select! {
            _ = ticks.tick() => {}
            () = app.ending.cancelled() => return,
        }
        match recorder.sample(&app).await {
            Ok(()) => recorder.failing = false,
            // Logged once until it works again.
            Err(error) => {
                if !std::mem::replace(&mut recorder.failing, true) {
                    tracing::warn!("the history of servants is not being recorded: {error}");
                }
            }
        }
    }
}

#[derive(Default)]
struct Recorder {
    looker: ServantSampler,
    /// Number of messages dropped by each servant so far.
    dropped: HashMap<String, u64>,
    minute: Minute,
    failing: bool,
}

impl Recorder {
    async fn sample(&mut self, app: &App) -> Result<(), Error> {
        let mut servants = self.looker.sample(app).await;
        let machine = looks::sample_machine(app, &servants).await?;
        let time = store::now();
        servants.truncate(SERVANTS);
        let mut sampled = vec![(
            THE_MACHINE.to_owned(),
            SeriesOwner { service: String::new(), robot: String::new(), began: app.started },
            figures::machine_sample(&machine),
        )];
        let earlier = std::mem::take(&mut self.dropped);
        for served in servants {
            let before = earlier.get(&served.servant.id);
            let now = served.servant.dropped;
            let figures = figures::servant_sample(&served, before.map(|before| now.saturating_sub(*before)));
            let one = served.servant;
            self.dropped.insert(one.id.clone(), now);
            let of = SeriesOwner { service: one.service, robot: one.robot, began: one.created };
            sampled.push((one.id, of, figures));
        }
        let new: Vec<_> = sampled.iter().map(|(id, of, figures)| new_sample(id, of, figures)).collect();
        app.state.add_samples(FINE.seconds, time, &new)?;
        self.finish_minute(app, time)?;
        for (id, of, figures) in sampled {
            let (_, gathered) = self.minute.gathered.entry(id).or_insert_with(|| (of, SampleAccumulator::default()));
            gathered.add(figures);
        }
        Ok(())
    }

    /// Writes the coarse step once it is over, and deletes expired samples.
    fn finish_minute(&mut self, app: &App, time: Millis) -> Result<(), Error> {
        let number = time / COARSE.millis();
        if number == self.minute.number {
            return Ok(());
        }
        let over = std::mem::replace(&mut self.minute, Minute { number, ..Minute::default() });
        let one = |(id, (of, gathered)): (&String, &(SeriesOwner, SampleAccumulator))| {
            let rules = if id == THE_MACHINE { &MACHINE[..] } else { &SERVANT };
            (id.clone(), gathered.aggregate(rules), (of.service.clone(), of.robot.clone(), of.began))
        };
        let figures: Vec<_> = over.gathered.iter().map(one).collect();
        let samples: Vec<_> = figures
            .iter()
            .map(|(id, figures, (service, robot, began))| NewSample {
                servant: id,
                service,
                robot,
                began: *began,
                figures,
            })
            .collect();
        let ended = number * COARSE.millis();
        app.state.add_samples(COARSE.seconds, ended, &samples)?;
        let kept = [FINE, COARSE].map(|step| (step.seconds, time.saturating_sub(step.retention())));
        Ok(app.state.forget_history(&kept)?)
    }
}

fn new_sample<'a>(id: &'a str, of: &'a SeriesOwner, figures: &'a [f32]) -> NewSample<'a> {
    NewSample { servant: id, service: &of.service, robot: &of.robot, began: of.began, figures }
}
