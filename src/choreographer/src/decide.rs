//! Decides which servants live, where and with what, by pure functions: of what is, of what is asked, and of the time, to what
//! is to be done, with the reason. None reads a clock, holds a lock or waits, and all types are plain data. The tasks of
//! [`crate::lives`] collect the facts, ask, and carry the answer out.
//!
//! | file | decides | from |
//! |---|---|---|
//! | [`demand`] | what a servant gets and is promised | the limits that were asked for; what is set aside without |
//! | [`dictionary`] | which row of a service's dictionary a goal of an SLA takes | rows, auxiliary parameters, caps |
//! | [`measured`] | auxiliary parameters of a robot that does not state them | how large what it sends is, the keys of rows |
//! | [`told`] | which refusals are told of | when which robots were refused |
//! | [`terms`] | which limits a robot's servant is promised | what the robot states, classes, the service, caps |
//! | [`placement`] | which servant a robot is given, and which one ends for it | its servant, the published revision, the warm pool |
//! | [`admission`] | who is admitted, waits or is refused; whether a promise may change | capacity, promises, the queue and its priorities |
//! | [`capacity`] | which idle servants end for those who wait, which pushes give way | what they lack, all servants |
//! | [`stall`] | whether the machine admits anybody | what the kernel tells of memory and swap |
//! | [`controller`] | `cpu.max` and `cpu.weight` of servants at work | promises, measured times, what is used and held up |
//! | [`fit`] | whether one more servant would fit, and what that costs | the same as admission; what others use |
//! | [`shares`] | who gets how much of what does not suffice | a floor and a wish of each |
//! | [`lifetime`] | whether a servant can be used, and whether it is still needed | its stage, its interface, its connections, the time |
//! | [`nodes`] | restart, go on or fail when a node has ended | how it ended, how often before, the nodes left |
//! | [`calibration`] | at which limits a service is measured, and which rows of the dictionary follow | what was measured |
//! | [`group`] | how many servants answer the robots that share a service | their requests, how long these take, bounds, the time |
//! | [`back_off`] | when a servant that failed may be started again | how often in a row, how long it was ready |
//! | [`rollout`] | which robots a new revision serves first, when it is taken back or promoted | its terms, what was seen of both revisions |
//! | [`requests`] | on which topics robots ask and are answered | the interface |
//! | [`shadow`] | what a candidate answers as the present revision does, and what not | the answers of both, what may differ |
//! | [`hung`] | whether nodes hang | what went to them and came from them, T_max |
//! | [`warm_pool`] | how many containers each service has ahead, in which the nodes run, which end | what is published, what was asked for last, the forecast, a budget |
//! | [`forecast`] | how many robots are about to ask | when robots asked |
//! | [`adoption`] | what becomes of a container that an earlier daemon left | what the database says of it |
//!
//! What is decided under the choreographer's lock, or the queue's, is recorded under the same lock.

pub(crate) mod admission;
pub(crate) mod adoption;
mod amount;
pub(crate) mod back_off;
pub(crate) mod calibration;
pub(crate) mod capacity;
pub mod controller;
pub(crate) mod demand;
pub(crate) mod dictionary;
pub(crate) mod fit;
pub(crate) mod forecast;
pub(crate) mod group;
pub(crate) mod hung;
pub(crate) mod lifetime;
pub(crate) mod measured;
pub(crate) mod nodes;
pub(crate) mod placement;
pub(crate) mod requests;
pub(crate) mod rollout;
pub(crate) mod shadow;
mod shares;
mod sketch;
pub(crate) mod stall;
pub(crate) mod terms;
pub(crate) mod told;
pub(crate) mod warm_pool;

#[cfg(test)]
mod properties;

use api::Millis;

pub use amount::Amount;

/// A servant that lives, as decisions about several of them see it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Servant<'a> {
    /// Its id.
    pub(crate) id: &'a str,
    /// The revision that it was started from.
    pub(crate) revision: u64,
    /// Connections that use it.
    pub(crate) connections: usize,
    /// What it is promised; none before it is admitted.
    pub(crate) promised: Option<Amount>,
    /// When it is ended if nobody connects before; none where somebody is connected.
    pub(crate) idle_until: Option<Millis>,
    /// Its end has been asked for.
    pub(crate) ending: bool,
}

/// A servant, or a container of the warm pool, is to end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct End<'a> {
    /// Its id.
    pub(crate) id: &'a str,
    /// The reason, for people.
    pub(crate) reason: &'static str,
}
