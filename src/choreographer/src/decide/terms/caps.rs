//! Caps on what a robot may have, and their sources.

use std::fmt;

use api::dictionary::Row;
use api::{Caps, Size, Stated};

use super::{Offer, TermsError};
use crate::decide::dictionary::DictionaryView;
use crate::options::{ClassOptions, DEFAULT_CLASS};

/// Source of a cap.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CapSource {
    /// A class, by its `max_cpus` or `max_memory`.
    Class(String),
    /// A service, by its push.
    Service(String),
    /// The machine, by its capacity for servants.
    Machine,
}

/// A cap on one resource, and its source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cap {
    /// `cpus` or `memory`.
    pub resource: &'static str,
    /// The maximum, as written in configuration.
    pub most: String,
    /// Source of the cap.
    pub by: CapSource,
}

impl fmt::Display for Cap {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Cap { resource, most, by } = self;
        match by {
            CapSource::Class(name) => {
                write!(out, "{most}, the max_{resource} of class {name} ([class.{name}] of the configuration)")
            }
            CapSource::Service(name) => {
                write!(out, "{most}, the --max-{resource} with which {name} was pushed")
            }
            CapSource::Machine => write!(out, "{most}, this machine's capacity for servants"),
        }
    }
}

/// The tighter caps of a class and a service, each with its source.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct RobotCaps {
    cpus: Option<(f64, Cap)>,
    memory: Option<(Size, Cap)>,
}

impl RobotCaps {
    /// Returns the caps of a robot of this class.
    pub(super) fn for_class(class: Option<(&str, &ClassOptions)>, offer: &Offer<'_>) -> RobotCaps {
        let caps = class.map_or(Caps::default(), |(_, class)| class.caps);
        let by_class = || {
            let name = class.map_or(DEFAULT_CLASS, |(name, _)| name);
            CapSource::Class(name.to_owned())
        };
        let by_service = || CapSource::Service(offer.service.to_owned());
        let cap = |resource, most: String, by| Cap { resource, most, by };
        let cpus = match (caps.cpus, offer.caps.cpus) {
            (Some(most), service) if service.is_none_or(|service| most <= service) => {
                Some((most, cap("cpus", most.to_string(), by_class())))
            }
            (_, service) => service.map(|most| (most, cap("cpus", most.to_string(), by_service()))),
        };
        let memory = match (caps.memory, offer.caps.memory) {
            (Some(most), service) if service.is_none_or(|service| most <= service) => {
                Some((most, cap("memory", most.to_string(), by_class())))
            }
            (_, service) => service.map(|most| (most, cap("memory", most.to_string(), by_service()))),
        };
        RobotCaps { cpus, memory }
    }

    /// Refuses explicitly stated resources that exceed a cap.
    pub(super) fn check(&self, stated: &Stated) -> Result<(), TermsError> {
        let capped = |asked: String, cap: &Cap| {
            let cap = Box::new(cap.clone());
            Err(TermsError::Capped { asked, cap })
        };
        match (stated.cpus, &self.cpus) {
            (Some(asked), Some((most, cap))) if asked > *most => {
                return capped(asked.to_string(), cap);
            }
            _ => {}
        }
        match (stated.memory, &self.memory) {
            (Some(asked), Some((most, cap))) if asked > *most => capped(asked.to_string(), cap),
            _ => Ok(()),
        }
    }

    /// Returns the cap that a row exceeds; `None` if the row is affordable.
    pub(super) fn exceeded_by(&self, row: &Row, shelf: &DictionaryView<'_>) -> Option<Cap> {
        if let (Some(cpus), Some((most, cap))) = (row.limits.cpus, &self.cpus)
            && cpus > *most
        {
            return Some(cap.clone());
        }
        if let (Some(memory), Some((most, cap))) = (row.limits.memory, &self.memory)
            && memory > *most
        {
            return Some(cap.clone());
        }
        let (amount, capacity) = (shelf.amount(row), shelf.capacity);
        let machine = |resource, most| Cap { resource, most, by: CapSource::Machine };
        if amount.millicpus > capacity.millicpus {
            return Some(machine("cpus", capacity.cpus().to_string()));
        }
        (amount.memory > capacity.memory).then(|| machine("memory", Size(capacity.memory).to_string()))
    }
}
