//! Response times as sums of parts, each of which is modelled by itself: the greater part of a response may be work that cores share, and the
//! rest is not.

use crate::statistics::{Point, RrtModel, mean};
use crate::trace::Trace;

/// Names of [`Parts`], in their order.
pub const NAMES: [&str; 4] = [
    "acquisition",
    "computation",
    "rendering",
    "transport and waiting",
];
/// Which of them is the algorithm itself.
const COMPUTATION: usize = 1;
/// A part whose cores end this near to the greatest limit that was measured has shown no end.
const NEAR: f64 = 0.97;

/// Means over all requests of one run, seconds: what the package tells of its own time, and what is left of the response time.
pub type Parts = [f64; 4];

/// Those of a run; none unless the package told its parts.
pub fn parts(trace: &Trace) -> Option<Parts> {
    let both = trace
        .requests
        .iter()
        .filter_map(|one| Some((one.response?, one.phases?)));
    let all: Vec<Parts> = both
        .map(|(response, phases)| {
            let told = [phases.acquisition, phases.computation, phases.rendering];
            let rest = response - told.iter().sum::<f64>();
            [told[0], told[1], told[2], rest]
        })
        .collect();
    let mut means = Parts::default();
    for (index, part) in means.iter_mut().enumerate() {
        *part = mean(&all.iter().map(|one| one[index]).collect::<Vec<_>>())?;
    }
    Some(means)
}

/// One model for each part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// In the order of [`NAMES`].
    pub parts: [RrtModel; 4],
    /// The greatest number of cores that it was fitted to.
    pub most: f64,
    /// Threads that the program computed with.
    pub threads: usize,
}

impl Model {
    /// Fitted to (cores, parts) of runs of a program with so many threads. None unless there are three runs with at least two numbers of cores.
    pub fn fit(runs: &[(f64, Parts)], threads: usize) -> Option<Self> {
        let of = |index: usize| {
            let points: Vec<Point> = runs
                .iter()
                .map(|(cores, parts)| point(*cores, parts[index]))
                .collect();
            RrtModel::fit(&points)
        };
        let most = runs.iter().map(|run| run.0).fold(0.0, f64::max);
        Some(Self {
            parts: [of(0)?, of(1)?, of(2)?, of(3)?],
            most,
            threads,
        })
    }

    /// Mean response time with so many cores, seconds. More cores than were measured give nothing more: nothing measured says that they do.
    pub fn cautious(&self, cores: f64) -> f64 {
        self.parts
            .iter()
            .map(|part| part.predict(&point(cores, 0.0)))
            .sum()
    }

    /// The same if the computation's work can be divided among all cores, however many, as among the first ones: less cannot come out by this
    /// model. Of a program with one thread it is the cautious one. Where points showed an end of what cores give, it may have been the
    /// machine's, so the bound goes beyond it.
    pub fn bound(&self, cores: f64) -> f64 {
        let computation = self.parts[COMPUTATION];
        if self.threads < 2 || cores <= computation.parallel {
            return self.cautious(cores);
        }
        self.cautious(cores) - computation.work / computation.parallel + computation.work / cores
    }

    /// Whether more cores gave nothing more before the greatest number that was measured.
    pub fn has_end(&self) -> bool {
        self.parts[COMPUTATION].parallel < NEAR * self.most
    }
}

fn point(cores: f64, rrt: f64) -> Point {
    Point {
        cores,
        // What the network takes is in the parts that were measured.
        round_trip: 0.0,
        bytes_up: 0.0,
        bytes_down: 0.0,
        rate: f64::INFINITY,
        rrt,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::{Phases, Request};

    fn near(one: f64, other: f64) {
        assert!((one - other).abs() < 1e-6, "{one} is not {other}");
    }

    /// 1 ms and 2 core seconds of computation that `parallel` cores share, 50 ms of transport.
    fn runs(parallel: f64) -> Vec<(f64, Parts)> {
        [0.25, 0.5, 1.0, 2.0]
            .map(|cores: f64| (cores, [0.001, 2.0 / cores.min(parallel), 0.0, 0.05]))
            .to_vec()
    }

    #[test]
    fn what_is_left_is_transport() {
        let request = |response, computation| Request {
            response: Some(response),
            phases: Some(Phases {
                acquisition: 0.01,
                computation,
                rendering: 0.02,
            }),
            ..Request::default()
        };
        let mut trace = Trace::default();
        assert_eq!(parts(&trace), None);
        trace.requests = vec![request(0.5, 0.4), request(0.7, 0.6), Request::default()];
        let found = parts(&trace).expect("two are known");
        for (one, other) in found.into_iter().zip([0.01, 0.5, 0.02, 0.07]) {
            near(one, other);
        }
    }

    #[test]
    fn work_that_was_shared_may_go_on_to_be() {
        let model = Model::fit(&runs(8.0), 2).expect("four limits");
        assert!(!model.has_end());
        near(model.cautious(0.8), 0.051 + 2.5);
        // Two cores were measured, so four give no less.
        near(model.cautious(4.0), 0.051 + 1.0);
        near(model.bound(4.0), 0.051 + 0.5);
        near(model.bound(1.0), model.cautious(1.0));
        near(model.bound(f64::INFINITY), 0.051);
    }

    #[test]
    fn one_thread_needs_one_core() {
        let model = Model::fit(&runs(1.0), 1).expect("four limits");
        assert!(model.has_end());
        near(model.cautious(4.0), 0.051 + 2.0);
        near(model.bound(32.0), 0.051 + 2.0);
    }

    /// Two threads that gained nothing above one core: it may have been the machine's end.
    #[test]
    fn the_bound_goes_beyond_an_end_that_was_seen() {
        let model = Model::fit(&runs(1.0), 2).expect("four limits");
        assert!(model.has_end());
        near(model.cautious(4.0), 0.051 + 2.0);
        near(model.bound(4.0), 0.051 + 0.5);
    }

    #[test]
    fn two_limits_are_too_few() {
        assert_eq!(Model::fit(&runs(1.0)[..2], 1), None);
    }
}
