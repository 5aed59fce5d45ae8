//! Records what the servants and the machine do, whether or not anybody looks.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Millis;
use store::NewSample;
use tokio::time::MissedTickBehavior;

use super::figures::{self, Gathered, MACHINE, SERVANT};
use super::{COARSE, FINE};
use crate::app::App;
use crate::errors::Error;
use crate::looks::{self, Looker};

/// Servants that are sampled at a time: what a day takes on the disk is bounded by it.
const SERVANTS: usize = 500;
/// The machine's name among what is recorded.
pub const THE_MACHINE: &str = "";

/// Whose figures these are.
struct Of {
    service: String,
    robot: String,
    began: Millis,
}

/// What was sampled since the last coarse step ended.
#[derive(Default)]
struct Minute {
    /// Its number since 1970.
    number: u64,
    gathered: HashMap<String, (Of, Gathered)>,
}

/// Samples until the daemon ends.
pub async fn keep(app: Arc<App>) {
    let mut ticks = tokio::time::interval(Duration::from_secs(FINE.seconds.into()));
    // What was not sampled is a gap.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut recorder = Recorder::default();
    loop {
        tokio::select! {
            _ = ticks.tick() => {}
            () = app.ending.cancelled() => return,
        }
        match recorder.sample(&app).await {
            Ok(()) => recorder.failing = false,
            // Once, until it works again.
            Err(error) => {
                if !std::mem::replace(&mut recorder.failing, true) {
                    tracing::warn!("what servants do is not recorded now: {error}");
                }
            }
        }
    }
}

#[derive(Default)]
struct Recorder {
    looker: Looker,
    /// Messages that each servant had dropped.
    dropped: HashMap<String, u64>,
    minute: Minute,
    failing: bool,
}

impl Recorder {
    async fn sample(&mut self, app: &App) -> Result<(), Error> {
        let mut servants = self.looker.servants(app).await;
        let machine = looks::machine(app, &servants).await?;
        let time = store::now();
        servants.truncate(SERVANTS);
        let mut sampled = vec![(
            THE_MACHINE.to_owned(),
            Of {
                service: String::new(),
                robot: String::new(),
                began: app.started,
            },
            figures::machine(&machine),
        )];
        let earlier = std::mem::take(&mut self.dropped);
        for served in servants {
            let before = earlier.get(&served.servant.id);
            let now = served.servant.dropped;
            let figures =
                figures::servant(&served, before.map(|before| now.saturating_sub(*before)));
            let one = served.servant;
            self.dropped.insert(one.id.clone(), now);
            let of = Of {
                service: one.service,
                robot: one.robot,
                began: one.created,
            };
            sampled.push((one.id, of, figures));
        }
        let new: Vec<_> = sampled
            .iter()
            .map(|(id, of, figures)| new(id, of, figures))
            .collect();
        app.state.record(FINE.seconds, time, &new)?;
        self.minute(app, time)?;
        for (id, of, figures) in sampled {
            let (_, gathered) = self
                .minute
                .gathered
                .entry(id)
                .or_insert_with(|| (of, Gathered::default()));
            gathered.add(figures);
        }
        Ok(())
    }

    /// Writes the coarse step where it is over, and forgets what is old.
    fn minute(&mut self, app: &App, time: Millis) -> Result<(), Error> {
        let number = time / COARSE.millis();
        if number == self.minute.number {
            return Ok(());
        }
        let over = std::mem::replace(
            &mut self.minute,
            Minute {
                number,
                ..Minute::default()
            },
        );
        let one = |(id, (of, gathered)): (&String, &(Of, Gathered))| {
            let rules = if id == THE_MACHINE {
                &MACHINE[..]
            } else {
                &SERVANT
            };
            (
                id.clone(),
                gathered.one(rules),
                (of.service.clone(), of.robot.clone(), of.began),
            )
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
        app.state.record(COARSE.seconds, ended, &samples)?;
        let kept = [FINE, COARSE].map(|step| (step.seconds, time.saturating_sub(step.kept())));
        Ok(app.state.forget_history(&kept)?)
    }
}

fn new<'a>(id: &'a str, of: &'a Of, figures: &'a [f32]) -> NewSample<'a> {
    NewSample {
        servant: id,
        service: &of.service,
        robot: &of.robot,
        began: of.began,
        figures,
    }
}
