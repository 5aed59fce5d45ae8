use proptest::prelude::*;

use super::*;

fn tries(all: u64, failed: u64) -> Tries {
    Tries { all, failed }
}

fn seen(servants: Tries, requests: Tries, millis: f64) -> Seen {
    let mut times = Sketch::default();
    for _ in requests.failed..requests.all {
        times.note(millis);
    }
    Seen {
        servants,
        requests,
        times,
    }
}

fn rollout(canary: Option<Share>) -> Rollout {
    Rollout {
        stable: 1,
        candidate: 2,
        state: RolloutState::Canary,
        reason: String::new(),
        started: 1000,
        changed: 1000,
        terms: RolloutTerms {
            canary,
            ..RolloutTerms::default()
        },
        robots: Vec::new(),
        of_stable: Seen::default(),
        of_candidate: Seen::default(),
    }
}

#[test]
fn the_first_robots_get_the_canary_and_keep_it() {
    let mut of = rollout(Some(Share::Robots(2)));
    assert_eq!(given(&of, "s", "r1"), Given::CandidateFromNow);
    of.robots = vec!["r1".into(), "r2".into()];
    assert_eq!(given(&of, "s", "r1"), Given::Candidate);
    assert_eq!(given(&of, "s", "r3"), Given::Current);
    for state in [
        RolloutState::Draining,
        RolloutState::Promoted,
        RolloutState::RolledBack,
        RolloutState::Aborted,
        RolloutState::Replaced,
    ] {
        of.state = state;
        assert_eq!(given(&of, "s", "r1"), Given::Current, "{state}");
    }
}

#[test]
fn a_share_of_the_robots_gets_the_canary() {
    for percent in [1.0, 10.0, 50.0, 99.0] {
        let of = rollout(Some(Share::Percent(percent)));
        let robots = 10_000;
        let hit = (0..robots)
            .filter(|n| given(&of, "s", &format!("robot-{n}")) == Given::Candidate)
            .count();
        let share = 100.0 * hit as f64 / f64::from(robots);
        assert!((share - percent).abs() < 1.5, "{percent}: {share}");
    }
    let all = rollout(Some(Share::Percent(100.0)));
    assert!((0..1000).all(|n| given(&all, "s", &n.to_string()) == Given::Candidate));
}

#[test]
fn a_canary_is_taken_back_when_it_is_worse_and_not_before() {
    let sound = tries(3, 0);
    let stable = seen(sound, tries(100, 0), 50.0);
    let terms = RolloutTerms::default();
    let worse = |candidate: &Seen| worse(&stable, candidate, &terms);
    for (servants, requests, millis, is_worse) in [
        (sound, tries(0, 0), 0.0, None),
        (sound, tries(100, 0), 50.0, None),
        // Within the bound of a tenth.
        (sound, tries(100, 0), 54.0, None),
        (
            sound,
            tries(100, 0),
            60.0,
            Some("median response time is 6"),
        ),
        (sound, tries(19, 0), 500.0, None),
        (sound, tries(20, 0), 500.0, Some("median")),
        (sound, tries(19, 19), 0.0, None),
        (
            sound,
            tries(20, 20),
            0.0,
            Some("100 % of its 20 requests failed"),
        ),
        (sound, tries(100, 5), 50.0, None),
        (
            sound,
            tries(100, 60),
            50.0,
            Some("60 % of its 100 requests failed, of the revision before 0 % of 100"),
        ),
        (tries(2, 2), tries(0, 0), 0.0, None),
        (
            tries(9, 9),
            tries(0, 0),
            0.0,
            Some("100 % of its 9 servants failed"),
        ),
        (tries(20, 1), tries(0, 0), 0.0, None),
    ] {
        let reason = worse(&seen(servants, requests, millis));
        match is_worse {
            None => assert_eq!(reason, None, "{servants:?} {requests:?} {millis}"),
            Some(words) => {
                let reason = reason.unwrap_or_default();
                assert!(reason.contains(words), "{requests:?}: {reason}");
            }
        }
    }
    // As bad as the one before it.
    let failing = seen(tries(9, 9), tries(100, 100), 0.0);
    assert_eq!(super::worse(&failing, &failing, &terms), None);
}

#[test]
fn steps_follow_what_was_seen_and_the_time() {
    let mut of = rollout(Some(Share::Robots(1)));
    assert_eq!(step(&of, 9_999_999), Step::Stays, "nobody promotes it");
    of.terms.promote_after = Some(60.0);
    assert_eq!(step(&of, 61_000), Step::Waits(Wait::Servant));
    of.of_candidate.servants = tries(1, 0);
    of.of_candidate.requests = tries(20, 0);
    assert_eq!(step(&of, 60_999), Step::Stays);
    assert!(matches!(step(&of, 61_000), Step::Promotes(_)));
    of.of_candidate.servants = tries(9, 9);
    assert!(matches!(step(&of, 61_000), Step::RollsBack(_)));
    of.state = RolloutState::Draining;
    of.terms.deadline = Some(10.0);
    assert_eq!(step(&of, 10_999), Step::Stays);
    assert_eq!(step(&of, 11_000), Step::EndsOthers);
    for state in [
        RolloutState::Promoted,
        RolloutState::RolledBack,
        RolloutState::Aborted,
        RolloutState::Replaced,
    ] {
        of.state = state;
        assert_eq!(step(&of, 99_000), Step::Stays, "{state}");
    }
}

