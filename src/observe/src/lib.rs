//! Observers of a servant's ROS: they subscribe to its topics beside its robot and publish nothing.
//!
//! ```text
//!   bus ──▶ follow: a subscription for each topic selected ─┬─▶ black box: the last seconds ──▶ MCAP file
//!                                                           ├─▶ figures: rate, bandwidth and latency of topics
//!                                                           └─▶ goals: outcome of each goal of an action
//! ```

#![forbid(unsafe_code)]

mod black_box;
mod figures;
mod follow;
mod goals;
mod id_map;
mod ring;

pub use black_box::{BlackBox, BlackBoxDump, BlackBoxSettings};
pub use figures::{Figures, TopicFigures};
pub use follow::{ObservedServant, ObserverTask};
pub use goals::{GoalMonitor, GoalSender, ObservedGoal, ObservedOutcome};
