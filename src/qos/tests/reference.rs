//! Decisions match the algorithm as it was published, written down as plainly as possible. It has no bound on Q; ours has
//! one (see `Satisfaction`), which may only make the local original start earlier.

use std::sync::Arc;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use qos::{Effect, Event, Governor, Limits, LocalState, Side, Sla};

const T_DESIRE: u64 = 100;
const T_MAX: u64 = 300;
const THRESHOLD: f64 = 4.0;
/// Where ours is bounded: Q stays below 4·Q_t.
const BOUND: f64 = 4.0 * THRESHOLD;

/// The published algorithm. `t` is in milliseconds.
struct Reference {
    q: f64,
    running: bool,
    log: Vec<&'static str>,
}

impl Reference {
    fn request_done(&mut self, t: u64) {
        if t <= T_DESIRE {
            self.q += 2.0;
        } else if t <= T_MAX {
            self.q += 1.0;
        } else {
            self.q /= 2.0;
        }
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

fn take(governor: &mut Governor<u32>, now: Instant, log: &mut Vec<&'static str>) {
    while let Some(effect) = governor.next_effect() {
        match effect {
            Effect::Event(Event::Start(_)) => {
                log.push("start");
                governor.local(now, LocalState::Ready);
            }
            Effect::Event(Event::Stop(_)) => log.push("stop"),
            _ => {}
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(2000) })]
    #[test]
    fn one_request_after_another(
        initial in 0.5f64..20.0,
        // From a good cloud, whose Q grows beyond the bound, to one that is mostly late.
        slowest in 100u64..900,
        shares in prop::collection::vec(0.0f64..1.0, 1..120),
        local_wins in prop::collection::vec(any::<bool>(), 120),
    ) {
        let times = shares.into_iter().map(|share| (share * slowest as f64) as u64);
        let sla = serde_json::json!({
            "t_desire": 0.1, "t_max": 0.3, "threshold": THRESHOLD, "initial": initial, "local": "cold"
        });
        let mut governor = Governor::new(Sla::parse(sla).unwrap(), vec![], Limits::default());
        let mut reference = Reference { q: initial, running: false, log: vec![] };
        let mut now = Instant::now();
        let mut log = vec![];
        governor.link_up(now, false);
        take(&mut governor, now, &mut log);
        if reference.q < THRESHOLD {
            // Before any request: the promise is broken from the beginning.
            reference.running = true;
            reference.log.push("start");
        }
        let name: Arc<str> = "/add".into();
        let mut bounded = initial >= BOUND;
        for (t, local_wins) in times.zip(local_wins) {
            let id = governor.call(now, &name, 0);
            take(&mut governor, now, &mut log);
            if log.last() == Some(&"start") && local_wins {
                // The local original's answer is early; the cloud's time counts all the same.
                let _ = governor.answered(now + Duration::from_millis(t.min(1)), Side::Local, id);
            }
            now += Duration::from_millis(t);
            let _ = governor.answered(now, Side::Cloud, id);
            take(&mut governor, now, &mut log);
            reference.request_done(t);
            let q = governor.satisfaction().q();
            bounded |= reference.q >= BOUND;
            if bounded {
                prop_assert!(q < BOUND && q <= reference.q, "{} where {} is published", q, reference.q);
                let runs = log.last() == Some(&"start");
                prop_assert!(runs || !reference.running, "it starts later than published");
            } else {
                prop_assert_eq!(q, reference.q);
                prop_assert_eq!(&log, &reference.log);
            }
            now += Duration::from_millis(5);
        }
    }
}
