//! Errors of trajectories.

use super::figures::mean;

/// Distance of an estimated trajectory from the true one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrajectoryError {
    /// Root mean square distance, in metres.
    pub rmse: f64,
    /// Greatest distance, in metres.
    pub max: f64,
    /// Number of poses of the estimate that could be compared.
    pub count: usize,
}

/// Absolute trajectory error of poses (seconds, x, y in metres), as defined by Sturm et al., "A Benchmark for the
/// Evaluation of RGB-D SLAM Systems", IROS 2012. The truth is interpolated linearly at the times of the estimate; poses
/// outside its time range are not compared. The estimate is then rotated and translated, without scaling, so that the
/// sum of squared distances is minimal (Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two
/// Point Patterns", IEEE PAMI 13, 1991, in the plane). `None` for fewer than two poses.
pub fn trajectory_error(estimate: &[(f64, f64, f64)], truth: &[(f64, f64, f64)]) -> Option<TrajectoryError> {
    let finite = |pose: &&(f64, f64, f64)| pose.0.is_finite() && pose.1.is_finite() && pose.2.is_finite();
    let mut truth: Vec<(f64, f64, f64)> = truth.iter().filter(finite).copied().collect();
    truth.sort_by(|one, other| one.0.total_cmp(&other.0));
    let pairs: Vec<[(f64, f64); 2]> = estimate
        .iter()
        .filter(finite)
        .filter_map(|pose| Some([(pose.1, pose.2), interpolate(&truth, pose.0)?]))
        .collect();
    if pairs.len() < 2 {
        return None;
    }
    let centre = |which: usize| {
        let sum = pairs.iter().fold((0.0, 0.0), |sum, pair| (sum.0 + pair[which].0, sum.1 + pair[which].1));
        (sum.0 / pairs.len() as f64, sum.1 / pairs.len() as f64)
    };
    let (from, to) = (centre(0), centre(1));
    let centred = |pair: &[(f64, f64); 2]| {
        let [one, other] = *pair;
        ((one.0 - from.0, one.1 - from.1), (other.0 - to.0, other.1 - to.1))
    };
    let (mut dot, mut cross) = (0.0, 0.0);
    for (one, other) in pairs.iter().map(centred) {
        dot += one.0 * other.0 + one.1 * other.1;
        cross += one.0 * other.1 - one.1 * other.0;
    }
    let (sin, cos) = f64::atan2(cross, dot).sin_cos();
    let distances: Vec<f64> = pairs
        .iter()
        .map(centred)
        .map(|(one, other)| {
            let turned = (cos * one.0 - sin * one.1, sin * one.0 + cos * one.1);
            f64::hypot(turned.0 - other.0, turned.1 - other.1)
        })
        .collect();
    let squares: Vec<f64> = distances.iter().map(|distance| distance.powi(2)).collect();
    Some(TrajectoryError {
        rmse: mean(&squares)?.sqrt(),
        max: distances.iter().copied().fold(0.0, f64::max),
        count: distances.len(),
    })
}

/// Interpolates a trajectory, sorted by time, at a time within its range.
fn interpolate(truth: &[(f64, f64, f64)], time: f64) -> Option<(f64, f64)> {
    let after = truth.partition_point(|pose| pose.0 < time);
    let next = truth.get(after)?;
    if next.0 == time {
        return Some((next.1, next.2));
    }
    let last = truth.get(after.checked_sub(1)?)?;
    let share = (time - last.0) / (next.0 - last.0);
    Some((last.1 + share * (next.1 - last.1), last.2 + share * (next.2 - last.2)))
}

#[cfg(test)]
mod tests {
    use super::super::assert_near;
    use super::*;

    fn path() -> Vec<(f64, f64, f64)> {
        (0..200)
            .map(|index| {
                let t = f64::from(index) / 10.0;
                (t, 5.0 * t.sin() + 0.1 * t, 3.0 * (2.0 * t).sin())
            })
            .collect()
    }

    #[test]
    fn a_turned_and_moved_path_has_no_error() {
        for angle in [0.0f64, 0.7, 2.5, -3.0] {
            let (sin, cos) = angle.sin_cos();
            let moved: Vec<_> =
                path().into_iter().map(|(t, x, y)| (t, cos * x - sin * y + 12.0, sin * x + cos * y - 7.0)).collect();
            let error = trajectory_error(&moved, &path()).expect("poses");
            assert!(error.rmse < 1e-9 && error.max < 1e-9, "{error:?}");
            assert_eq!(error.count, 200);
        }
    }

    /// A square of 2 m whose estimate is a square of 4 m: no rotation or translation helps, each corner is √2 m away.
    #[test]
    fn scale_is_an_error() {
        let square = |half: f64| [(0.0, -half, -half), (1.0, half, -half), (2.0, half, half), (3.0, -half, half)];
        let error = trajectory_error(&square(2.0), &square(1.0)).expect("poses");
        assert_near(error.rmse, 2.0f64.sqrt());
        assert_near(error.max, 2.0f64.sqrt());
        assert_eq!(error.count, 4);
    }

    #[test]
    fn truth_is_interpolated_and_not_extrapolated() {
        let truth = [(2.0, 2.0, 4.0), (0.0, 0.0, 0.0)];
        let estimate = [
            (-1.0, 50.0, 50.0),
            (0.0, 0.0, 0.0),
            (0.5, 0.5, 1.0),
            (1.5, 1.5, 3.0),
            (2.0, f64::NAN, 4.0),
            (2.5, 9.0, 9.0),
        ];
        let error = trajectory_error(&estimate, &truth).expect("poses");
        assert_eq!(error.count, 3);
        assert!(error.rmse < 1e-9, "{error:?}");
        assert_eq!(trajectory_error(&estimate[..2], &truth), None);
        assert_eq!(trajectory_error(&estimate, &[]), None);
    }
}
