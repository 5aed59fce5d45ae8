//! Checks the decisions against a plain implementation of the published algorithm, extended by the bound on Q (see
//! `Satisfaction`). Without the bound the two are identical until Q reaches it; after that the bound only makes the
//! local original start earlier. T under each measure is computed here once more, millisecond by millisecond.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use qos::{Effect, Governor, LocalState, QosEvent, QosSla, Responder, RetentionLimits, Stamp};

const T_DESIRE: u64 = 100;
const T_MAX: u64 = 300;
const THRESHOLD: f64 = 4.0;
/// Upper bound of Q, 4·Q_t.
const BOUND: f64 = 4.0 * THRESHOLD;

/// The published algorithm. `t` is in milliseconds.
struct Reference {
    /// T_desire and T_max.
    times: (u64, u64),
    q: f64,
    /// Maximum of Q; infinite as published.
    most: f64,
    running: bool,
    log: Vec<&'static str>,
}

impl Reference {
    fn new(initial: f64, most: f64) -> Reference {
        let q = initial.min(most);
        // Before any request: the goal may be violated from the start.
        let running = q < THRESHOLD;
        Reference { times: (T_DESIRE, T_MAX), q, most, running, log: if running { vec!["start"] } else { vec![] } }
    }

    fn request_done(&mut self, t: u64) {
        if t <= self.times.0 {
            self.q += 2.0;
        } else if t <= self.times.1 {
            self.q += 1.0;
        } else {
            self.q /= 2.0;
        }
        self.q = self.q.min(self.most);
        if self.q < THRESHOLD && !self.running {
            self.running = true;
            self.log.push("start");
        }
        if self.q > THRESHOLD && self.running {
            self.running = false;
            self.log.push("stop");
        }
    }
}

fn next_below(x: f64) -> f64 {
    f64::from_bits(x.to_bits() - 1)
}

fn apply_effects(governor: &mut Governor<u32>, now: Instant, log: &mut Vec<&'static str>) {
    while let Some(effect) = governor.next_effect() {
        match effect {
            Effect::Event(QosEvent::Start(_)) => {
                log.push("start");
                governor.on_local_state(now, LocalState::Ready);
            }
            Effect::Event(QosEvent::Stop(_)) => log.push("stop"),
            _ => {}
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(2000) })]
    #[test]
    fn one_request_after_another(
        initial in 0.5f64..20.0,
        // From a good cloud, whose Q exceeds the bound, to one that is mostly late.
        slowest in 100u64..900,
        shares in prop::collection::vec(0.0f64..1.0, 1..120),
        local_wins in prop::collection::vec(any::<bool>(), 120),
    ) {
        let times = shares.into_iter().map(|share| (share * slowest as f64) as u64);
        let sla = serde_json::json!({
            "t_desire": 0.1, "t_max": 0.3, "threshold": THRESHOLD, "initial": initial, "local": "cold"
        });
        let mut governor = Governor::new(QosSla::parse(sla).unwrap(), vec![], RetentionLimits::default());
        let mut published = Reference::new(initial, f64::INFINITY);
        let mut bounded = Reference::new(initial, next_below(BOUND));
        let mut now = Instant::now();
        let mut log = vec![];
        governor.link_up(now, false);
        apply_effects(&mut governor, now, &mut log);
        let name: Arc<str> = "/add".into();
        let mut same = initial < BOUND;
        for (t, local_wins) in times.zip(local_wins) {
            let id = governor.call(now, &name, 0);
            apply_effects(&mut governor, now, &mut log);
            if log.last() == Some(&"start") && local_wins {
                // The local original's answer is early; the cloud's time counts all the same.
                let _ = governor.on_result(now + Duration::from_millis(t.min(1)), Responder::Local, id);
            }
            now += Duration::from_millis(t);
            let _ = governor.on_result(now, Responder::Cloud, id);
            apply_effects(&mut governor, now, &mut log);
            published.request_done(t);
            bounded.request_done(t);
            prop_assert_eq!(governor.satisfaction().q(), bounded.q);
            prop_assert_eq!(&log, &bounded.log);
            same &= published.q < BOUND;
            if same {
                prop_assert_eq!(bounded.q, published.q);
                prop_assert_eq!(&log, &published.log);
            }
            prop_assert!(bounded.running || !published.running, "it starts later than published");
            now += Duration::from_millis(5);
        }
    }
}

