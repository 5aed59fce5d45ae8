//! Measures a service at several limits: one servant, which serves no robot, is given the same requests at each.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::Size;
use api::calibration::{Calibration, CalibrationEvent, CalibrationOptions, Point, TimeSpread};
use api::trial::Fed;
use budget::Permit;
use reach::{Gap, Material, Pace, Reach, Replay};
use servant::engine::Servant;
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::decide::Amount;
use crate::decide::calibration::{self as decide, Next};
use crate::lives::driver::GAVE_WAY;
use crate::lives::handle::Handle;
use crate::{Choreographer, Error, Measured};

/// Requests at each limit where nobody says how many.
const REQUESTS: usize = 40;
/// How long one limit may take, and one answer.
const WHOLE: Duration = Duration::from_secs(60);
const ANSWER: Duration = Duration::from_secs(10);
/// So many requests in vain, one after the other, are enough at a limit.
const IN_VAIN: usize = 3;
/// Cores where the push and who measures name none: what was measured becomes a promise, and all cores of the machine promised to
/// one robot would leave the others none.
const CORES: f64 = 1.0;
/// Thousandths of a core below which no servant is limited.
const LEAST: u64 = 10;
/// How long the end of its servant is waited for.
const ENDS: Duration = Duration::from_secs(10);
/// How often its memory is looked at.
const LOOK: Duration = Duration::from_millis(50);

/// What its servant is named after, where a robot's name stands.
const PURPOSE: &str = "calibrate";

impl Handle {
    /// Whether what it is promised is given back where a robot needs it, as that of a push is.
    pub(crate) fn gives_way(&self) -> bool {
        let measured = self.robot.strip_prefix('~');
        let is_measured = measured.is_some_and(|name| name.starts_with(PURPOSE));
        self.is_candidate() || (self.anonymous && is_measured)
    }

    /// A robot needed what it was promised.
    fn gave_way(&self) -> bool {
        self.life().ended.as_deref() == Some(GAVE_WAY)
    }
}

/// What a service is measured with.
pub struct Requests {
    /// What is replayed.
    pub material: Material,
    /// What the network and the stub of a robot added to each of its requests.
    pub network: Option<TimeSpread>,
    /// Counts the material for whoever sent it.
    pub permit: Permit,
}

impl Choreographer {
    /// Measures the current revision of a service at several limits and proposes rows of the dictionary; writes none. What
    /// happens is told to `events` as it does, but not the end. The servant is ended however this future is dropped.
    pub async fn calibrate(
        &self,
        service: &str,
        requests: Requests,
        options: &CalibrationOptions,
        events: &mpsc::Sender<CalibrationEvent>,
    ) -> Result<Calibration, Error> {
        let revision = self.inner.catalogue.current(service)?;
        reach::fits(
            (service, revision.flavour.ros.bus()),
            &revision.interface,
            &requests.material,
            options.input.as_deref(),
        )?;
        // Set, not stated: what robots may ask for at most bounds no measurement.
        let set = api::Limits {
            memory: options.memory,
            ..api::Limits::default()
        };
        // Whoever names limits hears of one that is never possible before anything is started.
        if let Some(least) = options.cpus.iter().copied().min_by(f64::total_cmp) {
            self.check_limits(&api::Limits {
                cpus: Some(least),
                ..set
            })?;
        }
        let measured = self.measured(service, PURPOSE, set)?;
        let found = self
            .measures(&measured, service, requests, options, events)
            .await;
        // What is measured next finds the room that this had.
        let handle = Arc::clone(measured.lease.handle());
        drop(measured);
        let _ = timeout(ENDS, handle.ended()).await;
        found
    }

