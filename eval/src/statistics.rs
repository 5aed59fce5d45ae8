//! Statistics of the report, each by a published method and tested with numbers computed by hand.
//!
//! Functions return `None` for empty input and for NaN. Infinite values, such as the response time of a request that
//! was never answered, keep their rank in quantiles.

mod figures;
mod models;
mod paths;
mod queues;

pub use bench_report::{median, quantile};
pub use figures::{Spread, mean, root_mean_square_error, standard_deviation};
pub use models::RrtModel;
pub use paths::{TrajectoryError, trajectory_error};
pub use queues::{NodeModel, QueueObservation};

#[cfg(test)]
#[track_caller]
fn assert_near(one: f64, other: f64) {
    assert!((one - other).abs() < 1e-9 * (1.0 + other.abs()), "{one} is not {other}");
}