/// Returns the first millisecond from `at` on at which the link is up; `up` holds its state per millisecond.
fn first_up(up: &[bool], at: u64) -> Option<u64> {
    (at..up.len() as u64).find(|at| up[*at as usize])
}

/// Returns the state of the link per millisecond, from the lengths of its good and bad periods.
fn link_over_time(times: &[(u64, u64)], length: u64) -> Vec<bool> {
    let spans = times.iter();
    let mut up: Vec<bool> = spans
        .flat_map(|(good, bad)| {
            let good = std::iter::repeat_n(true, *good as usize);
            good.chain(std::iter::repeat_n(false, *bad as usize))
        })
        .take(length as usize)
        .collect();
    up.resize(length as usize, true);
    up
}

fn sla(written: serde_json::Value) -> QosSla {
    QosSla::parse(written).unwrap()
}

/// A governor driven millisecond by millisecond.
struct World {
    governor: Governor<u32>,
    begun: Instant,
    log: Vec<&'static str>,
    /// Requests sent to the cloud.
    given: Vec<u32>,
}

impl World {
    fn new(sla: QosSla) -> World {
        let pairs = vec!["/image -> /found by stamp".parse().unwrap()];
        // An output may carry a stamp from before the start.
        let begun = Instant::now() + Duration::from_secs(1000);
        let mut world = World {
            governor: Governor::new(sla, pairs, RetentionLimits::default()),
            begun,
            log: vec![],
            given: vec![],
        };
        world.governor.begin(begun);
        world.apply_effects(begun);
        world
    }

    fn apply_effects(&mut self, now: Instant) {
        while let Some(effect) = self.governor.next_effect() {
            match effect {
                Effect::Event(QosEvent::Start(_)) => {
                    self.log.push("start");
                    self.governor.on_local_state(now, LocalState::Ready);
                }
                Effect::Event(QosEvent::Stop(_)) => self.log.push("stop"),
                Effect::Give { side: Responder::Cloud, payload, .. } => self.given.push(payload),
                _ => {}
            }
        }
    }

    /// Handles everything due at this millisecond.
    fn tick(&mut self, at: u64) -> Instant {
        let now = self.begun + Duration::from_millis(at);
        while self.governor.deadline().is_some_and(|due| due <= now) {
            self.governor.tick(now);
            self.apply_effects(now);
        }
        now
    }

    fn q(&self) -> f64 {
        self.governor.satisfaction().q()
    }
}

