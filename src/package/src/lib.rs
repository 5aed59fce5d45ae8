//! What a deployer pushes, as data. Reads files, does nothing else.
//!
//! ```text
//!   directory ──workspace::inspect──▶ Pushed: packages in build order │ an install space
//!                 package.xml ──manifest──▶ Manifest (conditions evaluated)
//!   sources ──foreseen──▶ programs and launch files, as far as they show
//!   layers ──inventory::take──▶ install spaces, packages, programs, definitions
//!   running package, supplement ──interface──▶ Interface, compared by difference
//!   interface, answers that were seen ──requests──▶ which input is answered by which outputs
//!   layers, inventory, interface ──stub──▶ the files that a robot installs in the package's place
//! ```
//!
//! Everything here is untrusted: names are checked before anyone puts them into a path or a command, sizes
//! are bounded, and no symbolic link leads out of the tree that is read.

#![forbid(unsafe_code)]

pub mod ament;
mod cmake;
pub mod condition;
pub mod definitions;
pub mod difference;
mod error;
pub mod fits;
pub mod foreseen;
mod install_space;
pub mod interface;
mod interface_toml;
pub mod interfaces;
pub mod inventory;
mod locate;
pub mod manifest;
mod merged;
pub mod names;
mod order;
mod read;
pub mod requests;
pub mod stub;
mod supplement;
pub mod workspace;

pub use error::Error;
