//! Queueing models: how long robots wait for each other, and how many of them a node serves in time.

/// Predicted state of a node that serves robots with one request at a time each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QueuePrediction {
    /// Seconds from a request to its answer, without the network.
    pub response: f64,
    pub throughput: f64,
    /// Fraction of core time in use, 0 to 1.
    pub busy: f64,
}

/// Solves the closed queue of `robots` that each wait for their answer, pause for `think` seconds on average and send
/// the next request, at a node of `cores` where a request takes `service` core seconds on average ("machine repair"). A
/// request uses at most one core; less than one core is a slower server. Without robots nothing is used, and a request
/// takes `service`.
///
/// The solution is exact, from the probabilities of each number of requests at the node: the finite source queue
/// M/M/c//N (Kleinrock, "Queueing Systems", volume 1, 1975, section 3.10). As a scheduler shares the cores among all
/// requests, only the means of service and pause matter, not their distributions (Cohen, "The Multiple Phase Service
/// Network with Generalized Processor Sharing", Acta Informatica 12, 1979).
pub fn machine_repair(robots: u64, cores: f64, service: f64, think: f64) -> QueuePrediction {
    if robots == 0 {
        return QueuePrediction { response: service / cores.min(1.0), throughput: 0.0, busy: 0.0 };
    }
    // Logarithms of the weights of 0, 1, 2, ... requests at the node, because the weights themselves would overflow.
    let think = think.max(1e-12);
    let mut weights = vec![0.0f64];
    let mut weight = 0.0;
    for requests in 1..=robots {
        let thinking = (robots - requests + 1) as f64;
        weight += (thinking / think * service / cores.min(requests as f64)).ln();
        weights.push(weight);
    }
    let most = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let (mut all, mut used) = (0.0, 0.0);
    for (requests, weight) in weights.iter().enumerate() {
        let share = (weight - most).exp();
        all += share;
        used += share * cores.min(requests as f64);
    }
    let used = used / all;
    let throughput = used / service;
    QueuePrediction { response: robots as f64 / throughput - think, throughput, busy: used / cores }
}

/// Measurements of robots at a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QueueObservation {
    pub robots: u64,
    /// Mean of their response times, in seconds.
    pub response: f64,
    /// Fraction of core time that their requests used, 0 to 1.
    pub busy: f64,
}

/// Model of a node whose robots wait in the queue of [`machine_repair`] and, in addition, for a delay that uses no core
/// of the node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodeModel {
    pub cores: f64,
    /// Mean pause in seconds between an answer and the robot's next request.
    pub think: f64,
    /// Core seconds per request.
    pub service: f64,
    /// Seconds per response that use no core, such as those on a network.
    pub delay: f64,
}

/// Points on each axis of the grid that [`NodeModel::fit`] searches, number of rounds, and the factor by which the grid
/// shrinks in each round.
const GRID: (i32, u32, f64) = (10, 9, 0.4);

impl NodeModel {
    /// Fits `service` and `delay` to the observed response times and core use: the sum of squared logarithms of the
    /// ratios is minimal. `None` if an observation is not positive, or for fewer than two observations.
    pub fn fit(observed: &[QueueObservation], cores: f64, think: f64) -> Option<Self> {
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let usable = |one: &QueueObservation| one.robots > 0 && positive(one.response) && positive(one.busy);
        if observed.len() < 2 || !observed.iter().all(usable) {
            return None;
        }
        let quickest = observed.iter().map(|one| one.response);
        let quickest = quickest.fold(f64::INFINITY, f64::min);
        let node = |service: f64, delay: f64| Self { cores, think, service, delay };
        // Starts from the logarithm of the service time and the delay, with half the width of their possible range.
        let (mut service, mut width) = ((quickest * 0.05).ln(), 40f64.ln());
        let (mut delay, mut height) = (quickest / 2.0, quickest / 2.0);
        let mut least = f64::INFINITY;
        for _ in 0..GRID.1 {
            let middle = (service, delay);
            for across in -GRID.0..=GRID.0 {
                for up in -GRID.0..=GRID.0 {
                    let at = |step: i32| f64::from(step) / f64::from(GRID.0);
                    let there = (middle.0 + width * at(across), (middle.1 + height * at(up)).max(0.0));
                    let error = node(there.0.exp(), there.1).distance(observed);
                    if error < least {
                        least = error;
                        (service, delay) = there;
                    }
                }
            }
            width *= GRID.2;
            height *= GRID.2;
        }
        Some(node(service.exp(), delay))
    }

    /// Returns the sum of squared logarithms of the ratios of prediction and observation.
    fn distance(&self, observed: &[QueueObservation]) -> f64 {
        let terms = observed.iter().map(|one| {
            let closed = self.predict(one.robots);
            let times = (closed.response / one.response).ln();
            times.powi(2) + (closed.busy / one.busy).ln().powi(2)
        });
        terms.sum()
    }

    /// Predicts the state with `robots` robots; the response time includes the delay.
    pub fn predict(&self, robots: u64) -> QueuePrediction {
        let closed = machine_repair(robots, self.cores, self.service, self.think + self.delay);
        QueuePrediction { response: closed.response + self.delay, ..closed }
    }

    /// Returns how many of `robots` it serves with a mean response time of at most `t_max` seconds.
    pub fn robots_served(&self, robots: u64, t_max: f64) -> u64 {
        // The response time grows with the number of robots.
        let (mut enough, mut beyond) = (0, robots + 1);
        while beyond - enough > 1 {
            let middle = enough + (beyond - enough) / 2;
            if self.predict(middle).response <= t_max {
                enough = middle;
            } else {
                beyond = middle;
            }
        }
        enough
    }

