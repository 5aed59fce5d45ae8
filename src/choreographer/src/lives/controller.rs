//! Looks once a second at the machine and at the servants that work, and carries out what is decided: nobody is admitted while
//! the machine stalls, and cores are moved to those who are near what their robots accept.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use api::{Limits, Phase};
use futures_util::future::join_all;
use servant::engine::{Servant, Usage};
use servant::host;
use store::NewEvent;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::Inner;
use super::limits::PLAIN_WEIGHT;
use super::visits::Visits;
use crate::decide::controller::{Facts, Goal, History, Outcome, control};
use crate::decide::stall::{Reading, Stall};
use crate::engine_limits;
use crate::lives::handle::Handle;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// For one servant to tell what it uses, or to take other limits.
const PATIENCE: Duration = Duration::from_secs(5);
/// What stubs told is looked at once in so many looks.
const LINKED: u64 = 10;

/// What is remembered from one look to the next.
#[derive(Default)]
struct Watch {
    looks: u64,
    servants: HashMap<String, Seen>,
    stall: Stall,
    swapped_in: Option<(Instant, u64)>,
    /// Servants whose cores are being moved.
    moves: Visits<()>,
}

/// What is remembered of a servant.
#[derive(Default)]
struct Seen {
    history: History,
    /// What it had used by then; none where nobody looked.
    usage: Option<(Instant, Usage)>,
    /// What its stubs told when their nodes were linked.
    linked: Option<Goal>,
}

/// A servant that was looked at. Cores are in thousandths.
struct Looked {
    handle: Arc<Handle>,
    container: Arc<dyn Servant>,
    limits: Limits,
    asked: Limits,
    /// As they are in force.
    enforced: servant::spec::Limits,
    used: Option<u64>,
    throttled: f64,
    waited: f64,
    goal: Option<Goal>,
    history: History,
}

/// Looks, for ever.
pub(crate) async fn watch(inner: Arc<Inner>) {
    let mut watch = Watch::default();
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        let reading = watch.read();
        inner.note_stall(watch.stall.judge(reading, Instant::now().into_std()));
        let looked = watch.look(&inner).await;
        if inner.options.controller {
            watch.control(&inner, looked);
        }
    }
}

impl Inner {
    /// From now on nobody is admitted, for this reason, or those who fit are again.
    pub(crate) fn note_stall(&self, why: Option<String>) {
        let words = why.clone();
        if !self.admission.stall(why) {
            return;
        }
        let about = NewEvent::default();
        match words {
            Some(why) => {
                let message = format!("{why}; no servant is admitted until that is over");
                self.journal.warning("machine-stalled", &message, &about);
            }
            None => {
                let message = "this machine stalls no longer; servants are admitted again";
                self.journal.info("machine-recovered", message, &about);
            }
        }
    }
}

impl Watch {
    fn read(&mut self) -> Reading {
        let now = Instant::now();
        let swapped_in = host::swapped_in();
        let before = std::mem::replace(&mut self.swapped_in, swapped_in.map(|bytes| (now, bytes)));
        let rate = swapped_in.zip(before).map(|(bytes, (then, earlier))| {
            let seconds = now.saturating_duration_since(then).as_secs_f64();
            bytes.saturating_sub(earlier) as f64 / seconds.max(LOOK.as_secs_f64())
        });
        Reading {
            memory_full: host::memory_stalled(),
            available: host::memory_available(),
            swapped_in: rate.unwrap_or(0.0),
        }
    }

