//! What a robot may have at most, and who says so.

use std::fmt;

use api::dictionary::Row;
use api::{Caps, Size, Stated};

use super::{Offer, Untenable};
use crate::decide::dictionary::Shelf;
use crate::options::{Class, DEFAULT_CLASS};

/// Who bounds what a robot may ask for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Capper {
    /// A class, by its `max_cpus` or `max_memory`.
    Class(String),
    /// A service, by its push.
    Service(String),
    /// The machine, by what it has for servants.
    Machine,
}

/// A bound of one resource, and whose it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cap {
    /// `cpus` or `memory`.
    pub resource: &'static str,
    /// The most, as it is written.
    pub most: String,
    /// Who has set it.
    pub by: Capper,
}

impl fmt::Display for Cap {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Cap { resource, most, by } = self;
        match by {
            Capper::Class(name) => write!(
                out,
                "{most}, the max_{resource} of class {name} ([class.{name}] of the configuration)"
            ),
            Capper::Service(name) => {
                write!(
                    out,
                    "{most}, the --max-{resource} with which {name} was pushed"
                )
            }
            Capper::Machine => write!(out, "{most}, what this machine has for servants"),
        }
    }
}

/// The tighter bounds of a class and a service, each with whose it is.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Bounds {
    cpus: Option<(f64, Cap)>,
    memory: Option<(Size, Cap)>,
}

impl Bounds {
    /// Those of a robot of this class.
    pub(super) fn of(class: Option<(&str, &Class)>, offer: &Offer<'_>) -> Bounds {
        let caps = class.map_or(Caps::default(), |(_, class)| class.caps);
        let by_class = || {
            let name = class.map_or(DEFAULT_CLASS, |(name, _)| name);
            Capper::Class(name.to_owned())
        };
        let by_service = || Capper::Service(offer.service.to_owned());
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
            (_, service) => {
                service.map(|most| (most, cap("memory", most.to_string(), by_service())))
            }
        };
        Bounds { cpus, memory }
    }

    /// Refuses resources that are stated outright and are more than that.
    pub(super) fn check(&self, stated: &Stated) -> Result<(), Untenable> {
        let capped = |asked: String, cap: &Cap| {
            let cap = Box::new(cap.clone());
            Err(Untenable::Capped { asked, cap })
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

    /// What keeps a robot from having a row; none where it may.
    pub(super) fn against(&self, row: &Row, shelf: &Shelf<'_>) -> Option<Cap> {
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
        let machine = |resource, most| Cap {
            resource,
            most,
            by: Capper::Machine,
        };
        if amount.millicpus > capacity.millicpus {
            return Some(machine("cpus", capacity.cpus().to_string()));
        }
        (amount.memory > capacity.memory)
            .then(|| machine("memory", Size(capacity.memory).to_string()))
    }
}
