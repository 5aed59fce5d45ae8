//! Calibrates a service: measures one servant without a robot at several limits, with the same requests at each.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::Size;
use api::calibration::{Calibration, CalibrationEvent, CalibrationOptions, Point, TimeSpread};
use api::trial::Fed;
use budget::Permit;
use reach::{Material, Reach, Replay, ReplayPace, RequestGap};
use servant::engine::ServantHandle;
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::decide::Amount;
use crate::decide::calibration::{self as decide, NextMeasurement};
use crate::lives::driver::GAVE_WAY;
use crate::lives::handle::Handle;
use crate::{Choreographer, Error, MeasuredServant};

/// Default number of requests at each limit.
const REQUESTS: usize = 40;
/// Maximum time for one limit, and for one answer.
const WHOLE: Duration = Duration::from_secs(60);
const ANSWER: Duration = Duration::from_secs(10);
/// Number of unanswered requests in a row after which a limit is given up.
const IN_VAIN: usize = 3;
/// Default cores if neither the push nor the caller names any: the measured limit becomes a promise, and promising all
/// cores to one robot would leave none for the others.
const CORES: f64 = 1.0;
/// Minimum limit of a servant, in thousandths of a core.
const MIN_LIMIT: u64 = 10;
/// Time to wait for the end of the servant.
const ENDS: Duration = Duration::from_secs(10);
/// Interval between samples of its memory.
const LOOK: Duration = Duration::from_millis(50);

/// Purpose in the name of the servant, in place of a robot's name.
const PURPOSE: &str = "calibrate";

impl Handle {
    /// Returns true if its capacity is given back when a robot needs it, like a push's.
    pub(crate) fn gives_way(&self) -> bool {
        let measured = self.robot.strip_prefix('~');
        let is_measured = measured.is_some_and(|name| name.starts_with(PURPOSE));
        self.is_candidate() || (self.anonymous && is_measured)
    }

    /// Returns true if it was ended because a robot needed its capacity.
    fn has_given_way(&self) -> bool {
        self.life().ended.as_deref() == Some(GAVE_WAY)
    }
}

/// Requests for calibrating a service.
pub struct CalibrationRequests {
    /// Recorded material to replay.
    pub material: Material,
    /// Time that the network and the robot's stub added to each request.
    pub network: Option<TimeSpread>,
    /// Memory permit that accounts for the material.
    pub permit: Permit,
}

impl Choreographer {
    /// Measures the current revision of a service at several limits and proposes rows of the dictionary, without
    /// writing them. Progress is reported to `events`, but not the end. The servant is ended even if this future is
    /// dropped.
    pub async fn calibrate(
        &self,
        service: &str,
        requests: CalibrationRequests,
        options: &CalibrationOptions,
        events: &mpsc::Sender<CalibrationEvent>,
    ) -> Result<Calibration, Error> {
        let revision = self.inner.catalogue.current_revision(service)?;
        reach::check_material(
            (service, revision.flavour.ros.ros_version()),
            &revision.interface,
            &requests.material,
            options.input.as_deref(),
        )?;
        // Set, not stated: caps on robots do not limit measurements.
        let set = api::Limits { memory: options.memory, ..api::Limits::default() };
        // An impossible limit is reported before anything is started.
        if let Some(least) = options.cpus.iter().copied().min_by(f64::total_cmp) {
            self.check_limits(&api::Limits { cpus: Some(least), ..set })?;
        }
        let measured = self.start_measured(service, PURPOSE, set)?;
        let found = self.run_calibration(&measured, service, requests, options, events).await;
        // The next measurement finds the capacity that this one had.
        let handle = Arc::clone(measured.lease.handle());
        drop(measured);
        let _ = timeout(ENDS, handle.wait_ended()).await;
        found
    }

