//! Data model of what a deployer pushes. Reads files and has no other side effects.
//!
//! ```text
//!   directory ──workspace::inspect──▶ PushedDirectory: packages in build order │ an install space
//!                 package.xml ──manifest──▶ Manifest (conditions evaluated)
//!   sources ──selection──▶ packages that are built
//!   sources ──foreseen──▶ programs and launch files that can be found
//!   layers ──inventory::scan──▶ install spaces, packages, programs, definitions
//!   layers of an image ──system::find_system──▶ distribution, ROS, what packages can be built with
//!   running package, supplement ──interface──▶ Interface, compared by difference
//!   interface, observed answers ──requests──▶ which outputs answer which input
//!   interface ──twins──▶ the interface as robots of the other ROS see it
//!   layers, inventory, interface ──stub──▶ the files that a robot installs instead of the package
//! ```
//!
//! All input is untrusted: names are validated before they are used in a path or a command, sizes are bounded, and no
//! symbolic link is followed out of the tree that is read.

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
pub mod provided;
mod read;
mod request;
pub mod requests;
pub mod selection;
pub mod stub;
mod supplement;
pub mod system;
mod twins;
pub mod workspace;
pub mod xml;

pub use error::Error;
