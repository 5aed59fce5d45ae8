//! Decides at which limits a service is measured, when to stop, and which dictionary rows follow.

use std::collections::BTreeMap;

use api::calibration::{Point, TimeSpread, round_up_to_two_digits};
use api::dictionary::{Row, Spread};
use api::{Limits, Measure, Size};

/// Smallest limit of a ladder, in thousandths of a core.
const SMALLEST: u64 = 100;
/// Factor between consecutive limits of a ladder.
const STEP: f64 = 1.5;
/// Times below this fraction of the best so far count as better; anything above may be chance.
const BETTER: f64 = 0.9;
/// Number of limits in a row without improvement after which the ladder ends.
const PATIENCE: usize = 2;
/// Minimum number of answers for a meaningful 95th percentile.
pub(crate) const FEWEST: usize = 10;
/// Minimum fraction of the requests that must be answered, and of the recording's pace that must be kept.
const MIN_ANSWERED_SHARE: f64 = 0.95;
/// Margin of the proposed memory above the peak, in percent; the peak is only sampled.
pub(crate) const MARGIN: u64 = 25;
/// Minimum margin, in bytes.
const LEAST_MARGIN: u64 = 16 << 20;

/// Returns the limits to measure at, in cores, fewest first: a geometric ladder that ends with `most`, in thousandths
/// of a core.
pub(crate) fn limit_ladder(most: u64) -> Vec<f64> {
    let mut rungs = Vec::new();
    let mut rung = SMALLEST as f64;
    // A rung just below the last would add nothing.
    while rung * (1.0 + STEP) / 2.0 < most as f64 {
        rungs.push((rung / 10.0).round() / 100.0);
        rung *= STEP;
    }
    rungs.push(most as f64 / 1000.0);
    rungs
}

/// The next step of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum NextMeasurement {
    /// Measure at this limit, in cores.
    Measure(f64),
    /// Stop measuring, for this reason.
    Enough(String),
}

/// Returns the next step after the `measured` points, which are in the ladder's order. Limits that were `named`
/// explicitly are all measured.
pub(crate) fn next_measurement(ladder: &[f64], named: bool, measured: &[Point]) -> NextMeasurement {
    let Some(limit) = ladder.get(measured.len()) else {
        let last = ladder.last().copied().unwrap_or_default();
        return NextMeasurement::Enough(if named {
            "all given limits are measured".to_owned()
        } else {
            format!("{last} cores are all that is available on this machine now")
        });
    };
    match elbow(measured) {
        Some(elbow) if !named => {
            NextMeasurement::Enough(format!("it does not get faster with more than {elbow} cores"))
        }
        _ => NextMeasurement::Measure(*limit),
    }
}

/// Returns the limit after which [`PATIENCE`] others brought no improvement.
fn elbow(measured: &[Point]) -> Option<f64> {
    let mut best: Option<(f64, TimeSpread)> = None;
    let mut idle = 0;
    for point in measured {
        let Some(spread) = point.compute.filter(|_| has_enough_answers(point)) else {
            continue;
        };
        match &mut best {
            Some((_, best)) if !is_better(&spread, best) => idle += 1,
            _ => {
                best = Some((point.cpus, spread));
                idle = 0;
            }
        }
    }
    best.filter(|_| idle >= PATIENCE).map(|(cpus, _)| cpus)
}

fn is_better(new: &TimeSpread, best: &TimeSpread) -> bool {
    new.p50 < best.p50 * BETTER || new.p95 < best.p95 * BETTER
}

/// Returns true if enough of the point's requests were answered.
fn has_enough_answers(point: &Point) -> bool {
    point.answered >= FEWEST && point.answered as f64 >= point.requests as f64 * MIN_ANSWERED_SHARE
}

