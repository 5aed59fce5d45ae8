use proptest::prelude::*;

use super::*;

fn attempts(all: u64, failed: u64) -> AttemptCounts {
    AttemptCounts { all, failed }
}

fn stats(servants: AttemptCounts, requests: AttemptCounts, millis: f64) -> RevisionStats {
    let mut times = Sketch::default();
    for _ in requests.failed..requests.all {
        times.record(millis);
    }
    RevisionStats { servants, requests, times }
}

fn rollout(canary: Option<Share>) -> Rollout {
    Rollout {
        stable: 1,
        candidate: 2,
        state: RolloutState::Canary,
        reason: String::new(),
        started: 1000,
        changed: 1000,
        terms: RolloutTerms { canary, ..RolloutTerms::default() },
        robots: Vec::new(),
        of_stable: RevisionStats::default(),
        of_candidate: RevisionStats::default(),
    }
}

#[test]
fn the_first_robots_get_the_canary_and_keep_it() {
    let mut of = rollout(Some(Share::Robots(2)));
    assert_eq!(assign_revision(&of, "s", "r1"), AssignedRevision::CandidateFromNow);
    of.robots = vec!["r1".into(), "r2".into()];
    assert_eq!(assign_revision(&of, "s", "r1"), AssignedRevision::Candidate);
    assert_eq!(assign_revision(&of, "s", "r3"), AssignedRevision::Current);
    for state in [
        RolloutState::Draining,
        RolloutState::Promoted,
        RolloutState::RolledBack,
        RolloutState::Aborted,
        RolloutState::Replaced,
    ] {
        of.state = state;
        assert_eq!(assign_revision(&of, "s", "r1"), AssignedRevision::Current, "{state}");
    }
}

#[test]
fn a_share_of_the_robots_gets_the_canary() {
    for percent in [1.0, 10.0, 50.0, 99.0] {
        let of = rollout(Some(Share::Percent(percent)));
        let robots = 10_000;
        let hit = (0..robots)
            .filter(|n| assign_revision(&of, "s", &format!("robot-{n}")) == AssignedRevision::Candidate)
            .count();
        let share = 100.0 * hit as f64 / f64::from(robots);
        assert!((share - percent).abs() < 1.5, "{percent}: {share}");
    }
    let all = rollout(Some(Share::Percent(100.0)));
    assert!((0..1000).all(|n| assign_revision(&all, "s", &n.to_string()) == AssignedRevision::Candidate));
}

#[test]
fn a_canary_is_taken_back_when_it_is_worse_and_not_before() {
    let sound = attempts(3, 0);
    let stable = stats(sound, attempts(100, 0), 50.0);
    let terms = RolloutTerms::default();
    let worse = |candidate: &RevisionStats| regression(&stable, candidate, &terms);
    for (servants, requests, millis, is_worse) in [
        (sound, attempts(0, 0), 0.0, None),
        (sound, attempts(100, 0), 50.0, None),
        // Within the bound of a tenth.
        (sound, attempts(100, 0), 54.0, None),
        (sound, attempts(100, 0), 60.0, Some("p50 response time is 6")),
        (sound, attempts(19, 0), 500.0, None),
        (sound, attempts(20, 0), 500.0, Some("p50")),
        (sound, attempts(19, 19), 0.0, None),
        (sound, attempts(20, 20), 0.0, Some("100 % of its 20 requests failed")),
        (sound, attempts(100, 5), 50.0, None),
        (sound, attempts(100, 60), 50.0, Some("60 % of its 100 requests failed; previous revision: 0 % of 100")),
        (attempts(2, 2), attempts(0, 0), 0.0, None),
        (attempts(9, 9), attempts(0, 0), 0.0, Some("100 % of its 9 servants failed")),
        (attempts(20, 1), attempts(0, 0), 0.0, None),
    ] {
        let reason = worse(&stats(servants, requests, millis));
        match is_worse {
            None => assert_eq!(reason, None, "{servants:?} {requests:?} {millis}"),
            Some(words) => {
                let reason = reason.unwrap_or_default();
                assert!(reason.contains(words), "{requests:?}: {reason}");
            }
        }
    }
    // As bad as the one before.
    let failing = stats(attempts(9, 9), attempts(100, 100), 0.0);
    assert_eq!(super::regression(&failing, &failing, &terms), None);
}

#[test]
fn steps_follow_what_was_seen_and_the_time() {
    let mut of = rollout(Some(Share::Robots(1)));
    assert_eq!(next_step(&of, 9_999_999), RolloutStep::Stays, "nobody promotes it");
    of.terms.promote_after = Some(60.0);
    assert_eq!(next_step(&of, 61_000), RolloutStep::Waits(PromotionBlocker::Servant));
    of.of_candidate.servants = attempts(1, 0);
    of.of_candidate.requests = attempts(20, 0);
    assert_eq!(next_step(&of, 60_999), RolloutStep::Stays);
    assert!(matches!(next_step(&of, 61_000), RolloutStep::Promotes(_)));
    of.of_candidate.servants = attempts(9, 9);
    assert!(matches!(next_step(&of, 61_000), RolloutStep::RollsBack(_)));
    of.state = RolloutState::Draining;
    of.terms.deadline = Some(10.0);
    assert_eq!(next_step(&of, 10_999), RolloutStep::Stays);
    assert_eq!(next_step(&of, 11_000), RolloutStep::EndsOthers);
    for state in [RolloutState::Promoted, RolloutState::RolledBack, RolloutState::Aborted, RolloutState::Replaced] {
        of.state = state;
        assert_eq!(next_step(&of, 99_000), RolloutStep::Stays, "{state}");
    }
}