    /// Returns the number of robots above which they wait for one another rather than for their own requests: the
    /// intersection of the bounds for few and for many robots (Denning and Buzen, "The Operational Analysis of Queueing
    /// Network Models", ACM Computing Surveys 10, 1978).
    pub fn knee(&self) -> f64 {
        self.cores * (self.think + self.delay + self.service) / self.service
    }
}

#[cfg(test)]
mod tests {
    use super::super::assert_near;
    use super::*;

    /// Exact Mean Value Analysis of one core (Reiser and Lavenberg, 1980): an arriving robot sees the queue as it is
    /// without that robot.
    fn one_core(robots: u64, service: f64, think: f64) -> f64 {
        let (mut response, mut length) = (0.0, 0.0);
        for robots in 1..=robots {
            response = service * (1.0 + length);
            length = robots as f64 / (response + think) * response;
        }
        response
    }

    /// Two robots, service and pause of 1 s, one core: the states' weights are 1, 2, 2, so four fifths of a request per
    /// second are answered, and the response time is 2 / 0.8 − 1 = 1.5 s.
    #[test]
    fn one_core_is_exact() {
        let closed = machine_repair(2, 1.0, 1.0, 1.0);
        assert_near(closed.response, 1.5);
        assert_near(closed.throughput, 0.8);
        assert_near(closed.busy, 0.8);
        for robots in [1, 3, 10, 40] {
            assert_near(response_time(robots, 1.0, 0.2, 3.0), one_core(robots, 0.2, 3.0));
        }
    }

    /// Three robots, service and pause of 1 s, two cores: the states' weights are 1, 3, 3, 1.5, and (3 + 6 + 3) / 8.5
    /// requests per second are answered.
    #[test]
    fn several_cores_are_exact() {
        let closed = machine_repair(3, 2.0, 1.0, 1.0);
        assert_near(closed.throughput, 12.0 / 8.5);
        assert_near(closed.response, 3.0 * 8.5 / 12.0 - 1.0);
        assert_near(closed.busy, 6.0 / 8.5);
        assert_near(response_time(1, 4.0, 0.5, 2.0), 0.5);
        // Saturated: 200 robots share the throughput of 4 cores.
        assert_near(response_time(200, 4.0, 0.5, 2.0), 200.0 * 0.5 / 4.0 - 2.0);
        assert_near(response_time(1, 0.25, 0.5, 2.0), 2.0);
        assert_near(machine_repair(0, 2.0, 0.5, 2.0).response, 0.5);
        // Without pauses: three robots at two cores.
        assert_near(response_time(3, 2.0, 1.0, 0.0), 1.5);
        assert!(response_time(5000, 2.0, 0.01, 0.2).is_finite());
    }

    /// One core, 1 s of service, 1 s of pause: one robot waits 1 s, two wait 1.5 s, three wait 1 + 0.8 · 1.5 = 2.2 s.
    #[test]
    fn robots_that_are_served_in_time_are_counted() {
        assert_near(response_time(3, 1.0, 1.0, 1.0), 2.2);
        let node = NodeModel { cores: 1.0, think: 1.0, service: 1.0, delay: 0.0 };
        assert_eq!(node.robots_served(100, 1.6), 2);
    }

    fn response_time(robots: u64, cores: f64, service: f64, think: f64) -> f64 {
        machine_repair(robots, cores, service, think).response
    }

    const NODE: NodeModel = NodeModel { cores: 2.0, think: 0.2, service: 0.01, delay: 0.003 };

    fn observations(robots: &[u64], as_if: impl Fn(u64) -> f64) -> Vec<QueueObservation> {
        let all = robots.iter().map(|robots| {
            let closed = NODE.predict(*robots);
            QueueObservation { robots: *robots, response: closed.response * as_if(*robots), busy: closed.busy }
        });
        all.collect()
    }

    #[test]
    fn a_nodes_parameters_are_found() {
        let node = NodeModel::fit(&observations(&[1, 4, 16, 64], |_| 1.0), 2.0, 0.2).expect("four points");
        assert!((node.service / 0.01 - 1.0).abs() < 0.01, "{node:?}");
        assert!((node.delay - 0.003).abs() < 0.0003, "{node:?}");
        for robots in [2, 8, 32, 100] {
            let (predicted, real) = (node.predict(robots).response, NODE.predict(robots).response);
            assert!((predicted / real - 1.0).abs() < 0.03, "{predicted} {real}");
        }
        // Observations that are a tenth too long or too short.
        let noisy = observations(&[1, 4, 16, 64], |robots| if robots == 4 { 1.1 } else { 0.9 });
        let node = NodeModel::fit(&noisy, 2.0, 0.2).expect("four points");
        assert!((node.service / 0.01 - 1.0).abs() < 0.1, "{node:?}");
    }

    #[test]
    fn nothing_is_fitted_to_what_is_not_there() {
        assert_eq!(NodeModel::fit(&observations(&[4], |_| 1.0), 2.0, 0.2), None);
        assert_eq!(NodeModel::fit(&observations(&[1, 4], |_| f64::NAN), 2.0, 0.2), None);
        assert_eq!(NodeModel::fit(&[], 2.0, 0.2), None);
    }

    /// 2 cores answer 200 requests per second; one robot sends 1 / 0.213 s.
    #[test]
    fn bounds_meet_at_the_knee() {
        assert_near(NODE.knee(), 200.0 * 0.213);
        let most = NODE.robots_served(1000, 0.1);
        assert!(NODE.predict(most).response <= 0.1 && NODE.predict(most + 1).response > 0.1);
        assert_eq!(NODE.robots_served(7, 0.1), 7);
        assert_eq!(NODE.robots_served(7, 0.012), 0);
    }
}