    async fn run_calibration(
        &self,
        measured: &MeasuredServant,
        service: &str,
        requests: CalibrationRequests,
        options: &CalibrationOptions,
        events: &mpsc::Sender<CalibrationEvent>,
    ) -> Result<Calibration, Error> {
        let step = async |title: String| {
            // If the caller is gone, this future is dropped soon.
            let _ = events.send(CalibrationEvent::Step { title }).await;
        };
        let gave_way = |error| match measured.lease.handle() {
            handle if handle.has_given_way() => Error::Calibration(format!(
                "the measurement of {service} was aborted without a result: {GAVE_WAY}; calibrate on a larger machine, \
                    or pass smaller limits with --cpus"
            )),
            handle => out_of_memory(handle).unwrap_or(error),
        };
        step(format!("starting a servant of {service} to measure")).await;
        measured.lease.wait_admitted().await.map_err(gave_way)?;
        let reach = measured.lease.wait_ready().await.map_err(gave_way)?;
        let ladder = self.limits_for(measured, options)?;
        let mut measuring = CalibrationRun {
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
            let cpus = match decide::next_measurement(&ladder, named, &measuring.sum.points) {
                NextMeasurement::Measure(cpus) => cpus,
                NextMeasurement::Enough(why) => {
                    measuring.sum.ended = why;
                    break;
                }
            };
            step(format!("measuring with {cpus} cores")).await;
            match measuring.measure_at(cpus, &requests.material).await {
                Ok((point, mut times)) => {
                    if !options.times {
                        times.clear();
                    }
                    let event = CalibrationEvent::Measured { point, times };
                    let _ = events.send(event).await;
                }
                Err(error) if measuring.sum.points.is_empty() => return Err(gave_way(error)),
                Err(_) if measured.lease.handle().has_given_way() => {
                    measuring.sum.ended = format!("{GAVE_WAY}; calibrate again for more");
                    break;
                }
                // Others have taken the capacity meanwhile.
                Err(Error::Full(refused)) => {
                    measuring.sum.ended = refused.to_string();
                    break;
                }
                Err(error) => return Err(error),
            }
        }
        let calibration = measuring.into_proposal();
        // The caller may now send as much to the servant, and has no more memory than before.
        drop(requests);
        if let Some(seconds) = options.keep {
            let kept = CalibrationEvent::Kept {
                servant: measured.lease.handle().id.clone(),
                calibration: Box::new(calibration.clone()),
            };
            let _ = events.send(kept).await;
            // The caller may end it sooner, by dropping this future.
            let _ = timeout(Duration::from_secs_f64(seconds), measured.lease.wait_over()).await;
        }
        Ok(calibration)
    }

    /// Returns the limits to measure: the named ones, or up to all that can be promised now.
    fn limits_for(&self, measured: &MeasuredServant, options: &CalibrationOptions) -> Result<Vec<f64>, Error> {
        if options.own {
            let asked = measured.lease.handle().requested_limits().cpus;
            return Ok(vec![asked.unwrap_or(self.inner.options.cores.min(CORES))]);
        }
        if !options.cpus.is_empty() {
            let mut named = options.cpus.clone();
            named.sort_by(f64::total_cmp);
            named.dedup();
            return Ok(named);
        }
        let (capacity, promised, _) = self.admission().snapshot();
        let own = self.inner.promised_amount(&measured.lease.handle().requested_limits());
        let most = capacity.minus(promised.minus(own)).millicpus;
        if most < MIN_LIMIT {
            let service = measured.lease.handle().service();
            return Err(Error::Calibration(format!(
                "no capacity to measure {service}: {} cores are free; stop unneeded servants, or pass smaller limits \
                    with --cpus",
                most as f64 / 1000.0
            )));
        }
        Ok(decide::limit_ladder(most))
    }
}

/// A calibration in progress.
struct CalibrationRun<'a> {
    choreographer: &'a Choreographer,
    measured: &'a MeasuredServant,
    reach: &'a dyn Reach,
    pace: ReplayPace,
    /// No limit was named: it is measured even if this machine does not limit cores.
    own: bool,
    aux: BTreeMap<String, String>,
    sum: Calibration,
}

