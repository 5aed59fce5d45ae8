//! What the report computes from measurements, each by a published method and tested on numbers worked out by hand.
//!
//! Functions of no values, or of values that are not numbers, return none. Infinite values, such as the response time
//! of a request that was never answered, keep their place in quantiles.

mod figures;
mod models;
mod paths;
mod pictures;
mod queues;
mod random;

pub use figures::{
    Line, least_squares, mean, median, median_interval, quantile, root_mean_square_error,
    standard_deviation,
};
pub use models::{Point, RrtModel};
pub use paths::{TrajectoryError, trajectory_error};
pub use pictures::psnr;
pub use queues::{Closed, Node, Observed, machine_repair, response, robots_per_node};
pub use random::Xorshift;

#[cfg(test)]
#[track_caller]
fn near(one: f64, other: f64) {
    assert!(
        (one - other).abs() < 1e-9 * (1.0 + other.abs()),
        "{one} is not {other}"
    );
}
