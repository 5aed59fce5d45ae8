//! What the report computes from measurements, each by a published method and tested on numbers worked out by hand.
//!
//! Functions of no values, or of values that are not numbers, return none. Infinite values, such as the response time
//! of a request that was never answered, keep their place in quantiles.

use std::iter::repeat_n;

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2000;
/// Geometric steps in which [`RrtModel::fit`] looks for the number of useful cores.
const STEPS: u32 = 400;

/// The arithmetic mean.
pub fn mean(values: &[f64]) -> Option<f64> {
    let sum: f64 = values.iter().sum();
    (!values.is_empty() && !sum.is_nan()).then(|| sum / values.len() as f64)
}

/// The standard deviation of a sample: the sum of squares is divided by n − 1 (Bessel's correction). None of fewer than
/// two values.
pub fn standard_deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|mean| mean.is_finite())?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// The value that a fraction `0.0..=1.0` of the values stays below, between two values by linear interpolation: type 7
/// of Hyndman and Fan, "Sample Quantiles in Statistical Packages", The American Statistician 50 (1996).
pub fn quantile(values: &[f64], fraction: f64) -> Option<f64> {
    of_sorted(&sorted(values)?, fraction)
}

/// The quantile of one half.
pub fn median(values: &[f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The values in ascending order; none if one is not a number.
fn sorted(values: &[f64]) -> Option<Vec<f64>> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    (!sorted.iter().any(|value| value.is_nan())).then_some(sorted)
}

fn of_sorted(sorted: &[f64], fraction: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let place = fraction.clamp(0.0, 1.0) * last as f64;
    let lower = *sorted.get(place.floor() as usize)?;
    let upper = *sorted.get(place.ceil() as usize)?;
    // The difference of two infinite values is not a number.
    Some(if lower == upper || place.fract() == 0.0 {
        lower
    } else {
        lower + (upper - lower) * place.fract()
    })
}

/// The confidence interval of the median, low and high, by the percentile bootstrap (Efron and Tibshirani, "An
/// Introduction to the Bootstrap", 1993, chapter 13). `confidence` is between 0 and 1, such as 0.95. The same values
/// give the same interval.
pub fn median_interval(values: &[f64], confidence: f64) -> Option<(f64, f64)> {
    let values = sorted(values)?;
    let mut random = Xorshift(0x9e37_79b9_7f4a_7c15);
    let mut medians = Vec::with_capacity(RESAMPLES);
    for _ in 0..RESAMPLES {
        let mut drawn = vec![0; values.len()];
        for _ in 0..values.len() {
            drawn[random.below(values.len())] += 1;
        }
        let times = values.iter().zip(drawn);
        let resample: Vec<f64> = times
            .flat_map(|(value, times)| repeat_n(*value, times))
            .collect();
        medians.push(of_sorted(&resample, 0.5)?);
    }
    let outside = (1.0 - confidence) / 2.0;
    Some((
        quantile(&medians, outside)?,
        quantile(&medians, 1.0 - outside)?,
    ))
}

/// The generator xorshift64* of Vigna, "An experimental exploration of Marsaglia's xorshift generators, scrambled",
/// ACM Transactions on Mathematical Software 42 (2016).
struct Xorshift(u64);

impl Xorshift {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    /// A number below `limit`, which is small: its bias is not noticed.
    fn below(&mut self, limit: usize) -> usize {
        ((u128::from(self.next()) * limit as u128) >> 64) as usize
    }
}

/// A straight line, and how well it describes the points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Units of y for each unit of x.
    pub slope: f64,
    /// y where x is nothing.
    pub intercept: f64,
    /// The share of the variance of y that the line explains, 0 to 1 (coefficient of determination).
    pub r2: f64,
}

