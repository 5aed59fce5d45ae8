//! Model of response times by cores and network.

use super::figures::{least_squares, mean};

/// Geometric steps in which [`RrtModel::fit`] searches for the number of useful cores.
const STEPS: u32 = 400;

/// A measured response time, and its conditions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Cores available to the computation.
    pub cores: f64,
    /// Round-trip time of the network, in seconds.
    pub round_trip: f64,
    /// Bytes of a request on the network.
    pub bytes_up: f64,
    /// Bytes of its answer on the network.
    pub bytes_down: f64,
    /// Rate of the network in bit/s; infinite without a network.
    pub rate: f64,
    /// Measured response time in seconds; [`RrtModel::predict`] ignores it.
    pub rrt: f64,
}

impl Point {
    /// Seconds on the network: the round trip, and the time to send the bytes.
    fn network(&self) -> f64 {
        self.round_trip + 8.0 * (self.bytes_up + self.bytes_down) / self.rate
    }
}

/// Model of a request's duration: `overhead` + round trip + bytes / rate + `work` / min(cores, `parallel`).
///
/// The term of the computation is the greater of two lower bounds of parallel work, its sum divided by the cores and
/// its longest chain (Cormen et al., "Introduction to Algorithms", third edition, 2009, section 27.1). A model
/// describes one program; another program has other work.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RrtModel {
    /// Seconds that depend neither on the network nor on the cores.
    pub overhead: f64,
    /// Core seconds of computation per request.
    pub work: f64,
    /// Number of cores above which more cores do not help. It is at most the greatest measured number, because no
    /// measurement shows the effect of more: predictions for more cores are therefore cautious.
    pub parallel: f64,
}

impl RrtModel {
    /// Fits the model by least squares of the measured times over a grid of `parallel`; overhead and work are not
    /// negative. Of equally good models the one with the greatest `parallel` is returned. `None` unless there are three
    /// usable points with at least two numbers of cores, because otherwise overhead and work cannot be distinguished.
    pub fn fit(points: &[Point]) -> Option<Self> {
        let usable: Vec<&Point> = points
            .iter()
            .filter(|point| (point.rrt - point.network()).is_finite() && point.cores > 0.0)
            .collect();
        let mut cores: Vec<f64> = usable.iter().map(|point| point.cores).collect();
        cores.sort_by(f64::total_cmp);
        let (least, most) = (*cores.first()?, *cores.last()?);
        if usable.len() < 3 || least == most {
            return None;
        }
        let steps = (0..STEPS)
            .map(|step| least * (most / least).powf(f64::from(STEPS - step) / f64::from(STEPS)));
        let mut grid: Vec<f64> = steps.chain(cores).filter(|cores| *cores > least).collect();
        grid.sort_by(|one, other| other.total_cmp(one));
        let mut best: Option<(f64, Self)> = None;
        for parallel in grid {
            let samples: Vec<(f64, f64)> = usable
                .iter()
                .map(|point| {
                    let share = 1.0 / point.cores.min(parallel);
                    (share, point.rrt - point.network())
                })
                .collect();
            let (overhead, work) = not_negative(&samples)?;
            let error: f64 = samples
                .iter()
                .map(|(share, rest)| (overhead + work * share - rest).powi(2))
                .sum();
            let scale: f64 = samples.iter().map(|sample| sample.1.powi(2)).sum();
            if best.is_none_or(|(least, _)| error < least - 1e-12 * scale) {
                let model = Self {
                    overhead,
                    work,
                    parallel,
                };
                best = Some((error, model));
            }
        }
        best.map(|(_, model)| model)
    }

    /// Predicts the response time at a point, in seconds.
    pub fn predict(&self, point: &Point) -> f64 {
        self.overhead + point.network() + self.work / point.cores.min(self.parallel)
    }
}