#[test]
fn a_canary_is_promoted_once_enough_requests_say_that_it_is_no_worse() {
    let mut of = rollout(Some(Share::Robots(1)));
    of.terms.promote_after = Some(60.0);
    of.of_candidate.servants = attempts(1, 0);
    let requests = |seen| RolloutStep::Waits(PromotionBlocker::Requests { seen, needed: 20 });
    let promotes = RolloutStep::Promotes("it was not worse within 60 s and 20 requests".to_owned());
    let compares = |failed, seen| {
        RolloutStep::Waits(PromotionBlocker::Comparison { failed: attempts(20, failed), seen, needed: 20 })
    };
    for (stable, candidate, expected) in [
        (attempts(0, 0), attempts(0, 0), requests(0)),
        (attempts(100, 0), attempts(19, 0), requests(19)),
        (attempts(100, 0), attempts(20, 0), promotes.clone()),
        // All robots are given the canary.
        (attempts(0, 0), attempts(20, 2), promotes.clone()),
        (attempts(0, 0), attempts(20, 3), compares(3, 0)),
        (attempts(19, 19), attempts(20, 20), compares(20, 19)),
        // The stable one fails as often.
        (attempts(20, 20), attempts(20, 20), promotes.clone()),
    ] {
        of.of_stable = stats(attempts(3, 0), stable, 5.0);
        of.of_candidate.requests = candidate;
        assert_eq!(next_step(&of, 61_000), expected, "{stable:?} {candidate:?}");
    }
    let words = PromotionBlocker::Comparison { failed: attempts(20, 3), seen: 1, needed: 20 };
    assert_eq!(
        words.to_string(),
        "3 of its 20 requests failed, but the previous revision has had 1 requests of the 20 required for a comparison \
            (--samples)"
    );
    assert!(words.is_same_kind(&PromotionBlocker::Comparison { failed: attempts(9, 9), seen: 2, needed: 20 }));
    assert!(!words.is_same_kind(&PromotionBlocker::Servant));
}

#[test]
fn a_rollout_is_read_back_as_it_was_written() {
    let mut of = rollout(Some(Share::Percent(10.0)));
    of.of_stable = stats(attempts(2, 1), attempts(30, 2), 12.5);
    let text = serde_json::to_string(&of).expect("plain data");
    assert_eq!(serde_json::from_str::<Rollout>(&text).expect("a rollout"), of);
}

/// Returns random events of this probability, from numbers between 0 and 1.
fn flips(chance: f64, draws: &[f64]) -> impl Iterator<Item = bool> {
    draws.iter().map(move |draw| *draw < chance)
}

proptest! {
    #[test]
    fn bounds_hold_what_was_seen_and_narrow(all in 1u64..2000, part in 0.0f64..=1.0) {
        let failed = (all as f64 * part) as u64;
        let share = failed as f64 / all as f64;
        let (low, high) = (lower_bound(attempts(all, failed)), upper_bound(attempts(all, failed)));
        prop_assert!(0.0 <= low && low <= share && share <= high && high <= 1.0);
        let (more, most) = (attempts(all * 4, failed * 4), attempts(all * 16, failed * 16));
        prop_assert!(upper_bound(most) - lower_bound(most) <= upper_bound(more) - lower_bound(more) + 1e-9);
        prop_assert!(lower_bound(attempts(all, failed)) <= lower_bound(attempts(all, (failed + 1).min(all))) + 1e-9);
    }

    #[test]
    fn answers_do_not_change_while_a_rollout_goes_on(robot in "[a-z]{1,9}", percent in 0.1f64..100.0) {
        let mut of = rollout(Some(Share::Percent(percent)));
        let before = assign_revision(&of, "s", &robot);
        of.of_candidate.requests = attempts(5, 1);
        of.robots.push("another".into());
        prop_assert_eq!(before, assign_revision(&of, "s", &robot));
        // A larger share keeps the robots of a smaller one.
        of.terms.canary = Some(Share::Percent(100.0_f64.min(percent * 2.0)));
        prop_assert!(before != AssignedRevision::Candidate || assign_revision(&of, "s",
            &robot) == AssignedRevision::Candidate);
    }
}

/// Evaluates after every request, as the daemon does; returns how many of the canaries are rolled back.
fn count_rollbacks(chances: (f64, f64), runs: u64) -> u64 {
    use proptest::test_runner::{RngAlgorithm, TestRng};
    let mut rng = TestRng::from_seed(RngAlgorithm::ChaCha, &[7; 32]);
    let mut draw = || f64::from(rng.next_u32()) / f64::from(u32::MAX);
    let mut count = 0;
    for _ in 0..runs {
        let (mut stable, mut candidate) = (RevisionStats::default(), RevisionStats::default());
        for _ in 0..400 {
            let draws = [draw(), draw()];
            stable.requests.record(flips(chances.0, &draws[..1]).all(|it| it));
            candidate.requests.record(flips(chances.1, &draws[1..]).all(|it| it));
            if regression(&stable, &candidate, &RolloutTerms { bound: 0.05, ..RolloutTerms::default() }).is_some() {
                count += 1;
                break;
            }
        }
    }
    count
}

#[test]
fn looking_after_every_request_takes_back_the_worse_and_no_others() {
    assert_eq!(count_rollbacks((0.2, 0.2), 200), 0, "no worse");
    assert!(count_rollbacks((0.2, 0.24), 200) <= 10, "within the bound");
    assert_eq!(count_rollbacks((0.05, 0.7), 200), 200, "far worse");
}
