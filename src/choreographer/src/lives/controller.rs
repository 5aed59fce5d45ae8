//! Watches the machine and the running servants once per second, and carries out the decisions: admission stops while
//! the machine stalls, and cores are moved to servants near what their robots accept.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use api::limits::DEFAULT_CPU_WEIGHT;
use api::{Limits, Phase};
use futures_util::future::join_all;
use servant::engine::{ServantHandle, Usage};
use servant::host;
use store::NewEvent;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::ChoreographerInner;
use super::visits::Visits;
use crate::decide::controller::{ControlDecision, ControlFacts, ControlHistory, ResponseGoal, control};
use crate::decide::stall::{PressureReading, StallDetector};
use crate::lives::handle::Handle;

/// Interval between two rounds.
const LOOK: Duration = Duration::from_secs(1);
/// Timeout for one servant to report its usage, or to apply limits.
const PATIENCE: Duration = Duration::from_secs(5);
/// Number of rounds between checks of what stubs have reported.
const LINK_CHECK_ROUNDS: u64 = 10;

/// State between two rounds.
#[derive(Default)]
struct ControllerWatch {
    looks: u64,
    servants: HashMap<String, ControlRecord>,
    stall: StallDetector,
    swapped_in: Option<(Instant, u64)>,
    /// Changes of servants' cores in progress.
    moves: Visits<()>,
}

/// State about one servant.
#[derive(Default)]
struct ControlRecord {
    history: ControlHistory,
    /// Usage at the last sample; `None` without a sample.
    usage: Option<(Instant, Usage)>,
    /// Response times reported by its stubs when their nodes were linked.
    linked: Option<ResponseGoal>,
}

/// A sampled servant. Cores are in thousandths.
struct WorkingServant {
    handle: Arc<Handle>,
    container: Arc<dyn ServantHandle>,
    limits: Limits,
    asked: Limits,
    /// The limits in force.
    enforced: Limits,
    used: Option<u64>,
    throttled: f64,
    waited: f64,
    goal: Option<ResponseGoal>,
    history: ControlHistory,
}

/// Runs the watch until the daemon ends.
pub(crate) async fn watch(inner: Arc<ChoreographerInner>) {
    let mut watch = ControllerWatch::default();
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        let reading = watch.read_pressure();
        inner.note_stall(watch.stall.judge(reading, Instant::now().into_std()));
        let looked = watch.observe(&inner).await;
        if inner.options.controller {
            watch.control(&inner, looked);
        }
    }
}

impl ChoreographerInner {
    /// Stalls admission for this reason, or resumes it, and reports the change.
    pub(crate) fn note_stall(&self, why: Option<String>) {
        let words = why.clone();
        if !self.admission.set_stall(why) {
            return;
        }
        let about = NewEvent::default();
        match words {
            Some(why) => {
                let message = format!("{why}; no servant is admitted until this is over");
                self.journal.warning("machine-stalled", &message, &about);
            }
            None => {
                let message = "this machine no longer stalls; servants are admitted again";
                self.journal.info("machine-recovered", message, &about);
            }
        }
    }
}

impl ControllerWatch {
    fn read_pressure(&mut self) -> PressureReading {
        let now = Instant::now();
        let swapped_in = host::swapped_in_bytes();
        let before = std::mem::replace(&mut self.swapped_in, swapped_in.map(|bytes| (now, bytes)));
        let rate = swapped_in.zip(before).map(|(bytes, (then, earlier))| {
            let seconds = now.saturating_duration_since(then).as_secs_f64();
            bytes.saturating_sub(earlier) as f64 / seconds.max(LOOK.as_secs_f64())
        });
        PressureReading {
            memory_full: host::memory_stall_percent(),
            available: host::available_memory_percent(),
            swapped_in: rate.unwrap_or(0.0),
        }
    }