    /// Servants that work; with what they used since the last look, if any of their robots has stated what it accepts.
    async fn look(&mut self, inner: &Inner) -> Vec<Looked> {
        let handles: Vec<Arc<Handle>> = inner.servants.lock().all.values().cloned().collect();
        inner
            .recent
            .keep(|id| handles.iter().any(|handle| handle.id == id));
        let fresh = self.looks % LINKED == 0;
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
                seen.linked = linked(&handle);
            }
            working.push((handle, container, seen));
        }
        let goals: Vec<_> = working
            .iter()
            .map(|(handle, _, seen)| goal(inner, handle).or(seen.linked))
            .collect();
        // Looking costs something, too.
        let usages = match goals.iter().any(Option::is_some) {
            true => join_all(working.iter().map(|(_, container, _)| usage(container))).await,
            false => working.iter().map(|_| None).collect(),
        };
        let now = Instant::now();
        let mut all = Vec::new();
        for (((handle, container, mut seen), goal), usage) in
            working.into_iter().zip(goals).zip(usages)
        {
            let rates = usage.as_ref().zip(seen.usage.as_ref());
            let rates =
                rates.and_then(|(usage, (then, before))| rates_of(before, usage, now - *then));
            let pressure = usage.as_ref().and_then(|usage| usage.pressure);
            seen.usage = usage.map(|usage| (now, usage));
            let (used, throttled) = rates.unzip();
            all.push(Looked {
                limits: handle.limits(),
                asked: handle.asked(),
                enforced: container.enforced().limits,
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
        // Decisions are the same for the same servants.
        all.sort_unstable_by(|one, other| one.handle.id.cmp(&other.handle.id));
        all
    }

    /// Moves cores.
    fn control(&mut self, inner: &Arc<Inner>, mut looked: Vec<Looked>) {
        self.moves.take_over();
        let cores = millicpus(inner.options.cores);
        // What this host cannot limit is not moved.
        looked.retain(|one| one.enforced.cpus.is_some());
        let now = Instant::now().into_std();
        let facts: Vec<Facts<'_>> = looked
            .iter()
            .map(|one| one.facts(inner, cores, now))
            .collect();
        let outcomes = control(cores, &facts, now);
        for (one, outcome) in looked.into_iter().zip(outcomes) {
            let id = one.handle.id.clone();
            if let Some(seen) = self.servants.get_mut(&id) {
                seen.history = outcome.history;
            }
            if outcome.quota.is_some() || outcome.weight.is_some() {
                let inner = Arc::clone(inner);
                self.moves
                    .begin(&id, async move { one.carry_out(&inner, &outcome).await });
            }
        }
    }
}

/// What it has used so far; none where it does not say so in time.
pub(super) async fn usage(container: &Arc<dyn Servant>) -> Option<Usage> {
    timeout(PATIENCE, container.usage()).await.ok()?.ok()
}

/// Thousandths of a core that were used meanwhile, and the part of the time throttled; none where no time has passed.
pub(super) fn rates_of(before: &Usage, usage: &Usage, passed: Duration) -> Option<(u64, f64)> {
    let seconds = passed.as_secs_f64();
    let of = |now: u64, before: u64| now.saturating_sub(before) as f64 / 1e6 / seconds;
    let used = of(usage.cpu_usec, before.cpu_usec) * 1000.0;
    let throttled = of(usage.throttled_usec, before.throttled_usec);
    (seconds > 0.0).then(|| (used.round() as u64, throttled.min(1.0)))
}

impl Looked {
    fn facts(&self, inner: &Inner, cores: u64, now: std::time::Instant) -> Facts<'_> {
        let limit = self.limits.cpus.map_or(cores, millicpus);
        let promised = self.asked.cpus.map_or(0, millicpus);
        Facts {
            id: &self.handle.id,
            promised,
            limit,
            plain: self.limits.cpu_weight.unwrap_or(PLAIN_WEIGHT),
            // Who was promised nothing has what the operator allows those.
            ceiling: match promised {
                0 => limit,
                _ => inner.cap(&self.handle).min(cores).max(limit),
            },
            weighed: self.asked.cpu_weight.is_some(),
            quota: self.enforced.cpus.map_or(limit, millicpus),
            weight: self.enforced.cpu_weight.unwrap_or(PLAIN_WEIGHT),
            used: self.used,
            throttled: self.throttled,
            waited: self.waited,
            goal: self.goal,
            // What was asked before its cores were raised says nothing of what they do for it.
            measured: inner
                .recent
                .since(&self.handle.id, self.history.raised(), now),
            history: self.history,
        }
    }

    async fn carry_out(&self, inner: &Inner, outcome: &Outcome) {
        let handle = &self.handle;
        let _turn = handle.limits_turn().await;
        // Somebody has changed what it is to have: it is looked at again.
        if handle.asked() != self.asked || handle.is_ending() {
            return;
        }
        let limits = Limits {
            cpus: outcome.quota.map(|quota| quota as f64 / 1000.0),
            cpu_weight: outcome.weight,
            ..Limits::default()
        };
        match timeout(PATIENCE, self.container.set_limits(engine_limits(&limits))).await {
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
                journal.info("cores-moved", &message, &handle.about());
            }
            // One that ends just now is told of elsewhere.
            Ok(Err(error)) => tracing::debug!("cores of servant {} stay: {error}", handle.id),
            Err(_) => tracing::warn!("servant {} does not take other limits", handle.id),
        }
    }

    fn in_words(&self, outcome: &Outcome) -> String {
        let cores = |millicpus: u64| millicpus as f64 / 1000.0;
        let quota = outcome.quota.map(|quota| {
            let was = self.enforced.cpus.unwrap_or_default();
            format!("cpu.max {was} → {} cores", cores(quota))
        });
        let weight = outcome.weight.map(|weight| {
            let was = self.enforced.cpu_weight.unwrap_or_default();
            format!("cpu.weight {was} → {weight}")
        });
        quota
            .into_iter()
            .chain(weight)
            .collect::<Vec<_>>()
            .join(", ")
    }
}

