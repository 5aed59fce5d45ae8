//! Decides how many servants answer the robots that share a service.
//!
//! The load is the mean number of requests in the system, waiting or in service: by Little's law (L = λW) the arrival
//! rate times the response time, so that both a higher rate and slower answers show in it. A node that answers one call
//! after the other is fully busy at one.
//!
//! | mean requests, with `n` servants | for | then |
//! |---|---|---|
//! | more than 1.5 n | a second | one more, up to the maximum |
//! | more than n, and answers are later than desired | a second | one more: requests wait for each other |
//! | fewer than 0.7 (n - 1) | `calm` | one fewer, down to the minimum |
//!
//! One more servant raises the first bound to that of `n + 1`, and the last one is below half of it, so that a constant
//! load never makes a group grow and shrink in turns. While a servant starts, nothing else changes. If one more is
//! wanted while one retires, which may take as long as its last request, the retiring one is kept. A servant that could
//! not be started is tried again after a pause.

use std::time::{Duration, Instant};

/// Requests per servant above which one more is started.
const GROW_LOAD: f64 = 1.5;
/// Requests per servant above which one more is started if answers are late.
const LATE: f64 = 1.0;
/// Requests per remaining servant below which one retires.
const SHRINK_LOAD: f64 = 0.7;
/// Time for which the load must be high.
const STEADY: Duration = Duration::from_secs(1);
/// Pause after a servant could not be started.
const PAUSE: Duration = Duration::from_secs(5);
/// Number of places in a group that are kept for robots that left and may come back.
pub(crate) const MAX_FORMER_ROBOTS: usize = 256;

/// Snapshot of a group.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroupFacts {
    /// Minimum and maximum number of servants.
    pub(crate) bounds: (usize, usize),
    /// Number of servants that accept requests.
    pub(crate) ready: usize,
    /// Number of servants that are starting.
    pub(crate) starting: usize,
    /// Number of servants that finish their last requests.
    pub(crate) retiring: usize,
    /// Mean number of requests in the system since the last snapshot.
    pub(crate) requests: f64,
    /// Mean response time, and the maximum, if known.
    pub(crate) time: Option<(Duration, Duration)>,
    /// Last time a servant could not be started, or was lost before it was ready.
    pub(crate) failed: Option<Instant>,
    /// Time for which the load must be low before a servant retires.
    pub(crate) calm: Duration,
}

/// A change of a group's servants.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum GroupAction {
    /// Start one more servant, for this reason.
    Start(String),
    /// Keep the retiring servant after all, for this reason.
    TakeBack(String),
    /// Retire one servant, for this reason.
    Retire(String),
}

/// Times since which the load has been high or low.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct LoadSince {
    many: Option<Instant>,
    few: Option<Instant>,
}

/// Decides what is to be done now; also returns the times since which the load has been high or low, to be passed in
/// the next time.
pub(crate) fn decide_group(facts: &GroupFacts, since: LoadSince, now: Instant) -> (Option<GroupAction>, LoadSince) {
    let (least, most) = facts.bounds;
    let (least, most) = (least.max(1), most.max(least).max(1));
    let there = facts.ready + facts.starting;
    let rests = facts.failed.is_some_and(|failed| now < failed + PAUSE);
    let one_more = |reason: String| match facts.retiring {
        0 => (!rests).then_some(GroupAction::Start(reason)),
        _ => Some(GroupAction::TakeBack(reason)),
    };
    if there < least {
        // The first servants are started all at once.
        let reason = match there {
            0 => "a robot asks for the service".to_owned(),
            _ => format!("the minimum is {least} servants"),
        };
        return (one_more(reason), LoadSince::default());
    }
    if facts.starting > 0 {
        return (None, LoadSince::default());
    }
    let servants = facts.ready as f64;
    let late = facts.time.filter(|(takes, may)| takes > may && facts.requests > LATE * servants);
    let many = facts.requests > GROW_LOAD * servants || late.is_some();
    let few = facts.requests < SHRINK_LOAD * (servants - 1.0);
    let since = LoadSince { many: many.then(|| since.many.unwrap_or(now)), few: few.then(|| since.few.unwrap_or(now)) };
    let has_been = |since: Option<Instant>, long: Duration| since.is_some_and(|at| now >= at + long);
    if has_been(since.many, STEADY) && there < most && (facts.retiring > 0 || !rests) {
        let requests = facts.requests;
        let reason = match late {
            Some((takes, may)) => format!(
                "{requests:.1} concurrent requests delay each other at {there} servants: they take {takes:.0?} instead \
                    of {may:.0?}"
            ),
            None => format!("{requests:.1} concurrent requests are many for {there} servants"),
        };
        return (one_more(reason), LoadSince::default());
    }
    if has_been(since.few, facts.calm) && there > least {
        let reason = format!("{:.1} concurrent requests are few for {there} servants", facts.requests);
        return (Some(GroupAction::Retire(reason)), LoadSince::default());
    }
    (None, since)
}