/// The line through (x, y) with the least sum of squared vertical distances. None unless there are two different x.
pub fn least_squares(points: &[(f64, f64)]) -> Option<Line> {
    let of = |which: fn(&(f64, f64)) -> f64| mean(&points.iter().map(which).collect::<Vec<_>>());
    let (x, y) = (of(|point| point.0)?, of(|point| point.1)?);
    let sum = |term: &dyn Fn(f64, f64) -> f64| -> f64 {
        points
            .iter()
            .map(|point| term(point.0 - x, point.1 - y))
            .sum()
    };
    let (xx, xy, yy) = (
        sum(&|dx, _| dx * dx),
        sum(&|dx, dy| dx * dy),
        sum(&|_, dy| dy * dy),
    );
    (xx > 0.0 && yy.is_finite()).then(|| Line {
        slope: xy / xx,
        intercept: y - xy / xx * x,
        // A line through points of one height leaves nothing unexplained.
        r2: if yy > 0.0 { xy * xy / (xx * yy) } else { 1.0 },
    })
}

/// The root of the mean squared difference of pairs, such as (predicted, measured), in their unit.
pub fn root_mean_square_error(pairs: &[(f64, f64)]) -> Option<f64> {
    let squares: Vec<f64> = pairs.iter().map(|pair| (pair.0 - pair.1).powi(2)).collect();
    mean(&squares).map(f64::sqrt)
}

/// Where a response time was measured, and what it was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Cores that the computation may use.
    pub cores: f64,
    /// Round trip of the network, seconds.
    pub round_trip: f64,
    /// Bytes of a request on the network.
    pub bytes_up: f64,
    /// Bytes of its answer on the network.
    pub bytes_down: f64,
    /// Rate of the network, bit/s; infinite where there is none.
    pub rate: f64,
    /// The response time that was measured, seconds; [`RrtModel::predict`] does not look at it.
    pub rrt: f64,
}

impl Point {
    /// Seconds on the network: the round trip, and the time to send the bytes.
    fn network(&self) -> f64 {
        self.round_trip + 8.0 * (self.bytes_up + self.bytes_down) / self.rate
    }
}

/// What a request takes: `overhead` + round trip + bytes / rate + `work` / min(cores, `parallel`).
///
/// The computation's term is the greater of the two bounds on parallel work, its sum over the cores and its longest chain
/// (Cormen et al., "Introduction to Algorithms", third edition, 2009, section 27.1). A model is that of one program;
/// another program has other work.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RrtModel {
    /// Seconds that neither the network nor more cores change.
    pub overhead: f64,
    /// Core seconds of computation for each request.
    pub work: f64,
    /// Cores at which more cores give nothing. At most the greatest number that was measured, because no measurement
    /// tells what more would give: then predictions for more cores are cautious.
    pub parallel: f64,
}

impl RrtModel {
    /// The model with the least sum of squared differences to the measured times, over a grid of `parallel`; overhead
    /// and work are not negative. Of equally good ones, that with the greatest `parallel`. None unless three usable
    /// points with at least two numbers of cores are given: otherwise overhead and work cannot be told apart.
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

    /// The response time at a point, seconds.
    pub fn predict(&self, point: &Point) -> f64 {
        self.overhead + point.network() + self.work / point.cores.min(self.parallel)
    }
}

/// Intercept and slope of least squares that are not negative: the free optimum if it is one, else the better edge
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

/// How far an estimated trajectory is from the true one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrajectoryError {
    /// Root of the mean squared distance, metres.
    pub rmse: f64,
    /// The greatest distance, metres.
    pub max: f64,
    /// Poses of the estimate that could be compared.
    pub count: usize,
}

