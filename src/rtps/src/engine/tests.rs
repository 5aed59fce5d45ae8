//! Participants on a simulated network.

mod delivery;
mod history;
mod liveliness;
mod matching;
mod world;
