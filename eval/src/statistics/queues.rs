//! Queues: how long robots wait for each other, and how many nodes they need.

/// How long a request waits before it is served, seconds, on one server with Poisson arrivals: Pollaczek and Khinchine's
/// formula for M/G/1 (Kleinrock, "Queueing Systems", volume 1, 1975, chapter 5). `arrivals` are requests per second,
/// `service` is the mean time of service in seconds, `variation` the variance of that time divided by the square of its
/// mean: 0 for equal times (M/D/1), 1 for exponential ones (M/M/1). Infinite if more arrives than can be served.
pub fn waiting_time(arrivals: f64, service: f64, variation: f64) -> f64 {
    let busy = arrivals * service;
    if busy >= 1.0 {
        return f64::INFINITY;
    }
    busy * service * (1.0 + variation) / (2.0 * (1.0 - busy))
}

/// How a node serves robots that each have one request at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closed {
    /// Seconds from a request to its answer, without the network.
    pub response: f64,
    /// Requests per second of all robots together.
    pub throughput: f64,
    /// The share of the cores' time that is used, 0 to 1.
    pub busy: f64,
}

/// The closed queue of `robots` that each wait for their answer, pause for `think` seconds and ask again, at a node of
/// `cores` where a request takes `service` core seconds ("machine repair"). Less than one core is a slower server.
/// Without robots nothing is used, and a request takes `service`.
///
/// One core is computed by exact Mean Value Analysis (Reiser and Lavenberg, "Mean-Value Analysis of Closed Multichain
/// Queuing Networks", Journal of the ACM 27, 1980), several by Seidmann's transformation (Seidmann, Schweitzer and
/// Shalev-Oren, "Computerized Closed Queueing Network Models of Flexible Manufacturing Systems", Large Scale Systems 12,
/// 1987): one server that is as fast as all cores, and a delay for the rest of a request's time. With exponential
/// service times that is exact for one core and for one robot, and nearly so when all cores are busy; between, the tests
/// find it within a fifth of the exact response time.
pub fn machine_repair(robots: u64, cores: f64, service: f64, think: f64) -> Closed {
    Analysis::new(cores, service, think)
        .take(robots.try_into().unwrap_or(usize::MAX))
        .last()
        .unwrap_or(Closed {
            response: service / cores.min(1.0),
            throughput: 0.0,
            busy: 0.0,
        })
}

/// The response time of [`machine_repair`], seconds.
pub fn response(robots: u64, cores: f64, service: f64, think: f64) -> f64 {
    machine_repair(robots, cores, service, think).response
}

/// How many robots a node can serve, of `robots`, so that their mean response time is at most `t_max` seconds.
pub fn robots_per_node(robots: u64, cores: f64, service: f64, think: f64, t_max: f64) -> u64 {
    Analysis::new(cores, service, think)
        .take(robots.try_into().unwrap_or(usize::MAX))
        .take_while(|closed| closed.response <= t_max)
        .count() as u64
}

/// How many nodes of `cores_per_node` serve `robots` so that their mean response time is at most `t_max` seconds, if
/// each node has its own robots. `u64::MAX` if no number of nodes does, because one robot alone waits longer.
pub fn nodes_needed(robots: u64, cores_per_node: f64, service: f64, think: f64, t_max: f64) -> u64 {
    match robots_per_node(robots, cores_per_node, service, think, t_max) {
        _ if robots == 0 => 0,
        0 => u64::MAX,
        each => robots.div_ceil(each),
    }
}

/// The recurrence of Mean Value Analysis: the results for one robot, two, and so on.
struct Analysis {
    /// Seconds at the server for each request.
    queued: f64,
    /// Seconds of a request's service during which it keeps nobody waiting.
    beside: f64,
    think: f64,
    robots: f64,
    /// Requests at the server, on average.
    length: f64,
}

impl Analysis {
    fn new(cores: f64, service: f64, think: f64) -> Self {
        Self {
            queued: service / cores,
            beside: service * (cores - 1.0).max(0.0) / cores,
            think,
            robots: 0.0,
            length: 0.0,
        }
    }
}

