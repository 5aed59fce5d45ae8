//! Model of response times by cores.

use super::figures::{least_squares, mean};

/// Geometric steps in which [`RrtModel::fit`] searches for the number of useful cores.
const STEPS: u32 = 400;

/// Model of a duration: `overhead` + `work` / min(cores, `parallel`).
///
/// The term of the computation is the greater of two lower bounds of parallel work, its sum divided by the cores and
/// its longest chain (Cormen et al., "Introduction to Algorithms", third edition, 2009, section 27.1). A model
/// describes one program; another program has other work.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RrtModel {
    pub overhead: f64,
    /// Core seconds of computation per request.
    pub work: f64,
    /// Number of cores above which more cores do not help. It is at most the greatest measured number, because no
    /// measurement shows the effect of more: predictions for more cores are therefore cautious.
    pub parallel: f64,
}

impl RrtModel {
    /// Fits the model to (cores, seconds) by least squares of the measured times over a grid of `parallel`; overhead
    /// and work are not negative. Of equally good models the one with the greatest `parallel` is returned. `None`
    /// unless there are three usable points with at least two numbers of cores, because otherwise overhead and work
    /// cannot be distinguished.
    pub fn fit(points: &[(f64, f64)]) -> Option<Self> {
        let is_usable = |point: &&(f64, f64)| point.0 > 0.0 && point.1.is_finite();
        let usable: Vec<(f64, f64)> = points.iter().filter(is_usable).copied().collect();
        let mut cores: Vec<f64> = usable.iter().map(|point| point.0).collect();
        cores.sort_by(f64::total_cmp);
        let (least, most) = (*cores.first()?, *cores.last()?);
        if usable.len() < 3 || least == most {
            return None;
        }
        let steps = (0..STEPS).map(|step| least * (most / least).powf(f64::from(STEPS - step) / f64::from(STEPS)));
        let mut grid: Vec<f64> = steps.chain(cores).filter(|cores| *cores > least).collect();
        grid.sort_by(|one, other| other.total_cmp(one));
        let scale: f64 = usable.iter().map(|point| point.1.powi(2)).sum();
        let mut best: Option<(f64, Self)> = None;
        for parallel in grid {
            let samples = usable.iter().map(|(cores, time)| (1.0 / cores.min(parallel), *time));
            let samples: Vec<(f64, f64)> = samples.collect();
            let (overhead, work) = not_negative(&samples)?;
            let model = Self { overhead, work, parallel };
            let error: f64 = usable.iter().map(|(cores, time)| (model.predict(*cores) - time).powi(2)).sum();
            if best.is_none_or(|(least, _)| error < least - 1e-12 * scale) {
                best = Some((error, model));
            }
        }
        best.map(|(_, model)| model)
    }

    /// Predicts the duration with `cores` cores, in seconds.
    pub fn predict(&self, cores: f64) -> f64 {
        self.overhead + self.work / cores.min(self.parallel)
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
    let error = |(a, b): (f64, f64)| -> f64 { samples.iter().map(|(x, y)| (a + b * x - y).powi(2)).sum() };
    edges.into_iter().min_by(|one, other| error(*one).total_cmp(&error(*other)))
}

#[cfg(test)]
mod tests {
    use super::super::assert_near;
    use super::*;

    /// 0.05 s + 2 core seconds / min(cores, 3).
    #[test]
    fn the_models_parameters_are_found() {
        let true_model = RrtModel { overhead: 0.05, work: 2.0, parallel: 3.0 };
        assert_near(true_model.predict(1.0), 2.05);
        let points = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0].map(|cores| (cores, true_model.predict(cores)));
        let model = RrtModel::fit(&points).expect("six numbers of cores");
        assert!((model.parallel - 3.0).abs() < 0.03, "{model:?}");
        assert!((model.work - 2.0).abs() < 0.01, "{model:?}");
        assert!((model.overhead - 0.05).abs() < 0.01, "{model:?}");
    }

    #[test]
    fn the_model_claims_no_more_cores_than_were_measured() {
        let points = [0.25, 0.5, 1.0, 2.0].map(|cores| (cores, 0.1 + 1.0 / cores));
        let model = RrtModel::fit(&points).expect("four numbers of cores");
        assert_near(model.parallel, 2.0);
        assert_near(model.work, 1.0);
        assert_near(model.predict(16.0), 0.6);
    }

    #[test]
    fn the_model_needs_what_tells_its_parts_apart() {
        let one = [(1.0, 1.0), (1.0, 1.1), (1.0, 1.0)];
        assert_eq!(RrtModel::fit(&one), None);
        assert_eq!(RrtModel::fit(&one[..1]), None);
        let unanswered = [(1.0, 1.0), (2.0, f64::INFINITY), (4.0, f64::NAN)];
        assert_eq!(RrtModel::fit(&unanswered), None);
        assert_eq!(RrtModel::fit(&[]), None);
    }

    #[test]
    fn overhead_and_work_are_not_negative() {
        // Times that fall faster than the cores grow would need a negative overhead.
        let model = RrtModel::fit(&[(1.0, 1.0), (2.0, 0.3), (4.0, 0.05)]).expect("three cores");
        assert!(model.overhead >= 0.0 && model.work > 0.0, "{model:?}");
        // Times that grow with the cores would need negative work.
        let model = RrtModel::fit(&[(1.0, 0.4), (2.0, 0.5), (4.0, 0.6)]).expect("three cores");
        assert!(model.work >= 0.0 && model.overhead > 0.0, "{model:?}");
    }
}
