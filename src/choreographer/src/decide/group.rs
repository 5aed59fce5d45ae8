//! How many servants answer the robots that share a service.
//!
//! What counts is how many requests there are at a time in the mean, waiting or under way: by Little's law (L = λW) the
//! arrivals times how long each takes, so that both a higher rate and slower answers show in it. A node that answers one call
//! after the other is busy all the time at one.
//!
//! | requests at a time, of `n` servants | for | then |
//! |---|---|---|
//! | more than 1.5 n | a second | one more, up to the most |
//! | more than n, and answers take longer than was promised | a second | one more: they wait for each other |
//! | fewer than 0.7 (n - 1) | `calm` | one fewer, down to the least |
//!
//! One more servant makes the first bound of `n + 1`, and the last one is below half of it, so that a load that stays as it is
//! never makes a group grow and shrink in turns. While a servant starts, nothing else changes. Where one more is wanted and one
//! retires, which may take as long as its last request, that one is taken back. A servant that could not be started is tried
//! again after a pause.

use std::time::{Duration, Instant};

/// Requests for each servant, above which one more is started.
const MANY: f64 = 1.5;
/// The same where answers are late.
const LATE: f64 = 1.0;
/// Requests for each servant but one, below which that one retires.
const FEW: f64 = 0.7;
/// How long there must be many.
const STEADY: Duration = Duration::from_secs(1);
/// After a servant could not be started.
const PAUSE: Duration = Duration::from_secs(5);
/// Places of one group that their robots have left, and that are kept for when these come back.
pub(crate) const LEFT: usize = 256;

/// A group at one moment.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Facts {
    /// Servants at least, and at most.
    pub(crate) bounds: (usize, usize),
    /// Servants that can be asked.
    pub(crate) ready: usize,
    /// Servants that will be.
    pub(crate) starting: usize,
    /// Servants that end what they work at.
    pub(crate) retiring: usize,
    /// Requests at a time, in the mean since the moment before.
    pub(crate) requests: f64,
    /// How long they take in the mean, and how long they may, where that is known.
    pub(crate) time: Option<(Duration, Duration)>,
    /// When a servant could not be started, or was lost before it was ready.
    pub(crate) failed: Option<Instant>,
    /// How long there must be few requests before a servant retires.
    pub(crate) calm: Duration,
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Step {
    /// One more servant, for this reason.
    Start(String),
    /// The one that retires is asked again, for this reason.
    TakeBack(String),
    /// One retires, for this reason.
    Retire(String),
}

/// Since when it has been so.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Since {
    many: Option<Instant>,
    few: Option<Instant>,
}

/// What is to be done now, and since when there have been many or few requests, to be given back the next time.
pub(crate) fn look(facts: &Facts, since: Since, now: Instant) -> (Option<Step>, Since) {
    let (least, most) = facts.bounds;
    let (least, most) = (least.max(1), most.max(least).max(1));
    let there = facts.ready + facts.starting;
    let rests = facts.failed.is_some_and(|failed| now < failed + PAUSE);
    let one_more = |reason: String| match facts.retiring {
        0 => (!rests).then_some(Step::Start(reason)),
        _ => Some(Step::TakeBack(reason)),
    };
    if there < least {
        // The first servants are started at once, all of them.
        let reason = match there {
            0 => "a robot asks for the service".to_owned(),
            _ => format!("{least} servants are wanted at least"),
        };
        return (one_more(reason), Since::default());
    }
    if facts.starting > 0 {
        return (None, Since::default());
    }
    let servants = facts.ready as f64;
    let late = facts
        .time
        .filter(|(takes, may)| takes > may && facts.requests > LATE * servants);
    let many = facts.requests > MANY * servants || late.is_some();
    let few = facts.requests < FEW * (servants - 1.0);
    let since = Since {
        many: many.then(|| since.many.unwrap_or(now)),
        few: few.then(|| since.few.unwrap_or(now)),
    };
    let has_been =
        |since: Option<Instant>, long: Duration| since.is_some_and(|at| now >= at + long);
    if has_been(since.many, STEADY) && there < most && (facts.retiring > 0 || !rests) {
        let requests = facts.requests;
        let reason = match late {
            Some((takes, may)) => format!(
                "{requests:.1} requests at a time wait for each other at {there} servants: they take {takes:.0?} instead of {may:.0?}"
            ),
            None => format!("{requests:.1} requests at a time are many for {there} servants"),
        };
        return (one_more(reason), Since::default());
    }
    if has_been(since.few, facts.calm) && there > least {
        let reason = format!(
            "{:.1} requests at a time are few for {there} servants",
            facts.requests
        );
        return (Some(Step::Retire(reason)), Since::default());
    }
    (None, since)
}