    async fn measures(
        &self,
        measured: &Measured,
        service: &str,
        requests: Requests,
        options: &CalibrationOptions,
        events: &mpsc::Sender<CalibrationEvent>,
    ) -> Result<Calibration, Error> {
        let step = async |title: String| {
            // Whoever asked has gone: then this is dropped soon.
            let _ = events.send(CalibrationEvent::Step { title }).await;
        };
        let gave_way = |error| match measured.lease.handle() {
            handle if handle.gave_way() => Error::Calibration(format!(
                "measuring {service} was given up before it came to anything: {GAVE_WAY}; calibrate on a machine with more room, \
                 or name smaller limits with --cpus"
            )),
            handle => out_of_memory(handle).unwrap_or(error),
        };
        step(format!("starting a servant of {service} to measure")).await;
        measured.lease.admitted().await.map_err(gave_way)?;
        let reach = measured.lease.ready().await.map_err(gave_way)?;
        let ladder = self.limits_for(measured, options)?;
        let mut measuring = Measuring {
            choreographer: self,
            measured,
            reach: &*reach,
            pace: pace(options),
            own: options.own,
            aux: options.aux.clone(),
            sum: Calibration {
                service: service.to_owned(),
                revision: measured.lease.handle().revision.number,
                network: network(&requests, options),
                memory_margin: decide::MARGIN,
                ..Calibration::default()
            },
        };
        let named = options.own || !options.cpus.is_empty();
        loop {
            let cpus = match decide::next(&ladder, named, &measuring.sum.points) {
                Next::Measure(cpus) => cpus,
                Next::Enough(why) => {
                    measuring.sum.ended = why;
                    break;
                }
            };
            step(format!("measuring with {cpus} cores")).await;
            match measuring.at(cpus, &requests.material).await {
                Ok((point, mut times)) => {
                    if !options.times {
                        times.clear();
                    }
                    let event = CalibrationEvent::Measured { point, times };
                    let _ = events.send(event).await;
                }
                Err(error) if measuring.sum.points.is_empty() => return Err(gave_way(error)),
                Err(_) if measured.lease.handle().gave_way() => {
                    measuring.sum.ended = format!("{GAVE_WAY}; calibrate again for more");
                    break;
                }
                // Room that others have taken meanwhile.
                Err(Error::Full(refused)) => {
                    measuring.sum.ended = refused.to_string();
                    break;
                }
                Err(error) => return Err(error),
            }
        }
        let calibration = measuring.proposed();
        // Whoever asks the servant now sends as much again, and has no more memory than before.
        drop(requests);
        if let Some(seconds) = options.keep {
            let kept = CalibrationEvent::Kept {
                servant: measured.lease.handle().id.clone(),
                calibration: Box::new(calibration.clone()),
            };
            let _ = events.send(kept).await;
            // Whoever asked ends it sooner, by which this is dropped.
            let _ = timeout(Duration::from_secs_f64(seconds), measured.lease.over()).await;
        }
        Ok(calibration)
    }

    /// At which limits it is measured: those that are named, else up to all that can be promised to it now.
    fn limits_for(
        &self,
        measured: &Measured,
        options: &CalibrationOptions,
    ) -> Result<Vec<f64>, Error> {
        if options.own {
            let asked = measured.lease.handle().asked().cpus;
            return Ok(vec![asked.unwrap_or(self.inner.options.cores.min(CORES))]);
        }
        if !options.cpus.is_empty() {
            let mut named = options.cpus.clone();
            named.sort_by(f64::total_cmp);
            named.dedup();
            return Ok(named);
        }
        let (capacity, promised, _) = self.admission().look();
        let own = self.inner.promised(&measured.lease.handle().asked());
        let most = capacity.minus(promised.minus(own)).millicpus;
        if most < LEAST {
            let service = measured.lease.handle().service();
            return Err(Error::Calibration(format!(
                "there is no room to measure {service}: {} cores are promised to nobody; end servants that are not \
                 needed, or name the limits with --cpus",
                most as f64 / 1000.0
            )));
        }
        Ok(decide::ladder(most))
    }
}

/// One calibration.
struct Measuring<'a> {
    choreographer: &'a Choreographer,
    measured: &'a Measured,
    reach: &'a dyn Reach,
    pace: Pace,
    /// No limit was named: it is measured as well where this machine limits no cores.
    own: bool,
    aux: BTreeMap<String, String>,
    sum: Calibration,
}

