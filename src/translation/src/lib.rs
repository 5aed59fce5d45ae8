//! Types and messages of one ROS in those of the other, so that a robot of ROS 1 can use a service of ROS 2 and the
//! reverse.
//!
//! Each type has a *twin* in the other ROS: the definition of it that is known there, or else one derived from its
//! fields. Pairs whose names or fields differ are described by [`TranslationRules`]: a built-in table, and rules of a
//! lab. A [`MessageTranslator`] carries serialized messages from one type to its twin, in one pass from bytes to bytes.
//!
//! ```text
//! type ── names, rules, derive ──▶ twin ── pairing ──▶ pairs of fields ── compile ──▶ program ── translate ──▶ bytes
//! ```
//!
//! What the other ROS cannot hold is treated by rule. Lengths beyond a bound of ROS 2 are refused. Numbers out of range
//! and times before 1970 (ROS 1 has none) or after 2038 (ROS 2 has none) become the nearest ones, and what is no
//! Unicode becomes U+FFFD; [`MessageTranslator::saturated_count`] counts them. `Header.seq` is left out towards ROS 2
//! and 0 towards ROS 1.

#![forbid(unsafe_code)]

pub mod bus;
mod compile;
mod derive;
mod error;
mod names;
mod number;
mod output;
mod pairing;
mod program;
mod rules;
mod shape;
mod stamp;
mod text;
mod translator;
mod twins;

#[cfg(test)]
mod tests;

pub use error::{NoTwin, NoTwinReason, TranslationError, UnlikeFields};
pub use rules::{RuleError, TranslationRules};
pub use translator::MessageTranslator;
pub use twins::{ActionTwin, MessageTwin, ServiceTwin, TypeTranslations};
