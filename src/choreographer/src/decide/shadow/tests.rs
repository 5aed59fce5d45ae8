use proptest::prelude::*;
use serde_json::json;

use super::*;

fn tolerance(ignore: &[&str]) -> Tolerance {
    Tolerance { number: 1e-3, ignore: ignore.iter().map(|field| (*field).to_owned()).collect() }
}

#[test]
fn fields_that_differ_are_named_and_tolerated_ones_are_not() {
    let header = |seq: u32, frame: &str| json!({"seq": seq, "stamp": {"secs": seq, "nsecs": 0}, "frame_id": frame});
    // The header of ROS 2.
    let header_2 = |sec: u32, frame: &str| json!({"stamp": {"sec": sec, "nanosec": 5}, "frame_id": frame});
    for (present, candidate, ignore, fields) in [
        (json!({"sum": 3}), json!({"sum": 3}), &[][..], &[][..]),
        (json!({"sum": 3}), json!({"sum": 4}), &[], &["sum"]),
        (json!({"sum": 3}), json!({"sum": 4}), &["sum"], &[]),
        // Within the tolerance, relative to one and to the number itself.
        (json!({"x": 0.0}), json!({"x": 0.0009}), &[], &[]),
        (json!({"x": 5000.0}), json!({"x": 5004.0}), &[], &[]),
        (json!({"x": 5000.0}), json!({"x": 5006.0}), &[], &["x"]),
        (json!({"x": "NaN"}), json!({"x": "NaN"}), &[], &[]),
        (json!({"x": "NaN"}), json!({"x": 1.0}), &[], &["x"]),
        // The time of publication is no difference, the frame is one.
        (json!({"header": header(1, "map")}), json!({"header": header(7, "map")}), &[], &[]),
        (json!({"header": header(1, "map")}), json!({"header": header(1, "odom")}), &[], &["header.frame_id"]),
        (json!({"header": header_2(1, "map"), "x": 1}), json!({"header": header_2(7, "map"), "x": 1}), &[], &[]),
        (header_2(1, "map"), header_2(7, "map"), &[], &[]),
        (json!({"header": header_2(1, "map")}), json!({"header": header_2(1, "odom")}), &[], &["header.frame_id"]),
        // Something else with that name belongs to the answer.
        (json!({"stamp": 1, "frame_id": "map"}), json!({"stamp": 7, "frame_id": "map"}), &[], &["stamp"]),
        (
            json!({"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "map", "mark": 1}),
            json!({"stamp": {"sec": 7, "nanosec": 5}, "frame_id": "map", "mark": 1}),
            &[],
            &["stamp.sec"],
        ),
        (
            json!({"all": [{"x": 1, "y": 2}, {"x": 3, "y": 4}]}),
            json!({"all": [{"x": 1, "y": 9}, {"x": 9, "y": 9}]}),
            &["all[].x"],
            &["all[].y", "all[].y"],
        ),
        (json!({"all": [1]}), json!({"all": []}), &[], &["all"]),
        (
            json!({"pose": {"covariance": [1, 2], "x": 1}}),
            json!({"pose": {"covariance": [3, 4], "x": 1}}),
            &["pose.covariance"],
            &[],
        ),
    ] {
        let found = differences(&present, &candidate, &tolerance(ignore));
        let named: Vec<&str> = found.iter().map(|one| one.field.as_str()).collect();
        assert_eq!(named, fields, "{present} {candidate}");
    }
    let found = differences(&json!({"data": "x".repeat(200)}), &json!({"data": i64::MAX}), &tolerance(&[]));
    assert!(found[0].present.ends_with("… (202 characters)"), "{found:?}");
    // Adjacent, and equal as doubles: large integers have no larger tolerance.
    let one = json!({"id": u64::MAX});
    let other = json!({"id": u64::MAX - 1});
    assert_eq!(differences(&one, &one, &tolerance(&[])), []);
    assert_eq!(differences(&one, &other, &tolerance(&[])).len(), 1);
    let wide = Tolerance { number: 1.0, ignore: Vec::new() };
    assert_eq!(differences(&one, &other, &wide), []);
}

/// Pairs the sequences and returns a short form: `=` equal, `~` different, `-` missing, `+` surplus, `.` at the edge.
fn pair_in_short(present: &[u32], candidate: &[u32], last: bool) -> String {
    let mut pairing = Pairing::default();
    for one in present {
        pairing.push(ShadowSide::Present, *one);
    }
    for one in candidate {
        pairing.push(ShadowSide::Candidate, *one);
    }
    let settled = pairing.settle(last, |one, other| one == other);
    settled.iter().map(in_short).collect()
}

fn in_short(paired: &PairingResult<u32>) -> char {
    match paired {
        PairingResult::Both(one, other, equal) => {
            assert_eq!(one == other, *equal, "{one} {other}");
            if *equal { '=' } else { '~' }
        }
        PairingResult::Missing(_) => '-',
        PairingResult::Surplus(_) => '+',
        PairingResult::Edge => '.',
    }
}

#[test]
fn sequences_go_on_alike_after_what_was_lost_or_differs() {
    for (present, candidate, expected) in [
        (&[1, 2, 3][..], &[1, 2, 3][..], "==="),
        (&[1, 2, 3, 4], &[1, 3, 4], "=-=="),
        (&[1, 2, 3], &[1, 9, 2, 3], "=+=="),
        (&[1, 2, 3], &[1, 9, 3], "=~="),
        (&[1, 2, 3, 4], &[9, 9, 9, 9], "~~~~"),
        // Still in flight, or lost for good.
        (&[1, 2, 3], &[1, 2], "==."),
        (&[1, 2, 3, 4, 5], &[1, 2], "==---"),
        (&[1, 2], &[], "--"),
        (&[], &[1, 2], "++"),
    ] {
        assert_eq!(pair_in_short(present, candidate, true), expected, "{present:?} {candidate:?}");
    }
    // Not before it is known how both continue.
    assert_eq!(pair_in_short(&[1, 2, 3], &[1, 3], false), "=");
}

proptest! {
    #[test]
    fn one_lost_message_is_one_missing_message(count in 2usize..40, lost in any::<prop::sample::Index>()) {
        let present: Vec<u32> = (0..count as u32).collect();
        let mut candidate = present.clone();
        let lost = lost.index(count - 1);
        candidate.remove(lost);
        let mut expected = "=".repeat(count);
        let how = if lost + 1 == count { "." } else { "-" };
        expected.replace_range(lost..=lost, how);
        prop_assert_eq!(pair_in_short(&present, &candidate, true), expected);
    }

    #[test]
    fn every_message_is_accounted_for_once_whenever_it_is_settled(
        messages in proptest::collection::vec((any::<bool>(), 0u32..4, any::<bool>()), 0..80),
    ) {
        let mut pairing = Pairing::default();
        let mut settled = Vec::new();
        let mut pushed = [0, 0];
        for (present, message, settles) in messages {
            let side = if present { ShadowSide::Present } else { ShadowSide::Candidate };
            pairing.push(side, message);
            pushed[usize::from(present)] += 1;
            if settles {
                settled.extend(pairing.settle(false, |one, other| one == other));
            }
        }
        settled.extend(pairing.settle(true, |one, other| one == other));
        let count: usize = settled.iter().map(|one| match one {
            PairingResult::Both(..) => 2,
            _ => 1,
        }).sum();
        prop_assert!(pairing.is_even());
        prop_assert_eq!(count, pushed[0] + pushed[1]);
    }
}

fn row(equal: u64, different: u64, present: f64, candidate: f64) -> Compared {
    let spread = |time| Some(TimeSpread { p50: time, p95: time, max: time });
    Compared {
        name: "/sum".into(),
        equal,
        different,
        present: spread(present),
        candidate: spread(candidate),
        ..Compared::default()
    }
}

#[test]
fn a_verdict_names_the_worst_that_was_found() {
    for (rows, failed, expected, words) in [
        (vec![], None, Verdict::Nothing, "no answers to compare"),
        (vec![row(20, 0, 10.0, 10.9)], None, Verdict::Equal, "20 answers"),
        (vec![row(20, 0, 10.0, 13.0)], None, Verdict::Slower, "/sum takes 13.0 ms instead of 10.0 ms"),
        // A hop, or too few to judge.
        (vec![row(20, 0, 0.1, 1.0)], None, Verdict::Equal, "20"),
        (vec![row(3, 0, 10.0, 99.0)], None, Verdict::Equal, "3"),
        (vec![row(20, 1, 10.0, 99.0)], None, Verdict::Different, "1 of 21 answers differ: /sum"),
        (vec![row(20, 1, 1.0, 1.0)], Some("ended: killed"), Verdict::Failed, "the candidate ended: killed"),
    ] {
        let (verdict, why) = overall_verdict(&rows, failed, 0.1);
        assert_eq!(verdict, expected, "{rows:?}");
        assert!(why.contains(words), "{why}");
    }
}

#[test]
fn elements_that_differ_count_once_in_each_answer() {
    let mut tally = Tally::new(Kind::Service, "/sum");
    let differing =
        |value: &str| DifferingField { field: "all[].x".into(), present: value.into(), candidate: "9".into() };
    tally.record_pair(vec![differing("1"), differing("2")]);
    tally.record_pair(vec![differing("3")]);
    tally.record_pair(Vec::new());
    tally.record_missing();
    tally.record_surplus();
    tally.record_time(ShadowSide::Present, 2.0);
    let row = tally.into_compared();
    assert_eq!((row.equal, row.different, row.answers()), (1, 2, 5));
    assert_eq!((row.missing, row.surplus), (1, 1));
    assert_eq!(row.fields.len(), 1);
    assert_eq!((row.fields[0].answers, &*row.fields[0].present), (2, "1"));
    assert_eq!((row.present.is_some(), row.candidate), (true, None));
}