#[test]
fn a_canary_is_promoted_once_enough_requests_say_that_it_is_no_worse() {
    let mut of = rollout(Some(Share::Robots(1)));
    of.terms.promote_after = Some(60.0);
    of.of_candidate.servants = tries(1, 0);
    let requests = |seen| Step::Waits(Wait::Requests { seen, needed: 20 });
    let promotes = Step::Promotes("it was not worse within 60 s and 20 requests".to_owned());
    let compares = |failed, seen| {
        Step::Waits(Wait::Comparison {
            failed: tries(20, failed),
            seen,
            needed: 20,
        })
    };
    for (stable, candidate, expected) in [
        (tries(0, 0), tries(0, 0), requests(0)),
        (tries(100, 0), tries(19, 0), requests(19)),
        (tries(100, 0), tries(20, 0), promotes.clone()),
        // All robots are given the canary.
        (tries(0, 0), tries(20, 2), promotes.clone()),
        (tries(0, 0), tries(20, 3), compares(3, 0)),
        (tries(19, 19), tries(20, 20), compares(20, 19)),
        // The stable one fails as often.
        (tries(20, 20), tries(20, 20), promotes.clone()),
    ] {
        of.of_stable = seen(tries(3, 0), stable, 5.0);
        of.of_candidate.requests = candidate;
        assert_eq!(step(&of, 61_000), expected, "{stable:?} {candidate:?}");
    }
    let words = Wait::Comparison {
        failed: tries(20, 3),
        seen: 1,
        needed: 20,
    };
    assert_eq!(
        words.to_string(),
        "3 of its 20 requests failed, and the previous revision was asked 1 times of the 20 that are needed to compare them \
         (--samples)"
    );
    assert!(words.is_like(&Wait::Comparison {
        failed: tries(9, 9),
        seen: 2,
        needed: 20
    }));
    assert!(!words.is_like(&Wait::Servant));
}

#[test]
fn a_rollout_is_read_back_as_it_was_written() {
    let mut of = rollout(Some(Share::Percent(10.0)));
    of.of_stable = seen(tries(2, 1), tries(30, 2), 12.5);
    let text = serde_json::to_string(&of).expect("plain data");
    assert_eq!(
        serde_json::from_str::<Rollout>(&text).expect("a rollout"),
        of
    );
}

/// A fair coin of this chance, from numbers between 0 and 1.
fn flips(chance: f64, draws: &[f64]) -> impl Iterator<Item = bool> {
    draws.iter().map(move |draw| *draw < chance)
}

proptest! {
    #[test]
    fn bounds_hold_what_was_seen_and_narrow(all in 1u64..2000, part in 0.0f64..=1.0) {
        let failed = (all as f64 * part) as u64;
        let share = failed as f64 / all as f64;
        let (low, high) = (lower(tries(all, failed)), upper(tries(all, failed)));
        prop_assert!(0.0 <= low && low <= share && share <= high && high <= 1.0);
        let (more, most) = (tries(all * 4, failed * 4), tries(all * 16, failed * 16));
        prop_assert!(upper(most) - lower(most) <= upper(more) - lower(more) + 1e-9);
        prop_assert!(lower(tries(all, failed)) <= lower(tries(all, (failed + 1).min(all))) + 1e-9);
    }

    #[test]
    fn answers_do_not_change_while_a_rollout_goes_on(robot in "[a-z]{1,9}", percent in 0.1f64..100.0) {
        let mut of = rollout(Some(Share::Percent(percent)));
        let before = given(&of, "s", &robot);
        of.of_candidate.requests = tries(5, 1);
        of.robots.push("another".into());
        prop_assert_eq!(before, given(&of, "s", &robot));
        // A greater share keeps those that a smaller one had.
        of.terms.canary = Some(Share::Percent(100.0_f64.min(percent * 2.0)));
        prop_assert!(before != Given::Candidate || given(&of, "s", &robot) == Given::Candidate);
    }
}

/// Looked at after every request, as the daemon does: how many of the canaries are taken back.
fn taken_back(chances: (f64, f64), runs: u64) -> u64 {
    use proptest::test_runner::{RngAlgorithm, TestRng};
    let mut rng = TestRng::from_seed(RngAlgorithm::ChaCha, &[7; 32]);
    let mut draw = || f64::from(rng.next_u32()) / f64::from(u32::MAX);
    let mut count = 0;
    for _ in 0..runs {
        let (mut stable, mut candidate) = (Seen::default(), Seen::default());
        for _ in 0..400 {
            let draws = [draw(), draw()];
            stable
                .requests
                .note(flips(chances.0, &draws[..1]).all(|it| it));
            candidate
                .requests
                .note(flips(chances.1, &draws[1..]).all(|it| it));
            if worse(
                &stable,
                &candidate,
                &RolloutTerms {
                    bound: 0.05,
                    ..RolloutTerms::default()
                },
            )
            .is_some()
            {
                count += 1;
                break;
            }
        }
    }
    count
}

#[test]
fn looking_after_every_request_takes_back_the_worse_and_no_others() {
    assert_eq!(taken_back((0.2, 0.2), 200), 0, "no worse");
    assert!(taken_back((0.2, 0.24), 200) <= 10, "within the bound");
    assert_eq!(taken_back((0.05, 0.7), 200), 200, "far worse");
}