/// Chooses which of the places that robots have left (with the time until which each is kept, and its id) are given up:
/// those left first. A place takes no capacity, so nothing else bounds their number, and robots are free to give
/// themselves new names.
pub(crate) fn expired_places(mut left: Vec<(u64, &str)>) -> Vec<&str> {
    left.sort_unstable();
    left.truncate(left.len().saturating_sub(MAX_FORMER_ROBOTS));
    left.into_iter().map(|(_, id)| id).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CALM: Duration = Duration::from_secs(30);
    const LOOKS: Duration = Duration::from_millis(250);

    fn facts(ready: usize, requests: f64) -> GroupFacts {
        GroupFacts { bounds: (1, 4), ready, starting: 0, retiring: 0, requests, time: None, failed: None, calm: CALM }
    }

    /// Returns the decision after the facts have stayed the same for `long`.
    fn action_after(facts: GroupFacts, long: Duration) -> Option<GroupAction> {
        let began = Instant::now();
        let (_, since) = decide_group(&facts, LoadSince::default(), began);
        decide_group(&facts, since, began + long).0
    }

    #[test]
    fn what_makes_a_group_grow_and_shrink() {
        let words = |step: Option<GroupAction>| match step {
            Some(GroupAction::Start(reason)) => format!("start: {reason}"),
            Some(GroupAction::TakeBack(reason)) => format!("take back: {reason}"),
            Some(GroupAction::Retire(reason)) => format!("retire: {reason}"),
            None => String::new(),
        };
        let late = (Duration::from_millis(300), Duration::from_millis(200));
        let now = Instant::now();
        for (facts, long, expected) in [
            (facts(0, 0.0), LOOKS, "start: a robot asks for the service"),
            (GroupFacts { bounds: (2, 4), ..facts(1, 0.0) }, LOOKS, "start: the minimum is 2 servants"),
            (facts(1, 1.4), CALM, ""),
            (facts(1, 2.0), LOOKS, ""),
            (facts(1, 2.0), STEADY, "start: 2.0 concurrent requests are many for 1 servants"),
            (facts(4, 90.0), CALM, ""),
            (
                GroupFacts { time: Some(late), ..facts(2, 2.5) },
                STEADY,
                "start: 2.5 concurrent requests delay each other at 2 servants: they take 300ms instead of 200ms",
            ),
            // Slow, but without queueing: another servant is no faster.
            (GroupFacts { time: Some(late), ..facts(2, 1.5) }, CALM, ""),
            (facts(2, 0.6), STEADY, ""),
            (facts(2, 0.6), CALM, "retire: 0.6 concurrent requests are few for 2 servants"),
            (facts(2, 0.8), CALM, ""),
            (facts(1, 0.0), CALM, ""),
            (GroupFacts { starting: 1, ..facts(1, 9.0) }, CALM, ""),
            // A retiring servant may take for ever: the group grows and shrinks nevertheless.
            (
                GroupFacts { retiring: 1, ..facts(2, 0.0) },
                CALM,
                "retire: 0.0 concurrent requests are few for 2 servants",
            ),
            (
                GroupFacts { retiring: 1, failed: Some(now), ..facts(1, 10.0) },
                STEADY,
                "take back: 10.0 concurrent requests are many for 1 servants",
            ),
            (GroupFacts { retiring: 1, ..facts(0, 0.0) }, LOOKS, "take back: a robot asks for the service"),
            (GroupFacts { failed: Some(now), ..facts(0, 0.0) }, LOOKS, ""),
        ] {
            assert_eq!(words(action_after(facts, long)), expected, "{facts:?}");
        }
    }

    /// Simulates a group with a load per round; servants start at once. Returns how often it grew and shrank.
    fn play(ready: &mut usize, loads: &[f64]) -> (usize, usize) {
        let (mut since, mut now) = (LoadSince::default(), Instant::now());
        let mut steps = (0, 0);
        for load in loads {
            now += LOOKS;
            let (step, next) = decide_group(&facts(*ready, *load), since, now);
            since = next;
            match step {
                Some(GroupAction::Start(_) | GroupAction::TakeBack(_)) => {
                    *ready += 1;
                    steps.0 += 1;
                }
                Some(GroupAction::Retire(_)) => {
                    *ready -= 1;
                    steps.1 += 1;
                }
                None => {}
            }
            assert!((1..=4).contains(ready), "{ready} servants");
        }
        steps
    }

    #[test]
    fn places_that_were_left_first_are_given_up_first() {
        let ids: Vec<String> = (0..MAX_FORMER_ROBOTS + 2).map(|number| format!("s{number}")).collect();
        // Not in the order in which they were left.
        let left = |count: usize| {
            let left = ids.iter().take(count).rev().enumerate();
            left.map(|(until, id)| (until as u64, id.as_str())).collect()
        };
        assert_eq!(expired_places(left(MAX_FORMER_ROBOTS)), Vec::<&str>::new());
        let last = [&*ids[MAX_FORMER_ROBOTS + 1], &*ids[MAX_FORMER_ROBOTS]];
        assert_eq!(expired_places(left(MAX_FORMER_ROBOTS + 2)), last);
    }

    proptest! {
        #[test]
        fn a_load_that_stays_makes_a_group_grow_or_shrink_and_never_both(
            load in 0.0f64..12.0,
            begins in 1usize..5,
        ) {
            let mut ready = begins;
            // Ten minutes.
            let (grown, shrunk) = play(&mut ready, &[load; 2400]);
            prop_assert!(grown == 0 || shrunk == 0, "{grown} and {shrunk}");
            let settled = play(&mut ready, &[load; 2400]);
            prop_assert_eq!(settled, (0, 0));
        }

        #[test]
        fn a_group_shrinks_at_most_once_in_the_time_for_which_it_must_be_calm(
            loads in prop::collection::vec(0.0f64..12.0, 1..2000),
        ) {
            let mut ready = 4;
            let (grown, shrunk) = play(&mut ready, &loads);
            let long = LOOKS * loads.len() as u32;
            prop_assert!(shrunk as u128 <= long.as_millis() / CALM.as_millis());
            prop_assert!(grown <= shrunk + 3);
        }
    }
}