/// Which of the places that robots have left (until when each is kept, and its id) are given up: those that were left first. A
/// place takes no capacity, so that nothing else bounds how many there are, and robots are free to give themselves new names.
pub(crate) fn given_up(mut left: Vec<(u64, &str)>) -> Vec<&str> {
    left.sort_unstable();
    left.truncate(left.len().saturating_sub(LEFT));
    left.into_iter().map(|(_, id)| id).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CALM: Duration = Duration::from_secs(30);
    const LOOKS: Duration = Duration::from_millis(250);

    fn facts(ready: usize, requests: f64) -> Facts {
        Facts {
            bounds: (1, 4),
            ready,
            starting: 0,
            retiring: 0,
            requests,
            time: None,
            failed: None,
            calm: CALM,
        }
    }

    /// What happens when it stays so for `long`.
    fn after(facts: Facts, long: Duration) -> Option<Step> {
        let began = Instant::now();
        let (_, since) = look(&facts, Since::default(), began);
        look(&facts, since, began + long).0
    }

    #[test]
    fn what_makes_a_group_grow_and_shrink() {
        let words = |step: Option<Step>| match step {
            Some(Step::Start(reason)) => format!("start: {reason}"),
            Some(Step::TakeBack(reason)) => format!("take back: {reason}"),
            Some(Step::Retire(reason)) => format!("retire: {reason}"),
            None => String::new(),
        };
        let late = (Duration::from_millis(300), Duration::from_millis(200));
        let now = Instant::now();
        for (facts, long, expected) in [
            (facts(0, 0.0), LOOKS, "start: a robot asks for the service"),
            (
                Facts {
                    bounds: (2, 4),
                    ..facts(1, 0.0)
                },
                LOOKS,
                "start: 2 servants are wanted at least",
            ),
            (facts(1, 1.4), CALM, ""),
            (facts(1, 2.0), LOOKS, ""),
            (
                facts(1, 2.0),
                STEADY,
                "start: 2.0 requests at a time are many for 1 servants",
            ),
            (facts(4, 90.0), CALM, ""),
            (
                Facts {
                    time: Some(late),
                    ..facts(2, 2.5)
                },
                STEADY,
                "start: 2.5 requests at a time wait for each other at 2 servants: they take 300ms instead of 200ms",
            ),
            // Slow, but nobody waits for anybody: another servant is no faster.
            (
                Facts {
                    time: Some(late),
                    ..facts(2, 1.5)
                },
                CALM,
                "",
            ),
            (facts(2, 0.6), STEADY, ""),
            (
                facts(2, 0.6),
                CALM,
                "retire: 0.6 requests at a time are few for 2 servants",
            ),
            (facts(2, 0.8), CALM, ""),
            (facts(1, 0.0), CALM, ""),
            (
                Facts {
                    starting: 1,
                    ..facts(1, 9.0)
                },
                CALM,
                "",
            ),
            // One that retires may take for ever: the group grows and shrinks all the same.
            (
                Facts {
                    retiring: 1,
                    ..facts(2, 0.0)
                },
                CALM,
                "retire: 0.0 requests at a time are few for 2 servants",
            ),
            (
                Facts {
                    retiring: 1,
                    failed: Some(now),
                    ..facts(1, 10.0)
                },
                STEADY,
                "take back: 10.0 requests at a time are many for 1 servants",
            ),
            (
                Facts {
                    retiring: 1,
                    ..facts(0, 0.0)
                },
                LOOKS,
                "take back: a robot asks for the service",
            ),
            (
                Facts {
                    failed: Some(now),
                    ..facts(0, 0.0)
                },
                LOOKS,
                "",
            ),
        ] {
            assert_eq!(words(after(facts, long)), expected, "{facts:?}");
        }
    }

    /// Plays a group for as many looks as there are loads; servants start at once. How often it grew and shrank.
    fn play(ready: &mut usize, loads: &[f64]) -> (usize, usize) {
        let (mut since, mut now) = (Since::default(), Instant::now());
        let mut steps = (0, 0);
        for load in loads {
            now += LOOKS;
            let (step, next) = look(&facts(*ready, *load), since, now);
            since = next;
            match step {
                Some(Step::Start(_) | Step::TakeBack(_)) => {
                    *ready += 1;
                    steps.0 += 1;
                }
                Some(Step::Retire(_)) => {
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
        let ids: Vec<String> = (0..LEFT + 2).map(|number| format!("s{number}")).collect();
        // Not in the order in which they were left.
        let left = |count: usize| {
            let left = ids.iter().take(count).rev().enumerate();
            left.map(|(until, id)| (until as u64, id.as_str()))
                .collect()
        };
        assert_eq!(given_up(left(LEFT)), Vec::<&str>::new());
        let last = [&*ids[LEFT + 1], &*ids[LEFT]];
        assert_eq!(given_up(left(LEFT + 2)), last);
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