impl Iterator for Analysis {
    type Item = Closed;

    fn next(&mut self) -> Option<Closed> {
        self.robots += 1.0;
        // Who arrives finds what the queue is without them.
        let at_server = self.queued * (1.0 + self.length);
        let response = at_server + self.beside;
        let throughput = self.robots / (response + self.think);
        self.length = throughput * at_server;
        Some(Closed {
            response,
            throughput,
            busy: throughput * self.queued,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::near;
    use super::*;

    /// Half busy, service of 1 s: M/M/1 waits 1 s, M/D/1 half of that.
    #[test]
    fn waiting_follows_pollaczek_and_khinchine() {
        near(waiting_time(0.5, 1.0, 1.0), 1.0);
        near(waiting_time(0.5, 1.0, 0.0), 0.5);
        assert_eq!(waiting_time(1.0, 1.0, 0.0), f64::INFINITY);
        assert_eq!(waiting_time(0.0, 1.0, 1.0), 0.0);
    }

    /// The birth-death process of `robots` at `cores` servers with exponential times.
    fn birth_death(robots: u64, cores: u64, service: f64, think: f64) -> f64 {
        let mut weight = 1.0;
        let (mut all, mut throughput) = (1.0, 0.0);
        for at_node in 1..=robots {
            let busy = at_node.min(cores) as f64;
            weight *= (robots - at_node + 1) as f64 / think * service / busy;
            all += weight;
            throughput += weight * busy / service;
        }
        robots as f64 / (throughput / all) - think
    }

    /// Two robots, service and pause of 1 s, one core: the states' weights are 1, 2, 2, so four fifths of a request
    /// per second are answered and 2 / 0.8 − 1 = 1.5 s pass.
    #[test]
    fn one_core_is_exact() {
        let closed = machine_repair(2, 1.0, 1.0, 1.0);
        near(closed.response, 1.5);
        near(closed.throughput, 0.8);
        near(closed.busy, 0.8);
        for robots in [1, 3, 10, 40] {
            near(
                response(robots, 1.0, 0.2, 3.0),
                birth_death(robots, 1, 0.2, 3.0),
            );
        }
    }

    #[test]
    fn several_cores_are_near_the_exact_queue() {
        near(response(1, 4.0, 0.5, 2.0), 0.5);
        // All busy: 200 robots share what 4 cores answer.
        near(response(200, 4.0, 0.5, 2.0), 200.0 * 0.5 / 4.0 - 2.0);
        for (robots, cores) in [(4, 2), (10, 2), (20, 4), (40, 8)] {
            let (approximate, exact) = (
                response(robots, cores as f64, 0.5, 2.0),
                birth_death(robots, cores, 0.5, 2.0),
            );
            assert!(
                (approximate / exact - 1.0).abs() < 0.2,
                "{approximate} for {exact}"
            );
        }
        near(response(1, 0.25, 0.5, 2.0), 2.0);
        near(machine_repair(0, 2.0, 0.5, 2.0).response, 0.5);
    }

    /// One core, 1 s of service, 1 s of pause: one robot waits 1 s, two wait 1.5 s, three wait 1 + 0.8 · 1.5 = 2.2 s.
    #[test]
    fn nodes_are_counted() {
        near(response(3, 1.0, 1.0, 1.0), 2.2);
        assert_eq!(robots_per_node(100, 1.0, 1.0, 1.0, 1.6), 2);
        assert_eq!(nodes_needed(5, 1.0, 1.0, 1.0, 1.6), 3);
        assert_eq!(nodes_needed(100_000, 1.0, 1.0, 1.0, 2.2 + 1e-9), 33_334);
        assert_eq!(nodes_needed(5, 1.0, 1.0, 1.0, 0.5), u64::MAX);
        assert_eq!(nodes_needed(0, 1.0, 1.0, 1.0, 0.5), 0);
        assert_eq!(nodes_needed(7, 1.0, 1.0, 1.0, 1e9), 1);
    }
}
