//! Build of an image from a pushed package.
//!
//! ```text
//!              base definition (images/NAME.toml)
//!                       │
//!    mmdebstrap ──▶  base layer ◀────────────── cache, by key of inputs ──────────────┐
//!                       │                                                             │
//!    apt, dpkg  ──▶  dependency layers ◀── package.xml, Contents index, ELF files ────┤
//!                       │                                                             │
//!  catkin, colcon ▶  package layer ◀────── sources, compiled in a sandbox ────────────┘
//!                       │
//!    launch     ──▶  launch plan ──▶ started once by the caller ──▶ probe ──▶ interface
//! ```
//!
//! Input: a [`PushRequest`]. Output: a [`BuildOutcome`] with an untagged image in the store and a [`LaunchPlan`];
//! [`probe`] then finds the interface of the running image. All foreign code runs in containers without network; only
//! apt on the host uses the network. Cached parts are not built again: dependency layers are stacked in chains, and
//! packages of a workspace are compiled separately. The same inputs give the same layers; if some of the dependencies
//! are cached, the same files, possibly divided into other layers.

#![forbid(unsafe_code)]

mod advice;
mod apt;
mod archive;
pub mod base;
mod base_file_error;
pub mod blocking;
mod bootstrap;
mod build;
mod builder;
mod cache;
mod cache_cleanup;
mod candidates;
mod cause;
mod chain;
mod choice;
mod compile;
mod complaint;
mod contents;
mod deb;
mod debian_package;
mod elf;
mod error;
mod event;
mod excerpt;
mod gather;
mod imported;
mod imports;
mod indexed;
mod inspect;
mod install;
mod key;
mod keys;
mod launch;
mod lines;
mod manifest;
mod merge;
mod middleware;
mod missing_modules;
mod modes;
mod needs;
mod packaged;
mod packings;
mod plan;
mod prebuilt;
pub mod probe;
mod process;
mod pushed_packages;
mod removal;
mod request;
mod requirements;
mod sandbox;
mod seal;
mod source;
mod sources;
mod spelling;
mod split;
mod steps;
mod stock;
mod underlay;
mod units;
mod wheels;
mod workshop;

pub use apt::Sources;
pub use base::{DEFAULT_BASE, Finding, ImportedImage};
pub use builder::{Builder, Config};
pub use cause::{find_build_cause, find_exit_cause};
pub use error::{Error, Unresolved};
pub use event::BuildEvent;
pub use imported::{BaseImport, ImportSource};
pub use inspect::InspectedPush;
pub use launch::{LaunchNode, LaunchPlan};
pub use middleware::MiddlewareError;
pub use plan::find_components_problem;
pub use request::{BuildOutcome, BuildResult, BuiltLayer, BuiltUnderlay, PushRequest, PushSource};
pub use stock::{BaseReport, BaseStock, ExportedBase};
pub use underlay::{NamedUnderlay, UnderlayContents, UnderlayLayer};