/// Intercept and slope of non-negative least squares: the unconstrained optimum if it is one, otherwise the better edge
/// (Lawson and Hanson, "Solving Least Squares Problems", 1974, chapter 23, for two unknowns).
fn not_negative(samples: &[(f64, f64)]) -> Option<(f64, f64)> {
    let free = least_squares(samples)?;
    if free.intercept >= 0.0 && free.slope >= 0.0 {
        return Some((free.intercept, free.slope));
    }
    let products: f64 = samples.iter().map(|(x, y)| x * y).sum();
    let squares: f64 = samples.iter().map(|(x, _)| x * x).sum();
    let mean = mean(&samples.iter().map(|sample| sample.1).collect::<Vec<_>>())?;
    let edges = [(0.0, (products / squares).max(0.0)), (mean.max(0.0), 0.0)];
    let error =
        |(a, b): (f64, f64)| -> f64 { samples.iter().map(|(x, y)| (a + b * x - y).powi(2)).sum() };
    edges
        .into_iter()
        .min_by(|one, other| error(*one).total_cmp(&error(*other)))
}

#[cfg(test)]
mod tests {
    use super::super::assert_near;
    use super::*;

    fn point(cores: f64, rate: f64, rrt: f64) -> Point {
        Point {
            cores,
            round_trip: 0.03,
            bytes_up: 90_000.0,
            bytes_down: 10_000.0,
            rate,
            rrt,
        }
    }

    /// 0.05 s + 0.03 s + 800,000 bit / rate + 2 core seconds / min(cores, 3).
    #[test]
    fn the_models_parameters_are_found() {
        let true_model = RrtModel {
            overhead: 0.05,
            work: 2.0,
            parallel: 3.0,
        };
        assert_near(
            true_model.predict(&point(1.0, 8e6, 0.0)),
            0.05 + 0.03 + 0.1 + 2.0,
        );
        let mut points: Vec<Point> = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0]
            .into_iter()
            .flat_map(|cores| [point(cores, 8e6, 0.0), point(cores, 1e8, 0.0)])
            .collect();
        for point in &mut points {
            point.rrt = true_model.predict(point);
        }
        let model = RrtModel::fit(&points).expect("six numbers of cores");
        assert!((model.parallel - 3.0).abs() < 0.03, "{model:?}");
        assert!((model.work - 2.0).abs() < 0.01, "{model:?}");
        assert!((model.overhead - 0.05).abs() < 0.01, "{model:?}");
    }

    #[test]
    fn the_model_claims_no_more_cores_than_were_measured() {
        let rrt = |cores: f64| 0.03 + 0.1 + 1.0 / cores;
        let points: Vec<Point> = [0.25, 0.5, 1.0, 2.0]
            .into_iter()
            .map(|cores| point(cores, 8e6, rrt(cores)))
            .collect();
        let model = RrtModel::fit(&points).expect("four numbers of cores");
        assert_near(model.parallel, 2.0);
        assert_near(model.work, 1.0);
        assert_near(model.predict(&point(16.0, 8e6, 0.0)), rrt(2.0));
    }

    #[test]
    fn the_model_needs_what_tells_its_parts_apart() {
        let one = [
            point(1.0, 8e6, 1.0),
            point(1.0, 8e6, 1.1),
            point(1.0, 1e8, 1.0),
        ];
        assert_eq!(RrtModel::fit(&one), None);
        assert_eq!(RrtModel::fit(&one[..1]), None);
        let unanswered = [
            point(1.0, 8e6, 1.0),
            point(2.0, 8e6, f64::INFINITY),
            point(4.0, 8e6, f64::NAN),
        ];
        assert_eq!(RrtModel::fit(&unanswered), None);
        assert_eq!(RrtModel::fit(&[]), None);
    }

    #[test]
    fn overhead_and_work_are_not_negative() {
        // Times that fall faster than the cores grow would need a negative overhead.
        let points = [
            point(1.0, 8e6, 1.13),
            point(2.0, 8e6, 0.43),
            point(4.0, 8e6, 0.18),
        ];
        let model = RrtModel::fit(&points).expect("three numbers of cores");
        assert!(model.overhead >= 0.0 && model.work > 0.0, "{model:?}");
        // Times that grow with the cores would need negative work.
        let points = [
            point(1.0, 8e6, 0.5),
            point(2.0, 8e6, 0.6),
            point(4.0, 8e6, 0.7),
        ];
        let model = RrtModel::fit(&points).expect("three numbers of cores");
        assert!(model.work >= 0.0 && model.overhead > 0.0, "{model:?}");
    }
}