    /// Samples the running servants; also their usage, if any of their robots has stated what it accepts.
    async fn observe(&mut self, inner: &ChoreographerInner) -> Vec<WorkingServant> {
        let handles: Vec<Arc<Handle>> = inner.servants.lock().all.values().cloned().collect();
        inner.recent.retain(|id| handles.iter().any(|handle| handle.id == id));
        let fresh = self.looks % LINK_CHECK_ROUNDS == 0;
        self.looks += 1;
        let mut before = std::mem::take(&mut self.servants);
        let mut working = Vec::new();
        for handle in handles {
            let works = handle.life().phase == Phase::Ready && !handle.is_ending();
            let Some(container) = handle.container().filter(|_| works) else {
                continue;
            };
            let known = before.remove(&handle.id);
            let fresh = fresh || known.is_none();
            let mut seen = known.unwrap_or_default();
            if fresh {
                seen.linked = linked_goal(&handle);
            }
            working.push((handle, container, seen));
        }
        let goals: Vec<_> =
            working.iter().map(|(handle, _, seen)| response_goal(inner, handle).or(seen.linked)).collect();
        // Sampling has a cost.
        let usages = if goals.iter().any(Option::is_some) {
            join_all(working.iter().map(|(_, container, _)| read_usage(container))).await
        } else {
            working.iter().map(|_| None).collect()
        };
        let now = Instant::now();
        let mut all = Vec::new();
        for (((handle, container, mut seen), goal), usage) in working.into_iter().zip(goals).zip(usages) {
            let rates = usage.as_ref().zip(seen.usage.as_ref());
            let rates = rates.and_then(|(usage, (then, before))| usage_rates(before, usage, now - *then));
            let pressure = usage.as_ref().and_then(|usage| usage.pressure);
            seen.usage = usage.map(|usage| (now, usage));
            let (used, throttled) = rates.unzip();
            all.push(WorkingServant {
                limits: handle.limits(),
                asked: handle.requested_limits(),
                enforced: container.enforced_limits().limits,
                used,
                throttled: throttled.unwrap_or_default(),
                waited: pressure.map_or(0.0, |pressure| pressure.cpu / 100.0),
                goal,
                history: seen.history,
                handle: Arc::clone(&handle),
                container,
            });
            self.servants.insert(handle.id.clone(), seen);
        }
        // Deterministic order, for the same decisions on the same servants.
        all.sort_unstable_by(|one, other| one.handle.id.cmp(&other.handle.id));
        all
    }

    /// Moves cores.
    fn control(&mut self, inner: &Arc<ChoreographerInner>, mut looked: Vec<WorkingServant>) {
        self.moves.take_finished();
        let cores = millicpus(inner.options.cores);
        // Cores that this host cannot limit are not moved.
        looked.retain(|one| one.enforced.cpus.is_some());
        let now = Instant::now().into_std();
        let facts: Vec<ControlFacts<'_>> = looked.iter().map(|one| one.facts(inner, cores, now)).collect();
        let outcomes = control(cores, &facts, now);
        for (one, outcome) in looked.into_iter().zip(outcomes) {
            let id = one.handle.id.clone();
            if let Some(seen) = self.servants.get_mut(&id) {
                seen.history = outcome.history;
            }
            if outcome.quota.is_some() || outcome.weight.is_some() {
                let inner = Arc::clone(inner);
                self.moves.begin(&id, async move { one.carry_out(&inner, &outcome).await });
            }
        }
    }
}

/// Returns its usage so far; `None` if it does not report it in time.
pub(super) async fn read_usage(container: &Arc<dyn ServantHandle>) -> Option<Usage> {
    timeout(PATIENCE, container.usage()).await.ok()?.ok()
}

/// Returns the cores used meanwhile, in thousandths, and the fraction of time throttled; `None` if no time has passed.
pub(super) fn usage_rates(before: &Usage, usage: &Usage, passed: Duration) -> Option<(u64, f64)> {
    let seconds = passed.as_secs_f64();
    let of = |now: u64, before: u64| now.saturating_sub(before) as f64 / 1e6 / seconds;
    let used = of(usage.cpu_usec, before.cpu_usec) * 1000.0;
    let throttled = of(usage.throttled_usec, before.throttled_usec);
    (seconds > 0.0).then(|| (used.round() as u64, throttled.min(1.0)))
}