/// Returns the rows that follow from the measurements, fewest cores first. Each is faster than all cheaper ones. Limits
/// at which requests were left unanswered or the recording's `pace` (requests per second) was not kept are skipped:
/// requests would queue without bound there.
pub(crate) fn propose_rows(
    points: &[Point],
    pace: Option<f64>,
    network: TimeSpread,
    memory: Size,
    aux: &BTreeMap<String, String>,
) -> Vec<Row> {
    let mut usable: Vec<(&Point, TimeSpread)> = points
        .iter()
        .filter(|point| has_enough_answers(point) && keeps_pace(point, pace))
        .filter_map(|point| Some((point, point.compute?)))
        .collect();
    usable.sort_by(|(one, _), (other, _)| one.cpus.total_cmp(&other.cpus));
    let mut best = f64::INFINITY;
    let mut rows = Vec::new();
    for (point, compute) in usable {
        let p95 = compute.p95 + network.p95;
        if p95 >= best * BETTER {
            continue;
        }
        best = p95;
        rows.push(Row {
            id: 0,
            measure: Measure::Rrt,
            value: round_up_to_two_digits(p95) / 1000.0,
            aux: aux.clone(),
            limits: Limits { cpus: Some(point.cpus), memory: Some(memory), ..Limits::default() },
            spread: Some(Spread {
                p50: (compute.p50 + network.p50) / 1000.0,
                p95: p95 / 1000.0,
                requests: point.answered as u64,
            }),
            revision: None,
            written: 0,
        });
    }
    rows
}

fn keeps_pace(point: &Point, pace: Option<f64>) -> bool {
    pace.is_none_or(|pace| point.rate >= pace * MIN_ANSWERED_SHARE)
}