impl Measuring<'_> {
    /// Measures at one limit, and notes it; also the times of the requests that were answered, in milliseconds.
    async fn at(&mut self, cpus: f64, material: &Material) -> Result<(Point, Vec<f64>), Error> {
        let handle = self.measured.lease.handle();
        let change = api::Limits {
            cpus: Some(cpus),
            ..api::Limits::default()
        };
        self.choreographer.set_limits(&handle.id, change).await?;
        let container = handle
            .container()
            .ok_or(Error::Internal("measuring a servant"))?;
        let own = self.own;
        let in_force = || match container.enforced().limits.cpus {
            Some(enforced) => Amount::new(enforced, 0) == Amount::new(cpus, 0),
            None => own,
        };
        if !in_force() {
            return Err(Error::Calibration(format!(
                "this machine does not limit a servant to {cpus} cores, so that limits cannot be compared; \
                 see what it lacks with: cloudroidctl doctor"
            )));
        }
        let before = container.usage().await?;
        let mut memory = 0;
        let interface = &handle.revision.interface;
        let replay = tokio::select! {
            biased;
            error = self.measured.lease.over() => return Err(error),
            replay = self.reach.replay(&self.sum.service, interface, material, &self.pace) => replay?,
            never = watch(&*container, &mut memory) => match never {},
        };
        // A node that is started again by itself does not end its servant.
        if let Some(error) = out_of_memory(handle) {
            return Err(error);
        }
        if !in_force() {
            return Err(Error::Calibration(format!(
                "somebody has changed the limits of servant {} while it was measured; calibrate again",
                handle.id
            )));
        }
        let after = container.usage().await?;
        memory = memory.max(in_use(&after));
        // The first request is not among the times, but costs as the others do.
        let made = (replay.times.len() + 1) as f64;
        let each = |before: u64, after: u64| after.saturating_sub(before) as f64 / 1000.0 / made;
        let point = Point {
            cpus,
            requests: replay.times.len(),
            answered: replay.times.iter().flatten().count(),
            compute: TimeSpread::of(milliseconds(&replay)),
            running: each(before.cpu_usec, after.cpu_usec),
            throttled: each(before.throttled_usec, after.throttled_usec),
            rate: replay.rate,
            memory: Size(memory),
        };
        let times = milliseconds(&replay);
        self.note(point, replay);
        Ok((point, times))
    }

    fn note(&mut self, point: Point, replay: Replay) {
        let sum = &mut self.sum;
        sum.points.push(point);
        sum.memory_peak = sum.memory_peak.max(point.memory);
        sum.largest = sum.largest.max(Size(replay.largest as u64));
        sum.pace = replay.pace;
        sum.unused = replay.unused;
        for input in replay.inputs {
            match sum
                .inputs
                .iter_mut()
                .find(|known| known.topic == input.topic)
            {
                Some(Fed { sent, .. }) => *sent += input.sent,
                None => sum.inputs.push(input),
            }
        }
    }

    fn proposed(self) -> Calibration {
        let mut sum = self.sum;
        let memory = decide::with_margin(sum.memory_peak);
        let network = sum.network.unwrap_or_default();
        sum.rows = decide::propose(&sum.points, sum.pace, network, memory, &self.aux);
        sum
    }
}

/// What to say of a servant that was ended by the kernel for want of memory.
fn out_of_memory(handle: &Handle) -> Option<Error> {
    let memory = handle.limits().memory?;
    handle.was_out_of_memory().then(|| Error::OutOfMemory {
        service: handle.service().to_owned(),
        memory,
        ready: handle.ready_for().is_some(),
    })
}

fn pace(options: &CalibrationOptions) -> Pace {
    Pace {
        input: options.input.clone(),
        requests: options.requests.unwrap_or(REQUESTS),
        again: true,
        gap: match options.rate {
            Some(rate) => Gap::Rate(rate),
            None if options.fast || options.source == api::calibration::Source::Frames => Gap::None,
            None => Gap::Recorded,
        },
        answer: ANSWER,
        whole: WHOLE,
        in_vain: Some(IN_VAIN),
    }
}

/// What lies between a robot and the node: as given, else as the robot measured it.
fn network(requests: &Requests, options: &CalibrationOptions) -> Option<TimeSpread> {
    let given = options.network.map(|time| TimeSpread {
        p50: time,
        p95: time,
        max: time,
    });
    given.or(requests.network)
}

fn milliseconds(replay: &Replay) -> Vec<f64> {
    let times = replay.times.iter().flatten();
    times.map(|time| time.as_secs_f64() * 1000.0).collect()
}

/// Notes the most memory that is in use, for as long as this is awaited.
async fn watch(container: &dyn Servant, most: &mut u64) -> std::convert::Infallible {
    let mut looks = tokio::time::interval(LOOK);
    loop {
        looks.tick().await;
        // One that has ended is noticed elsewhere.
        if let Ok(usage) = container.usage().await {
            *most = in_use(&usage).max(*most);
        }
    }
}

fn in_use(usage: &servant::engine::Usage) -> u64 {
    usage.memory.saturating_sub(usage.reclaimable)
}
