//! Types and messages of one ROS in those of the other, so that a robot of ROS 1 can use a service of ROS 2 and the
//! reverse.
//!
//! Each type has a *twin* in the other ROS: the definition of it that is known there, or else one derived from its
//! fields. Pairs of twins whose fields do not agree are described by [`TranslationRules`]: a built-in table, and rules
//! of a lab. A [`MessageTranslator`] carries serialized messages from one type to its twin.
//!
//! ```text
//! type ── rules: names, definitions ──▶ twin ── pairing: fields ──▶ program: steps ── translate ──▶ bytes of the twin
//! ```

mod error;
mod rules;
mod translator;
mod twins;

pub use error::{NoTwin, NoTwinReason, TranslationError};
pub use rules::{RuleError, TranslationRules};
pub use translator::MessageTranslator;
pub use twins::{ActionTwin, MessageTwin, ServiceTwin, TypeTranslations};
