//! Observers of a servant's ROS: they hear topics beside its robot, as these come and go, and publish nothing.
//!
//! ```text
//!   bus ──▶ follow: a subscription for each topic that is wanted ─┬─▶ black box: the last seconds ──▶ MCAP file
//!                                                                 ├─▶ figures: rate, bandwidth and latency of topics
//!                                                                 └─▶ goals: what became of each goal of an action
//! ```

#![forbid(unsafe_code)]

mod black_box;
mod figures;
mod follow;
mod goals;
mod numbered;
mod ring;

pub use black_box::{BlackBox, BoxOptions, Frozen};
pub use figures::{Figures, TopicFigures};
pub use follow::{Followed, Seen};
pub use goals::{Goal, Goals, Outcome, Sender};