/// Returns the memory for a servant with this peak: [`MARGIN`] percent more, in whole MiB.
pub(crate) fn with_margin(peak: Size) -> Size {
    let margin = (peak.0 / 100 * MARGIN).max(LEAST_MARGIN);
    Size((peak.0 + margin).next_multiple_of(1 << 20))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn point(cpus: f64, p50: f64, p95: f64) -> Point {
        Point {
            cpus,
            requests: 40,
            answered: 40,
            compute: Some(TimeSpread { p50, p95, max: p95 * 2.0 }),
            rate: 10.0,
            ..Point::default()
        }
    }

    #[test]
    fn ladders_grow_by_half_and_end_with_all_that_can_be_promised() {
        for (most, rungs) in [
            (2000, &[0.1, 0.15, 0.23, 0.34, 0.51, 0.76, 1.14, 2.0][..]),
            (800, &[0.1, 0.15, 0.23, 0.34, 0.51, 0.8]),
            (120, &[0.12]),
            (130, &[0.1, 0.13]),
            (50, &[0.05]),
        ] {
            assert_eq!(limit_ladder(most), rungs, "{most}");
        }
    }

    #[test]
    fn a_ladder_ends_behind_its_elbow() {
        let rungs = limit_ladder(4000);
        let mut measured = Vec::new();
        // A single-threaded program that needs 100 ms: no faster than on one core.
        let ended = loop {
            match next_measurement(&rungs, false, &measured) {
                NextMeasurement::Measure(cpus) => {
                    let time = 100.0 / f64::min(cpus, 1.0);
                    measured.push(point(cpus, time, time * 1.1));
                }
                NextMeasurement::Enough(why) => break why,
            }
        };
        assert_eq!(ended, "it does not get faster with more than 1.14 cores");
        assert_eq!(measured.last().map(|point| point.cpus), Some(2.56));
        // Explicitly named limits are all measured.
        assert_eq!(next_measurement(&rungs, true, &measured), NextMeasurement::Measure(4.0));
        assert_eq!(
            next_measurement(&[1.0], false, &[point(1.0, 5.0, 6.0)]),
            NextMeasurement::Enough("1 cores are all that is available on this machine now".into())
        );
    }

    #[test]
    fn limits_at_which_nothing_is_answered_are_no_elbow() {
        let rungs = limit_ladder(4000);
        let dead = Point { requests: 3, ..Point::default() };
        let measured = [dead, dead, dead, dead];
        assert_eq!(next_measurement(&rungs, false, &measured), NextMeasurement::Measure(rungs[4]));
    }

    #[test]
    fn rows_are_proposed_where_more_is_faster_and_nothing_queues() {
        let slow = Point { rate: 5.0, ..point(0.1, 190.0, 200.0) };
        let silent = Point { answered: 30, ..point(0.2, 90.0, 100.0) };
        let points = [
            slow,
            silent,
            point(0.4, 70.0, 80.0),
            // By chance.
            point(0.6, 69.0, 79.0),
            point(0.8, 40.0, 41.2),
            point(1.2, 40.0, 60.0),
        ];
        let network = TimeSpread { p50: 5.0, p95: 20.0, max: 90.0 };
        let aux = BTreeMap::from([("width".to_owned(), "640".to_owned())]);
        let rows = propose_rows(&points, Some(10.0), network, Size(7), &aux);
        let told: Vec<_> = rows
            .iter()
            .map(|row| {
                let spread = row.spread.expect("measured");
                let micros = |seconds: f64| (seconds * 1e6).round() as u64;
                let times = [row.value, spread.p50, spread.p95].map(micros);
                (row.limits.cpus, times)
            })
            .collect();
        let expected = [(Some(0.4), [100_000, 75_000, 100_000]), (Some(0.8), [62_000, 45_000, 61_200])];
        assert_eq!(told, expected);
        let row = &rows[0];
        assert_eq!((row.measure, &row.aux), (Measure::Rrt, &aux));
        assert_eq!(row.limits.memory, Some(Size(7)));
        assert_eq!(row.spread.map(|spread| spread.requests), Some(40));
        // If each request follows the previous answer, nothing queues.
        let rows = propose_rows(&points, None, TimeSpread::default(), Size(7), &aux);
        assert_eq!(rows.len(), 3);
    }

    #[test]
    fn memory_has_a_margin() {
        const MIB: u64 = 1 << 20;
        assert_eq!(with_margin(Size(100 * MIB)), Size(125 * MIB));
        assert_eq!(with_margin(Size(10 * MIB + 1)), Size(27 * MIB));
    }

    #[test]
    fn times_are_rounded_up_to_two_digits() {
        for (time, rounded) in [(424.3, 430.0), (8.21, 8.3), (8.2, 8.2), (100.0, 100.0), (99.1, 100.0), (0.0, 0.001)] {
            assert_eq!(round_up_to_two_digits(time), rounded, "{time}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn ladders_rise_to_the_most_and_never_above(most in 1u64..200_000) {
            let rungs = limit_ladder(most);
            prop_assert!(rungs.windows(2).all(|pair| pair[0] < pair[1]), "{rungs:?}");
            prop_assert_eq!(rungs.last().copied(), Some(most as f64 / 1000.0));
        }

        #[test]
        fn dearer_rows_are_faster_and_every_row_was_measured(
            measured in prop::collection::vec((1u64..8000, 1f64..1000.0, 1f64..3.0, 0usize..50, 1f64..20.0), 0..20),
            pace in prop::option::of(1f64..20.0),
        ) {
            let points: Vec<Point> = measured
                .into_iter()
                .map(|(millicpus, p50, factor, answered, rate)| Point {
                    answered,
                    requests: answered.max(40),
                    rate,
                    ..point(millicpus as f64 / 1000.0, p50, p50 * factor)
                })
                .collect();
            let rows = propose_rows(&points, pace, TimeSpread::default(), Size(1), &BTreeMap::new());
            let told: Vec<(f64, f64, Spread)> = rows
                .iter()
                .map(|row| (row.limits.cpus.unwrap_or(0.0), row.value, row.spread.expect("measured")))
                .collect();
            for pair in told.windows(2) {
                prop_assert!(pair[0].0 < pair[1].0, "{told:?}");
                prop_assert!(pair[0].2.p95 > pair[1].2.p95, "{told:?}");
                prop_assert!(pair[0].1 >= pair[1].1, "{told:?}");
            }
            let usable: Vec<&Point> = points.iter().filter(|point| has_enough_answers(point) && keeps_pace(point,
                pace)).collect();
            let p95 = |point: &Point| point.compute.map_or(f64::INFINITY, |compute| compute.p95) / 1000.0;
            for (cpus, value, spread) in &told {
                prop_assert!(*value >= spread.p95 - 1e-9 && *value <= spread.p95 * 1.1 + 1e-9, "{told:?}");
                prop_assert!(spread.requests >= FEWEST as u64);
                prop_assert!(usable.iter().any(|point| point.cpus == *cpus && p95(point) == spread.p95), "{told:?}");
            }
            // The fastest point is among them, or one so close that it may be chance.
            let best = usable.iter().map(|point| p95(point)).fold(f64::INFINITY, f64::min);
            let proposed = told.last().map_or(f64::INFINITY, |(_, _, spread)| spread.p95);
            prop_assert!(best.is_infinite() || proposed * BETTER <= best + 1e-9, "{best} {told:?}");
        }
    }
}
