//! Runs the published experiments on one machine with real nodes and reports on them.
//!
//! ```text
//!  experiments ── run ──▶ results (target/eval/cells: raw data, one file per run)
//!                            │ evaluated by functions that are tested with known input
//!                            ▼
//!                         sections ──▶ report.html, report.json, one SVG per figure
//! ```
//! An interrupted evaluation continues where it stopped. The report lists what could not be measured, with the reason.

#![forbid(unsafe_code)]

pub mod application;
mod attempts;
pub mod basis;
pub mod cells;
pub mod deadline;
pub mod examples;
pub mod experiments;
pub mod interrupt;
mod network;
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
