//! Decides which servants live, where and with what, by pure functions of the current state, the request and the time;
//! they return what is to be done, with the reason. None of them reads a clock, holds a lock or waits, and all types
//! are plain data. The tasks of [`crate::lives`] collect the facts, call these functions, and carry the decisions out.
//!
//! | module | decides |
//! |---|---|
//! | [`demand`] | the limits of a servant and its promise |
//! | [`dictionary`] | which row of a service's dictionary a goal of an SLA takes |
//! | [`measured`] | auxiliary parameters of a robot that does not state them, from the size of its messages |
//! | [`told`] | which refusals are reported |
//! | [`terms`] | the limits promised to a robot's servant |
//! | [`placement`] | which servant a robot gets, and which one ends for it |
//! | [`admission`] | who is admitted, waits or is refused; whether a promise may change |
//! | [`capacity`] | which idle servants end, and which pushes give way, for waiting requests |
//! | [`stall`] | whether the machine stalls and admits nobody, from the kernel's memory pressure |
//! | [`controller`] | `cpu.max` and `cpu.weight` of running servants |
//! | [`fit`] | whether one more servant would fit, and what that costs |
//! | [`shares`] | max-min fair shares of a scarce resource |
//! | [`lifetime`] | whether a servant can be used, and whether it is still needed |
//! | [`nodes`] | restart, continue or fail after the exit of a node |
//! | [`calibration`] | at which limits a service is measured, and which dictionary rows follow |
//! | [`group`] | how many servants answer the robots that share a service |
//! | [`back_off`] | when a failed servant may be started again |
//! | [`rollout`] | which robots get a new revision first; when it is rolled back or promoted |
//! | [`requests`] | on which topics robots send requests and receive answers |
//! | [`shadow`] | in what the answers of a candidate differ from the present revision's |
//! | [`hung`] | whether nodes hang |
//! | [`warm_pool`] | how many containers each service has in advance, which of them have nodes, which end |
//! | [`forecast`] | how many robots are about to ask |
//! | [`adoption`] | the fate of a container that an earlier daemon left |
//! | [`quota`] | which files are removed for a new one, where services share a quota |
//!
//! A decision made under the choreographer's lock, or the admission queue's, is recorded under the same lock.

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
pub(crate) mod quota;
pub(crate) mod refusal_reports;
pub(crate) mod requests;
pub(crate) mod rollout;
pub(crate) mod shadow;
mod shares;
mod sketch;
pub(crate) mod stall;
pub(crate) mod terms;
pub(crate) mod warm_pool;

#[cfg(test)]
mod properties;

use api::Millis;

pub use amount::Amount;

/// A live servant, as seen by decisions about several servants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ServantFacts<'a> {
    /// Id of the servant.
    pub(crate) id: &'a str,
    /// Revision that it was started from.
    pub(crate) revision: u64,
    /// Number of connections to it.
    pub(crate) connections: usize,
    /// Capacity promised to it; `None` before it is admitted.
    pub(crate) promised: Option<Amount>,
    /// Time at which it is ended unless a client connects; `None` while one is connected.
    pub(crate) idle_until: Option<Millis>,
    /// The end of the servant has been requested.
    pub(crate) ending: bool,
}

/// Order to end a servant or a container of the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StopOrder<'a> {
    /// Id of the servant or container.
    pub(crate) id: &'a str,
    /// Human-readable reason.
    pub(crate) reason: &'static str,
}
