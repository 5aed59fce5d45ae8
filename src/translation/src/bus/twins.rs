//! The twins of the types that a servant's nodes use.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{Digest, RosVersion, ServiceType, WireType};
use ros::schema::{MessageType, Registry, SchemaError};

use crate::{MessageTranslator, MessageTwin, NoTwin, ServiceTwin, TypeTranslations};

/// Maximum number of types remembered; beyond it they are found anew.
const MOST: usize = 4096;
/// Maximum number of definitions of one name that are remembered.
const MOST_OF_NAME: usize = 8;

/// Why something of a servant's bus is not shown to a robot of the other ROS.
#[derive(Debug, thiserror::Error)]
pub(super) enum Untranslatable {
    /// Nobody has told what the type consists of.
    #[error(
        "the definition of {name} is not in the service's image: push the package with the package that contains it \
         ({source})"
    )]
    NoDefinition {
        /// Name of the type.
        name: String,
        /// What is missing.
        source: SchemaError,
    },
    /// The other ROS has no such type.
    #[error(transparent)]
    NoTwin(#[from] NoTwin),
    /// The other ROS does not allow the name.
    #[error("ROS 2 does not allow this name: a part of it is empty or begins with a digit; remap it")]
    Name,
    /// Actions have other parts in the other ROS.
    #[error("actions are not carried between ROS 1 and ROS 2")]
    Action,
}

/// Types and their twins.
pub(super) struct KnownTwins {
    registry: Arc<Registry>,
    types: Arc<TypeTranslations>,
    messages: Mutex<HashMap<String, Vec<Arc<MessageTwin>>>>,
    services: Mutex<HashMap<String, Vec<Arc<ServiceTwin>>>>,
    /// ROS version of the twins.
    version: RosVersion,
}

/// Adds a twin under its name, unless it is known.
fn remember<T>(known: &Mutex<HashMap<String, Vec<Arc<T>>>>, name: &str, twin: &Arc<T>) {
    let mut known = known.lock();
    if known.len() >= MOST {
        known.clear();
    }
    let of_name = known.entry(name.to_owned()).or_default();
    if of_name.iter().any(|it| Arc::ptr_eq(it, twin)) {
        return;
    }
    if of_name.len() >= MOST_OF_NAME {
        of_name.remove(0);
    }
    of_name.push(Arc::clone(twin));
}

/// Finds a twin of this name.
fn find_known<T>(
    known: &Mutex<HashMap<String, Vec<Arc<T>>>>,
    name: &str,
    is_it: impl Fn(&Arc<T>) -> bool,
) -> Option<Arc<T>> {
    let known = known.lock();
    known.get(name)?.iter().find(|it| is_it(it)).cloned()
}

impl KnownTwins {
    /// Creates the twins, of ROS `version`, of the types of an image with the definitions of `registry`.
    pub(super) fn new(registry: Arc<Registry>, types: Arc<TypeTranslations>, version: RosVersion) -> Self {
        Self { registry, types, messages: Mutex::default(), services: Mutex::default(), version }
    }

    /// Returns the twin of a type of the servant's nodes. The definition is the image's if that is the same type,
    /// otherwise what the endpoint announces.
    pub(super) fn message(&self, of: &WireType) -> Result<Arc<MessageTwin>, Untranslatable> {
        let known = self.registry.message(&of.name).ok();
        let known = known.filter(|known| of.digest.is_compatible_with(&Digest::from(known.digest())));
        let original = known.map_or_else(|| of.schema(), Ok);
        let original = original.map_err(|source| Untranslatable::NoDefinition { name: of.name.clone(), source })?;
        let twin = self.types.message(&original)?;
        remember(&self.messages, twin.twin.name(), &twin);
        Ok(twin)
    }

    /// Returns the twin of a service type of the servant's nodes, which is defined in its image.
    pub(super) fn service(&self, of: &ServiceType) -> Result<Arc<ServiceTwin>, Untranslatable> {
        let known = self.registry.service(&of.name);
        let known = known.and_then(|known| {
            let same = ServiceType::from_service(&known).is_compatible_with(of);
            same.then_some(known).ok_or_else(|| SchemaError::Unknown(of.name.clone()))
        });
        let original = known.map_err(|source| Untranslatable::NoDefinition { name: of.name.clone(), source })?;
        let twin = self.types.service(&original)?;
        remember(&self.services, &twin.twin.name, &twin);
        Ok(twin)
    }

    /// Returns the type whose twin has this name and digest, among those that nodes use and those of the image.
    pub(super) fn message_with_twin(&self, twin: &WireType) -> Option<Arc<MessageTwin>> {
        let is_it = |it: &Arc<MessageTwin>| twin.digest.is_compatible_with(&Digest::from(it.twin.digest()));
        let known = find_known(&self.messages, &twin.name, is_it);
        known.or_else(|| {
            let name = self.types.message_name(&twin.name, self.version);
            let found = self.types.message(&self.registry.message(&name).ok()?).ok()?;
            (found.twin.name() == twin.name && is_it(&found)).then_some(found)
        })
    }

    /// Returns the service whose twin is compatible with this type, likewise.
    pub(super) fn service_with_twin(&self, twin: &ServiceType) -> Option<Arc<ServiceTwin>> {
        let is_it = |it: &Arc<ServiceTwin>| twin.matches(&ServiceType::from_service(&it.twin));
        let known = find_known(&self.services, &twin.name, is_it);
        known.or_else(|| {
            let name = self.types.service_name(&twin.name, self.version);
            let found = self.types.service(&self.registry.service(&name).ok()?).ok()?;
            is_it(&found).then_some(found)
        })
    }

    /// Returns the servant's type to which messages of a robot's type are carried, and their translator. A type that no
    /// node of the servant is known to use is carried by its own definition, which publishers of ROS 1 announce.
    pub(super) fn for_robot(
        &self,
        of: &WireType,
    ) -> Result<(Arc<MessageType>, Arc<MessageTranslator>), Untranslatable> {
        if let Some(known) = self.message_with_twin(of) {
            return Ok((Arc::clone(&known.original), Arc::clone(&known.from_twin)));
        }
        let own = of.schema().map_err(|source| Untranslatable::NoDefinition { name: of.name.clone(), source })?;
        let twin = self.types.message(&own)?;
        Ok((Arc::clone(&twin.twin), Arc::clone(&twin.to_twin)))
    }
}