/// What its robot accepts: the strictest of what was stated before it was admitted, else its class's.
pub(crate) fn goal(inner: &Inner, handle: &Handle) -> Option<Goal> {
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
    strictest(times.map(|sla| (seconds(sla.rrt), seconds(sla.max_rrt))))
}

/// What stubs of an earlier version say when their node is linked.
fn linked(handle: &Handle) -> Option<Goal> {
    let reach = handle.reach().filter(|_| handle.is_linked())?;
    let links = reach.links();
    let slas = links.iter().map(|link| &link.sla);
    let slas = slas.filter(|sla| **sla != link::control::Sla::default());
    strictest(slas.map(|sla| (sla.desire, sla.max)))
}

/// The strictest of T_desire and T_max, in seconds; none of no SLA.
fn strictest(slas: impl Iterator<Item = (Option<f64>, Option<f64>)>) -> Option<Goal> {
    let milliseconds = |seconds: Option<f64>| {
        let sane = seconds.filter(|seconds| seconds.is_finite() && *seconds > 0.0);
        sane.map(|seconds| seconds * 1000.0)
    };
    let least = |one: Option<f64>, other: Option<f64>| match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    };
    slas.map(|(desire, max)| Goal {
        desire: milliseconds(desire),
        max: milliseconds(max),
    })
    .reduce(|one, other| Goal {
        desire: least(one.desire, other.desire),
        max: least(one.max, other.max),
    })
}

impl Inner {
    /// The most cores that its robot may have, in thousandths: what its class and its service allow.
    fn cap(&self, handle: &Handle) -> u64 {
        let terms = handle.terms();
        let class = terms
            .class
            .as_ref()
            .and_then(|name| self.options.classes.get(name));
        let caps = [
            class.map(|class| class.caps),
            Some(handle.revision.plan.caps),
        ];
        let cpus = caps.into_iter().flatten().filter_map(|caps| caps.cpus);
        cpus.map(millicpus).min().unwrap_or(u64::MAX)
    }
}

fn millicpus(cpus: f64) -> u64 {
    (cpus * 1000.0).round() as u64
}
