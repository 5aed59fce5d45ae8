//! A model of response times as sums of parts, each modelled separately: some parts of a response are work that cores
//! share, the others are not.

use crate::statistics::RrtModel;
use crate::trace::ResponseParts;

/// Index of the algorithm itself.
pub const COMPUTATION: usize = 1;
/// If a part's number of useful cores is at least this fraction of the greatest measured limit, no limit of parallelism
/// was observed.
const NEAR: f64 = 0.97;

/// A model of each part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// Models in the order of [`crate::trace::PART_NAMES`].
    pub parts: [RrtModel; 4],
    /// Greatest number of cores to which the model was fitted.
    pub most: f64,
    pub threads: usize,
}

impl Model {
    /// Fits the model to (cores, parts) of runs of a program with `threads` threads. Returns `None` unless there are
    /// three runs with at least two different numbers of cores.
    pub fn fit(runs: &[(f64, ResponseParts)], threads: usize) -> Option<Self> {
        let of = |index: usize| {
            let points = runs.iter().map(|(cores, parts)| (*cores, parts[index]));
            RrtModel::fit(&points.collect::<Vec<_>>())
        };
        let most = runs.iter().map(|run| run.0).fold(0.0, f64::max);
        Some(Self { parts: [of(0)?, of(1)?, of(2)?, of(3)?], most, threads })
    }

    /// Predicts the mean response time with `cores` cores, in seconds. More cores than were measured give no further
    /// improvement, because no measurement shows one.
    pub fn predict_cautious(&self, cores: f64) -> f64 {
        self.parts.iter().map(|part| part.predict(cores)).sum()
    }

    /// Lower bound of the prediction: assumes that the work of the computation can be divided among any number of cores
    /// as among the first ones. With one thread it equals the cautious prediction. If the measured points showed a
    /// limit of parallelism, that may have been the machine's, so the bound goes beyond it.
    pub fn predict_bound(&self, cores: f64) -> f64 {
        let computation = self.parts[COMPUTATION];
        if self.threads < 2 || cores <= computation.parallel {
            return self.predict_cautious(cores);
        }
        self.predict_cautious(cores) - computation.work / computation.parallel + computation.work / cores
    }

    /// Returns the number of cores above which more cores do not help the computation.
    pub fn parallel(&self) -> f64 {
        self.parts[COMPUTATION].parallel
    }

    /// Returns whether more cores stopped helping below the greatest measured number.
    pub fn has_end(&self) -> bool {
        self.parallel() < NEAR * self.most
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_near(one: f64, other: f64) {
        assert!((one - other).abs() < 1e-6, "{one} is not {other}");
    }

    /// 1 ms and 2 core seconds of computation that `parallel` cores share, 50 ms of transport.
    fn runs(parallel: f64) -> Vec<(f64, ResponseParts)> {
        [0.25, 0.5, 1.0, 2.0].map(|cores: f64| (cores, [0.001, 2.0 / cores.min(parallel), 0.0, 0.05])).to_vec()
    }

    #[test]
    fn work_that_was_shared_may_go_on_to_be() {
        let model = Model::fit(&runs(8.0), 2).expect("four limits");
        assert!(!model.has_end());
        assert_near(model.predict_cautious(0.8), 0.051 + 2.5);
        // Measured with up to two cores, so four are predicted to be as fast.
        assert_near(model.predict_cautious(4.0), 0.051 + 1.0);
        assert_near(model.predict_bound(4.0), 0.051 + 0.5);
        assert_near(model.predict_bound(1.0), model.predict_cautious(1.0));
        assert_near(model.predict_bound(f64::INFINITY), 0.051);
    }

    #[test]
    fn one_thread_needs_one_core() {
        let model = Model::fit(&runs(1.0), 1).expect("four limits");
        assert!(model.has_end());
        assert_near(model.predict_cautious(4.0), 0.051 + 2.0);
        assert_near(model.predict_bound(32.0), 0.051 + 2.0);
    }

    /// Two threads that gained nothing above one core, which may have been the machine's limit.
    #[test]
    fn the_bound_goes_beyond_an_end_that_was_seen() {
        let model = Model::fit(&runs(1.0), 2).expect("four limits");
        assert!(model.has_end());
        assert_near(model.predict_cautious(4.0), 0.051 + 2.0);
        assert_near(model.predict_bound(4.0), 0.051 + 0.5);
    }

    #[test]
    fn two_limits_are_too_few() {
        assert_eq!(Model::fit(&runs(1.0)[..2], 1), None);
    }
}