/// The absolute trajectory error of poses (seconds, x, y in metres), as Sturm et al., "A Benchmark for the Evaluation of
/// RGB-D SLAM Systems", IROS 2012, define it. The truth is interpolated linearly at the times of the estimate, poses
/// outside its time are not compared; the estimate is then turned and moved, without scale, so that the squares of the
/// distances are least (Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns",
/// IEEE PAMI 13, 1991, in the plane). None of fewer than two poses.
pub fn trajectory_error(
    estimate: &[(f64, f64, f64)],
    truth: &[(f64, f64, f64)],
) -> Option<TrajectoryError> {
    let finite =
        |pose: &&(f64, f64, f64)| pose.0.is_finite() && pose.1.is_finite() && pose.2.is_finite();
    let mut truth: Vec<(f64, f64, f64)> = truth.iter().filter(finite).copied().collect();
    truth.sort_by(|one, other| one.0.total_cmp(&other.0));
    let pairs: Vec<[(f64, f64); 2]> = estimate
        .iter()
        .filter(finite)
        .filter_map(|pose| Some([(pose.1, pose.2), interpolated(&truth, pose.0)?]))
        .collect();
    if pairs.len() < 2 {
        return None;
    }
    let centre = |which: usize| {
        let sum = pairs.iter().fold((0.0, 0.0), |sum, pair| {
            (sum.0 + pair[which].0, sum.1 + pair[which].1)
        });
        (sum.0 / pairs.len() as f64, sum.1 / pairs.len() as f64)
    };
    let (from, to) = (centre(0), centre(1));
    let centred = |pair: &[(f64, f64); 2]| {
        let [one, other] = *pair;
        (
            (one.0 - from.0, one.1 - from.1),
            (other.0 - to.0, other.1 - to.1),
        )
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

/// Where a trajectory, sorted by time, is at a time within it.
fn interpolated(truth: &[(f64, f64, f64)], time: f64) -> Option<(f64, f64)> {
    let after = truth.partition_point(|pose| pose.0 < time);
    let next = truth.get(after)?;
    if next.0 == time {
        return Some((next.1, next.2));
    }
    let last = truth.get(after.checked_sub(1)?)?;
    let share = (time - last.0) / (next.0 - last.0);
    Some((
        last.1 + share * (next.1 - last.1),
        last.2 + share * (next.2 - last.2),
    ))
}

/// The peak signal-to-noise ratio of two pictures of eight-bit samples, dB: 10 lg(255² / mean squared error) (ITU-T
/// J.340). Infinite for equal ones; not a number for pictures of different sizes, or without samples.
pub fn psnr(a: &[u8], b: &[u8]) -> f64 {
    if a.len() != b.len() || a.is_empty() {
        return f64::NAN;
    }
    let squares: u64 = a
        .iter()
        .zip(b)
        .map(|(one, other)| u64::from(one.abs_diff(*other)).pow(2))
        .sum();
    let error = squares as f64 / a.len() as f64;
    10.0 * (255.0 * 255.0 / error).log10()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn near(one: f64, other: f64) {
        assert!(
            (one - other).abs() < 1e-9 * (1.0 + other.abs()),
            "{one} is not {other}"
        );
    }

    #[test]
    fn means_and_deviations() {
        // 2, 4, 4, 4, 5, 5, 7, 9: mean 5, sum of squares 32.
        let values = [2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0];
        assert_eq!(mean(&values), Some(5.0));
        near(
            standard_deviation(&values).expect("values"),
            (32.0f64 / 7.0).sqrt(),
        );
        assert_eq!(mean(&[]), None);
        assert_eq!(mean(&[1.0, f64::NAN]), None);
        assert_eq!(standard_deviation(&[1.0]), None);
        assert_eq!(standard_deviation(&[1.0, f64::INFINITY]), None);
    }

    #[test]
    fn quantiles_are_interpolated() {
        let values = [40.0, 10.0, 30.0, 20.0];
        assert_eq!(median(&values), Some(25.0));
        // (4 − 1) · 0.9 = 2.7: seven tenths of the way from 30 to 40.
        near(quantile(&values, 0.9).expect("values"), 37.0);
        assert_eq!(quantile(&values, 0.0), Some(10.0));
        assert_eq!(quantile(&values, 1.0), Some(40.0));
        assert_eq!(quantile(&[7.0], 0.3), Some(7.0));
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!(median(&[1.0, f64::NAN]), None);
    }

    #[test]
    fn unanswered_requests_keep_their_place_in_quantiles() {
        let values = [1.0, f64::INFINITY, 2.0, f64::INFINITY];
        assert_eq!(quantile(&values, 0.9), Some(f64::INFINITY));
        assert_eq!(quantile(&values, 1.0 / 3.0), Some(2.0));
        assert_eq!(median(&values), Some(f64::INFINITY));
    }

    /// For the median of 1…100 the interval by order statistics (binomial) is from the 40th to the 61st value.
    #[test]
    fn the_medians_interval_is_that_of_order_statistics() {
        let values: Vec<f64> = (1..=100).map(f64::from).collect();
        let (low, high) = median_interval(&values, 0.95).expect("values");
        assert!((38.0..=43.0).contains(&low), "{low}");
        assert!((58.0..=63.0).contains(&high), "{high}");
        assert_eq!(median_interval(&values, 0.95), Some((low, high)));
        assert_eq!(median_interval(&[3.0, 3.0], 0.95), Some((3.0, 3.0)));
        assert_eq!(median_interval(&[], 0.95), None);
    }

    #[test]
    fn a_line_is_fitted() {
        // Means 2 and 4: Σdx² = 2, Σdx·dy = 3, Σdy² = 6.
        let line = least_squares(&[(1.0, 2.0), (2.0, 5.0), (3.0, 5.0)]).expect("two x");
        near(line.slope, 1.5);
        near(line.intercept, 1.0);
        near(line.r2, 9.0 / (2.0 * 6.0));
        assert_eq!(least_squares(&[(1.0, 2.0), (1.0, 3.0)]), None);
        assert_eq!(least_squares(&[]), None);
        let level = least_squares(&[(0.0, 3.0), (1.0, 3.0)]).expect("two x");
        assert_eq!((level.slope, level.r2), (0.0, 1.0));
    }

    #[test]
    fn errors_are_squared() {
        // Differences 3 and −4: √(25 / 2).
        let error = root_mean_square_error(&[(5.0, 2.0), (1.0, 5.0)]).expect("pairs");
        near(error, 12.5f64.sqrt());
        assert_eq!(root_mean_square_error(&[]), None);
    }

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
        near(
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
        near(model.parallel, 2.0);
        near(model.work, 1.0);
        near(model.predict(&point(16.0, 8e6, 0.0)), rrt(2.0));
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

    /// A path like an eight, not symmetrical.
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
            let moved: Vec<_> = path()
                .into_iter()
                .map(|(t, x, y)| (t, cos * x - sin * y + 12.0, sin * x + cos * y - 7.0))
                .collect();
            let error = trajectory_error(&moved, &path()).expect("poses");
            assert!(error.rmse < 1e-9 && error.max < 1e-9, "{error:?}");
            assert_eq!(error.count, 200);
        }
    }

    /// A square of 2 m whose estimate is a square of 4 m: no turn or move helps, each corner is √2 m away.
    #[test]
    fn scale_is_an_error() {
        let square = |half: f64| {
            [
                (0.0, -half, -half),
                (1.0, half, -half),
                (2.0, half, half),
                (3.0, -half, half),
            ]
        };
        let error = trajectory_error(&square(2.0), &square(1.0)).expect("poses");
        near(error.rmse, 2.0f64.sqrt());
        near(error.max, 2.0f64.sqrt());
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

    #[test]
    fn noise_is_in_decibels() {
        // Mean squared error (1 + 9) / 2 = 5: 10 lg(65025 / 5) = 41.1411 dB.
        assert!((psnr(&[10, 20], &[11, 17]) - 41.1411).abs() < 1e-3);
        near(psnr(&[0, 0], &[255, 255]), 0.0);
        assert_eq!(psnr(&[1, 2], &[1, 2]), f64::INFINITY);
        assert!(psnr(&[1], &[1, 2]).is_nan() && psnr(&[], &[]).is_nan());
    }
}
