//! Decisions match the algorithm as it was published, written down as plainly as possible, with the bound on Q that ours has
//! (see `Satisfaction`). Without the bound it is as published; until that Q reaches the bound the two are the same, and after
//! it the bound only makes the local original start earlier.

use std::sync::Arc;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use qos::{Effect, Event, Governor, Limits, LocalState, Side, Sla};

const T_DESIRE: u64 = 100;
const T_MAX: u64 = 300;
const THRESHOLD: f64 = 4.0;
/// Q stays below 4·Q_t.
const BOUND: f64 = 4.0 * THRESHOLD;

/// The published algorithm. `t` is in milliseconds.
struct Reference {
    q: f64,
    /// Q is never above it; infinite as published.
    most: f64,
    running: bool,
    log: Vec<&'static str>,
}

impl Reference {
    fn new(initial: f64, most: f64) -> Reference {
        let q = initial.min(most);
        // Before any request: the promise may be broken from the beginning.
        let running = q < THRESHOLD;
        Reference {
            q,
            most,
            running,
            log: if running { vec!["start"] } else { vec![] },
        }
    }

    fn request_done(&mut self, t: u64) {
        if t <= T_DESIRE {
            self.q += 2.0;
        } else if t <= T_MAX {
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
        let mut published = Reference::new(initial, f64::INFINITY);
        let mut bounded = Reference::new(initial, f64::from_bits(BOUND.to_bits() - 1));
        let mut now = Instant::now();
        let mut log = vec![];
        governor.link_up(now, false);
        take(&mut governor, now, &mut log);
        let name: Arc<str> = "/add".into();
        let mut same = initial < BOUND;
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
