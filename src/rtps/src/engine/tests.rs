//! Participants on a network made of queues.

mod delivery;
mod history;
mod liveliness;
mod matching;
mod world;