impl WorkingServant {
    fn facts(&self, inner: &ChoreographerInner, cores: u64, now: std::time::Instant) -> ControlFacts<'_> {
        let limit = self.limits.cpus.map_or(cores, millicpus);
        let promised = self.asked.cpus.map_or(0, millicpus);
        ControlFacts {
            id: &self.handle.id,
            promised,
            limit,
            plain: self.limits.cpu_weight.unwrap_or(DEFAULT_CPU_WEIGHT),
            // A servant without a promise has what the operator allows.
            ceiling: match promised {
                0 => limit,
                _ => inner.max_cores(&self.handle).min(cores).max(limit),
            },
            weighed: self.asked.cpu_weight.is_some(),
            quota: self.enforced.cpus.map_or(limit, millicpus),
            weight: self.enforced.cpu_weight.unwrap_or(DEFAULT_CPU_WEIGHT),
            used: self.used,
            throttled: self.throttled,
            waited: self.waited,
            goal: self.goal,
            // Requests sent before its cores were raised say nothing about their effect.
            measured: inner.recent.p95_since(&self.handle.id, self.history.raised_at(), now),
            history: self.history,
        }
    }

    async fn carry_out(&self, inner: &ChoreographerInner, outcome: &ControlDecision) {
        let handle = &self.handle;
        let _turn = handle.lock_limits().await;
        // Its limits have been changed: it is evaluated again in the next round.
        if handle.requested_limits() != self.asked || handle.is_ending() {
            return;
        }
        let limits = Limits {
            cpus: outcome.quota.map(|quota| quota as f64 / 1000.0),
            cpu_weight: outcome.weight,
            ..Limits::default()
        };
        match timeout(PATIENCE, self.container.set_limits(limits)).await {
            Ok(Ok(_)) => {
                inner.moves.fetch_add(1, Ordering::Relaxed);
                let message = format!(
                    "servant {} of {} for {}: {}: {}",
                    handle.id,
                    handle.service(),
                    handle.robot,
                    self.in_words(outcome),
                    outcome.reason
                );
                let journal = &inner.journal;
                journal.info("cores-moved", &message, &handle.event_context());
            }
            // A servant that is ending is reported elsewhere.
            Ok(Err(error)) => {
                tracing::debug!("cannot change the cores of servant {}: {error}", handle.id)
            }
            Err(_) => tracing::warn!("servant {} does not accept other limits", handle.id),
        }
    }

    fn in_words(&self, outcome: &ControlDecision) -> String {
        let cores = |millicpus: u64| millicpus as f64 / 1000.0;
        let quota = outcome.quota.map(|quota| {
            let was = self.enforced.cpus.unwrap_or_default();
            format!("cpu.max {was} → {} cores", cores(quota))
        });
        let weight = outcome.weight.map(|weight| {
            let was = self.enforced.cpu_weight.unwrap_or_default();
            format!("cpu.weight {was} → {weight}")
        });
        quota.into_iter().chain(weight).collect::<Vec<_>>().join(", ")
    }
}

/// Returns the response times that its robot accepts: the strictest of its statements, or its class's.
pub(crate) fn response_goal(inner: &ChoreographerInner, handle: &Handle) -> Option<ResponseGoal> {
    let terms = handle.terms();
    let stated = terms.stated.values();
    let mut slas: Vec<api::Sla> = stated.clone().map(|stated| stated.sla).collect();
    slas.retain(|sla| !sla.is_empty());
    let says = |stated: &api::Stated| stated.cpus.is_some() || stated.memory.is_some();
    if slas.is_empty() && !stated.clone().any(says) {
        let class = terms.class.as_ref();
        let class = class.and_then(|name| inner.options.classes.get(name));
        slas.extend(class.map(|class| class.sla).filter(|sla| !sla.is_empty()));
    }
    let seconds = |span: Option<api::Span>| span.map(api::Span::as_seconds);
    let times = slas.iter();
    strictest_goal(times.map(|sla| (seconds(sla.rrt), seconds(sla.max_rrt))))
}

/// Returns the response times reported by stubs of an earlier version when their node was linked.
fn linked_goal(handle: &Handle) -> Option<ResponseGoal> {
    let reach = handle.reach().filter(|_| handle.is_linked())?;
    let links = reach.links();
    let slas = links.iter().map(|link| &link.sla);
    let slas = slas.filter(|sla| **sla != link::control::SlaTargets::default());
    strictest_goal(slas.map(|sla| (sla.desire, sla.max)))
}

/// Returns the strictest of T_desire and T_max, given in seconds; `None` without an SLA.
fn strictest_goal(slas: impl Iterator<Item = (Option<f64>, Option<f64>)>) -> Option<ResponseGoal> {
    let milliseconds = |seconds: Option<f64>| {
        let sane = seconds.filter(|seconds| seconds.is_finite() && *seconds > 0.0);
        sane.map(|seconds| seconds * 1000.0)
    };
    let least = |one: Option<f64>, other: Option<f64>| match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    };
    slas.map(|(desire, max)| ResponseGoal { desire: milliseconds(desire), max: milliseconds(max) })
        .reduce(|one, other| ResponseGoal { desire: least(one.desire, other.desire), max: least(one.max, other.max) })
}

impl ChoreographerInner {
    /// Returns the maximum number of cores for its robot, in thousandths, by its class and its service.
    fn max_cores(&self, handle: &Handle) -> u64 {
        let terms = handle.terms();
        let class = terms.class.as_ref().and_then(|name| self.options.classes.get(name));
        let caps = [class.map(|class| class.caps), Some(handle.revision.plan.caps)];
        let cpus = caps.into_iter().flatten().filter_map(|caps| caps.cpus);
        cpus.map(millicpus).min().unwrap_or(u64::MAX)
    }
}

fn millicpus(cpus: f64) -> u64 {
    (cpus * 1000.0).round() as u64
}
