//! The published experiments on one machine, with real nodes, and a report of them.
//!
//! ```text
//!  experiments ── run ──▶ cells (target/eval/cells: raw, one file a run)
//!                            │ computed, by functions that are tested on known input
//!                            ▼
//!                         sections ──▶ report.html, report.json, one SVG a figure
//! ```
//! An evaluation that was cut off goes on where it stopped. What could not be measured is named in the report, with the reason.

#![forbid(unsafe_code)]

pub mod application;
mod attempts;
pub mod basis;
pub mod cells;
pub mod deadline;
pub mod estimate;
pub mod examples;
pub mod experiments;
pub mod interrupt;
pub mod page;
pub mod place;
pub mod plots;
pub mod recording;
pub mod rehearsal;
pub mod report;
pub mod robot;
pub mod section;
pub mod statistics;
pub mod stereo;
pub mod stream;
pub mod sweep;
pub mod trace;
mod weights;
pub mod words;