impl CalibrationRun<'_> {
    /// Measures at one limit and records the point; returns it with the times of the answered requests, in
    /// milliseconds.
    async fn measure_at(&mut self, cpus: f64, material: &Material) -> Result<(Point, Vec<f64>), Error> {
        let handle = self.measured.lease.handle();
        let change = api::Limits { cpus: Some(cpus), ..api::Limits::default() };
        self.choreographer.set_limits(&handle.id, change).await?;
        let container = handle.container().ok_or(Error::Internal("measuring a servant"))?;
        let own = self.own;
        let in_force = || match container.enforced_limits().limits.cpus {
            Some(enforced) => Amount::new(enforced, 0) == Amount::new(cpus, 0),
            None => own,
        };
        if !in_force() {
            return Err(Error::Calibration(format!(
                "this machine cannot limit a servant to {cpus} cores, so limits cannot be compared; see what is \
                    missing with: cloudroidctl doctor"
            )));
        }
        let before = container.usage().await?;
        let mut memory = 0;
        let interface = &handle.revision.interface;
        let replay = tokio::select! {
            biased;
            error = self.measured.lease.wait_over() => return Err(error),
            replay = self.reach.replay(&self.sum.service, interface, material, &self.pace) => replay?,
            never = track_memory(&*container, &mut memory) => match never {},
        };
        // A node that is restarted by itself does not end its servant.
        if let Some(error) = out_of_memory(handle) {
            return Err(error);
        }
        if !in_force() {
            return Err(Error::Calibration(format!(
                "the limits of servant {} were changed during the measurement; calibrate again",
                handle.id
            )));
        }
        let after = container.usage().await?;
        memory = memory.max(in_use(&after));
        // The first request is not among the times, but costs as much as the others.
        let made = (replay.times.len() + 1) as f64;
        let each = |before: u64, after: u64| after.saturating_sub(before) as f64 / 1000.0 / made;
        let point = Point {
            cpus,
            requests: replay.times.len(),
            answered: replay.times.iter().flatten().count(),
            compute: TimeSpread::from_samples(milliseconds(&replay)),
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
            match sum.inputs.iter_mut().find(|known| known.topic == input.topic) {
                Some(Fed { sent, .. }) => *sent += input.sent,
                None => sum.inputs.push(input),
            }
        }
    }

    fn into_proposal(self) -> Calibration {
        let mut sum = self.sum;
        let memory = decide::with_margin(sum.memory_peak);
        let network = sum.network.unwrap_or_default();
        sum.rows = decide::propose_rows(&sum.points, sum.pace, network, memory, &self.aux);
        sum
    }
}

/// Returns the error if the kernel has killed the servant for lack of memory.
fn out_of_memory(handle: &Handle) -> Option<Error> {
    let memory = handle.limits().memory?;
    handle.was_out_of_memory().then(|| Error::OutOfMemory {
        service: handle.service().to_owned(),
        memory,
        ready: handle.ready_for().is_some(),
    })
}

fn pace(options: &CalibrationOptions) -> ReplayPace {
    ReplayPace {
        input: options.input.clone(),
        requests: options.requests.unwrap_or(REQUESTS),
        again: true,
        gap: match options.rate {
            Some(rate) => RequestGap::Rate(rate),
            None if options.fast || options.source == api::calibration::Source::Frames => RequestGap::None,
            None => RequestGap::Recorded,
        },
        answer: ANSWER,
        whole: WHOLE,
        in_vain: Some(IN_VAIN),
    }
}

/// Returns the time between a robot and the node: as given, or as measured by the robot.
fn network(requests: &CalibrationRequests, options: &CalibrationOptions) -> Option<TimeSpread> {
    let given = options.network.map(|time| TimeSpread { p50: time, p95: time, max: time });
    given.or(requests.network)
}

fn milliseconds(replay: &Replay) -> Vec<f64> {
    let times = replay.times.iter().flatten();
    times.map(|time| time.as_secs_f64() * 1000.0).collect()
}

/// Tracks the peak of memory in use while awaited.
async fn track_memory(container: &dyn ServantHandle, most: &mut u64) -> std::convert::Infallible {
    let mut looks = tokio::time::interval(LOOK);
    loop {
        looks.tick().await;
        // An ended servant is noticed elsewhere.
        if let Ok(usage) = container.usage().await {
            *most = in_use(&usage).max(*most);
        }
    }
}

fn in_use(usage: &servant::engine::Usage) -> u64 {
    usage.memory.saturating_sub(usage.reclaimable)
}