fn stamp(number: u32) -> Stamp {
    Stamp { secs: number + 1, nsecs: 0 }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(80) })]

    /// Overlapping requests over a link that is lost and restored: each counts once, by its response time.
    #[test]
    fn requests_at_the_same_time_over_a_link_that_is_lost(
        initial in 0.5f64..20.0,
        factor in prop_oneof![Just(f64::INFINITY), 1.1f64..10.0],
        // The pause before the request, the cloud's time, and whether it is a call.
        requests in prop::collection::vec((0u64..150, 1u64..450, any::<bool>()), 1..50),
        times in prop::collection::vec((0u64..800, 1u64..500), 0..8),
    ) {
        let cap = factor * THRESHOLD;
        let mut sla = sla(serde_json::json!({
            "t_desire": 0.1, "t_max": 0.3, "threshold": THRESHOLD, "initial": initial, "local": "cold"
        }));
        sla.cap = cap;
        let mut asked = 0;
        let requests: Vec<(u64, u64, bool)> = requests.into_iter().map(|(pause, takes, call)| {
            asked += pause;
            (asked, takes, call)
        }).collect();
        let length = asked + 2000;
        let up = link_over_time(&times, length);
        // Arrival of each answer: the request reaches the cloud while the link is up, and so does the answer the robot.
        let arrivals: Vec<u64> = requests.iter().map(|(asked, takes, _)| {
            let reached = first_up(&up, *asked);
            reached.and_then(|reached| first_up(&up, reached + takes)).unwrap_or(u64::MAX)
        }).collect();
        let mut due: Vec<u64> = requests.iter().map(|(asked, ..)| asked + T_MAX + 1).collect();
        let mut counted = vec![false; requests.len()];
        let mut answered: Vec<Option<u64>> = vec![None; requests.len()];
        let mut heard: Option<u64> = None;
        let mut reference = Reference::new(initial, next_below(cap));
        let mut world = World::new(sla);
        world.governor.link_up(world.begun, false);
        let (call, image): (Arc<str>, Arc<str>) = ("/add".into(), "/image".into());
        let mut ids = vec![None; requests.len()];
        // Requests that reached the cloud and are not answered, and since when.
        let mut open: BTreeMap<u32, Option<u64>> = BTreeMap::new();
        for at in 0..length {
            let now = world.tick(at);
            let is_up = up[at as usize];
            if is_up {
                world.governor.link_up(now, true);
            } else {
                world.governor.link_down(now);
            }
            world.apply_effects(now);
            for number in std::mem::take(&mut world.given) {
                open.entry(number).or_default();
            }
            for (number, reached) in open.iter_mut().filter(|_| is_up) {
                let (_, takes, is_call) = requests[*number as usize];
                if at < *reached.get_or_insert(at) + takes {
                    continue;
                }
                answered[*number as usize] = Some(at);
                // It stays, and is not answered again.
                *reached = Some(u64::MAX / 2);
                if is_call {
                    let _ = world.governor.on_result(now, Responder::Cloud, ids[*number as usize].unwrap());
                } else {
                    let key = stamp(*number).into();
                    let _ = world.governor.output(now, Responder::Cloud, "/found", Some(key), Duration::ZERO);
                }
                world.apply_effects(now);
            }
            world.apply_effects(now);
            for number in 0..requests.len() {
                let (asked, _, is_call) = requests[number];
                if asked != at {
                    continue;
                }
                let payload = number as u32;
                if is_call {
                    ids[number] = Some(world.governor.call(now, &call, payload));
                } else {
                    world.governor.input(now, &image, Some(stamp(payload).into()), payload);
                }
            }
            world.apply_effects(now);
            for number in std::mem::take(&mut world.given) {
                open.entry(number).or_insert(is_up.then_some(at));
            }
            // As published, late requests count first: they became late a nanosecond after the last millisecond. An
            // input is left out, which does not count, if a later one was answered by then; that is waited for until
            // T_max after the node's last answer, and for at most twice T_max.
            for number in 0..requests.len() {
                let (asked, _, is_call) = requests[number];
                if counted[number] || due[number] != at {
                    continue;
                }
                let busy_until = heard
                    .filter(|heard| !is_call && *heard >= asked)
                    .map(|heard| heard.min(asked + T_MAX) + T_MAX + 1);
                let mut later = requests.iter().zip(&answered).skip(number + 1);
                let is_before = |answered: &Option<u64>| answered.is_some_and(|answered| answered < at);
                let is_left_out = !is_call && later.any(|((.., is_call), answered)| !is_call && is_before(answered));
                match busy_until.filter(|until| *until > at) {
                    Some(until) if !is_left_out => due[number] = until,
                    _ => {
                        counted[number] = true;
                        if !is_left_out {
                            reference.request_done(T_MAX + 1);
                        }
                    }
                }
            }
            for number in (0..requests.len()).filter(|number| arrivals[*number] == at) {
                if !std::mem::replace(&mut counted[number], true) {
                    reference.request_done(at - requests[number].0);
                }
            }
            let mut images = requests.iter().zip(&answered).filter(|((.., is_call), _)| !is_call);
            if images.any(|(_, answered)| *answered == Some(at)) {
                heard = Some(at);
            }
            prop_assert_eq!(world.q(), reference.q, "at {} ms", at);
            prop_assert_eq!(&world.log, &reference.log, "at {} ms", at);
        }
    }

    /// Frames per second: T is the mean interval of the last frames.
    #[test]
    fn frames(
        initial in 0.5f64..20.0,
        over in 1usize..6,
        pauses in prop::collection::vec(prop_oneof![5 => 1u64..400, 1 => 400u64..2000], 1..60),
    ) {
        let mut world = World::new(sla(serde_json::json!({
            "measure": {"frames_per_second": {"output": "/found", "desire": 10, "min": 4, "over": over}},
            "threshold": THRESHOLD, "initial": initial, "local": "cold",
        })));
        const LONGEST: u64 = 250;
        let mut reference = Reference::new(initial, next_below(BOUND));
        reference.times = (T_DESIRE, LONGEST);
        world.governor.link_up(world.begun, false);
        world.governor.set_listened(world.begun, "/found", true);
        let mut due: VecDeque<u64> = pauses.iter().scan(0, |at, pause| {
            *at += pause;
            Some(*at)
        }).collect();
        let mut frames: Vec<u64> = vec![];
        // Time at which the expected frame was last counted as missing.
        let mut counted: Option<u64> = None;
        for at in 0..due.back().unwrap() + 1000 {
            let now = world.tick(at);
            let misses = match (counted, frames.last()) {
                (Some(counted), _) => at - counted >= LONGEST,
                (None, None) => at > LONGEST,
                (None, Some(last)) => {
                    let mean_of = over.min(frames.len());
                    let took = at - frames[frames.len() - mean_of];
                    took > mean_of as u64 * LONGEST && at - last > LONGEST
                }
            };
            if misses {
                counted = Some(at);
                reference.request_done(LONGEST + 1);
            }
            if due.front() == Some(&at) {
                due.pop_front();
                let _ = world.governor.output(now, Responder::Cloud, "/found", None, Duration::ZERO);
                world.apply_effects(now);
                if counted.take().is_some() {
                    frames.clear();
                }
                frames.push(at);
                let mean_of = over.min(frames.len() - 1) as u64;
                if mean_of > 0 {
                    let took = at - frames[frames.len() - 1 - mean_of as usize];
                    // Rounded up to whole milliseconds.
                    reference.request_done(took.div_ceil(mean_of));
                }
            }
            prop_assert_eq!(world.q(), reference.q, "at {} ms", at);
            prop_assert_eq!(&world.log, &reference.log, "at {} ms", at);
        }
    }

    /// Age: T is the age that an output has reached when the next one arrives.
    #[test]
    fn ages(
        initial in 0.5f64..20.0,
        outputs in prop::collection::vec((1u64..300, prop_oneof![5 => 0u64..200, 1 => 200u64..900]), 1..60),
    ) {
        let mut world = World::new(sla(serde_json::json!({
            "measure": {"age": {"output": "/found", "desire": 0.1, "max": 0.3}},
            "threshold": THRESHOLD, "initial": initial, "local": "cold",
        })));
        let mut reference = Reference::new(initial, next_below(BOUND));
        world.governor.link_up(world.begun, false);
        world.governor.set_listened(world.begun, "/found", true);
        let mut due: VecDeque<(u64, u64)> = outputs.iter().scan(0, |at, (pause, age)| {
            *at += pause;
            Some((*at, *age))
        }).collect();
        let mut born: Option<i64> = None;
        let mut counted: Option<u64> = None;
        for at in 0..due.back().unwrap().0 + 1000 {
            let now = world.tick(at);
            let is_missing = |born: Option<i64>, counted: Option<u64>| match (counted, born) {
                (Some(counted), _) => at - counted >= T_MAX,
                (None, born) => at as i64 - born.unwrap_or(0) > T_MAX as i64,
            };
            if is_missing(born, counted) {
                counted = Some(at);
                reference.request_done(T_MAX + 1);
            }
            if due.front().is_some_and(|due| due.0 == at) {
                let age = due.pop_front().unwrap().1;
                let aged = Duration::from_millis(age);
                let _ = world.governor.output(now, Responder::Cloud, "/found", None, aged);
                world.apply_effects(now);
                let before = born.replace(at as i64 - age as i64);
                if let Some(before) = before.filter(|_| counted.take().is_none()) {
                    reference.request_done((at as i64 - before) as u64);
                }
                counted = None;
                // It may be too old on arrival.
                world.tick(at);
                if is_missing(born, counted) {
                    counted = Some(at);
                    reference.request_done(T_MAX + 1);
                }
            }
            prop_assert_eq!(world.q(), reference.q, "at {} ms", at);
            prop_assert_eq!(&world.log, &reference.log, "at {} ms", at);
        }
    }

    /// Without a response time the link alone decides.
    #[test]
    fn the_link_alone(times in prop::collection::vec((1u64..2000, 1u64..2000), 1..12)) {
        const AFTER: u64 = 1000;
        let mut world = World::new(sla(serde_json::json!({"measure": {"link": {"after": 1}}})));
        let length = times.iter().map(|(down, up)| down + up).sum::<u64>();
        let down = link_over_time(&times, length);
        let (mut log, mut since) = (vec![], Some(0));
        for at in 0..length {
            let now = world.tick(at);
            if since.is_some_and(|since| at == since + AFTER) {
                log.push("start");
            }
            match (since, down[at as usize]) {
                (None, true) => {
                    world.governor.link_down(now);
                    since = Some(at);
                }
                (Some(lost), false) => {
                    world.governor.link_up(now, true);
                    if at >= lost + AFTER {
                        log.push("stop");
                    }
                    since = None;
                }
                _ => {}
            }
            world.apply_effects(now);
            prop_assert_eq!(&world.log, &log, "at {} ms", at);
        }
    }
}
