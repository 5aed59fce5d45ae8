//! The twins of the types that a servant's nodes use.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{BusError, Digest, RosVersion, ServiceType, WireType};
use ros::schema::{ActionDef, MessageType, Registry, SchemaError, ServiceDef};

use crate::twins::{MAX_KEPT_BYTES, TypePair};
use crate::{ActionTwin, MessageTranslator, MessageTwin, NoTwin, ServiceTwin, TypeTranslations};

/// Maximum number of types remembered, which take at most [`MAX_KEPT_BYTES`]; beyond it they are found anew.
const MAX_TYPES: usize = 4096;
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
        /// Reason why no twin was found.
        source: SchemaError,
    },
    /// The other ROS has no such type.
    #[error(transparent)]
    NoTwin(#[from] NoTwin),
    /// The other ROS does not allow the name.
    #[error("ROS 2 does not allow this name: a part of it is empty or begins with a digit; remap it")]
    Name,
    /// The action cannot be made of parts of the other ROS.
    #[error(transparent)]
    Parts(BusError),
}

/// Types and their twins.
pub(super) struct KnownTwins {
    registry: Arc<Registry>,
    types: Arc<TypeTranslations>,
    messages: Mutex<RememberedTwins<MessageTwin>>,
    services: Mutex<RememberedTwins<ServiceTwin>>,
    /// ROS version of the twins.
    version: RosVersion,
}

/// Twins by their names.
struct RememberedTwins<T> {
    by_name: HashMap<String, Vec<Arc<T>>>,
    bytes: usize,
}

impl<T> Default for RememberedTwins<T> {
    fn default() -> Self {
        Self { by_name: HashMap::new(), bytes: 0 }
    }
}

/// Adds a twin under its name, unless it is known.
fn remember<T: TypePair>(known: &Mutex<RememberedTwins<T>>, name: &str, twin: &Arc<T>) {
    let mut known = known.lock();
    if known.by_name.get(name).is_some_and(|of_name| of_name.iter().any(|it| Arc::ptr_eq(it, twin))) {
        return;
    }
    let bytes = twin.bytes_held();
    if known.by_name.len() >= MAX_TYPES || known.bytes.saturating_add(bytes) > MAX_KEPT_BYTES {
        *known = RememberedTwins::default();
    }
    let of_name = known.by_name.entry(name.to_owned()).or_default();
    let replaced = (of_name.len() >= MOST_OF_NAME).then(|| of_name.remove(0));
    of_name.push(Arc::clone(twin));
    let replaced = replaced.map_or(0, |replaced| replaced.bytes_held());
    known.bytes = known.bytes.saturating_add(bytes).saturating_sub(replaced);
}

/// Finds a twin of this name.
fn find_known<T>(known: &Mutex<RememberedTwins<T>>, name: &str, is_it: impl Fn(&Arc<T>) -> bool) -> Option<Arc<T>> {
    let known = known.lock();
    known.by_name.get(name)?.iter().find(|it| is_it(it)).cloned()
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

    /// Returns the twin of an action type of the servant's nodes, which is defined in its image.
    pub(super) fn action(&self, type_name: &str) -> Result<Arc<ActionTwin>, Untranslatable> {
        let original = self.registry.action(type_name);
        let original =
            original.map_err(|source| Untranslatable::NoDefinition { name: type_name.to_owned(), source })?;
        Ok(self.types.action(&original)?)
    }

    /// Returns the action of the image whose twin has this name.
    fn action_with_twin(&self, name: &str) -> Option<Arc<ActionTwin>> {
        let found = self.action(&self.types.action_name(name, self.version)).ok()?;
        (found.twin.name == name).then_some(found)
    }

    /// Returns the servant's action to which goals of a robot's type are carried, with the robot's as its twin: the
    /// image's, otherwise one that is derived from the robot's.
    pub(super) fn action_for_robot(&self, of: &Arc<ActionDef>) -> Result<Arc<ActionTwin>, Untranslatable> {
        let known = self.action_with_twin(&of.name);
        if let Some(known) = known.filter(|known| known.twin.action.digest() == of.action.digest()) {
            return Ok(known);
        }
        let own = self.types.action(of)?;
        Ok(Arc::new(ActionTwin {
            original: Arc::clone(&own.twin),
            twin: Arc::clone(&own.original),
            goal: Arc::new(own.goal.reverse()),
            result: Arc::new(own.result.reverse()),
            feedback: Arc::new(own.feedback.reverse()),
        }))
    }

    /// Returns the definition of a message that carries goals, feedback, results or statuses of the image's actions, as
    /// the robot sees it.
    pub(super) fn message_of_action(&self, of: &WireType) -> Option<Arc<MessageType>> {
        let suffixes = match self.version {
            RosVersion::One => ["ActionGoal", "ActionFeedback", "ActionResult"],
            RosVersion::Two => ["_SendGoal_Request", "_FeedbackMessage", "_GetResult_Response"],
        };
        let action = suffixes.iter().find_map(|suffix| of.name.strip_suffix(suffix));
        let found = match action {
            Some(action) => {
                let twin = self.action_with_twin(action)?;
                let parts = [&twin.twin.action_goal, &twin.twin.action_feedback, &twin.twin.action_result];
                parts.into_iter().find(|part| part.name() == of.name).cloned()?
            }
            // Every registry has what is common to all actions.
            None if of.name.starts_with("actionlib_msgs/") || of.name.starts_with("action_msgs/") => {
                Registry::for_version(self.version).message(&of.name).ok()?
            }
            None => return None,
        };
        of.digest.is_compatible_with(&Digest::from(found.digest())).then_some(found)
    }

    /// Returns the definition of a service of the image's actions, as a robot of ROS 2 sees it.
    pub(super) fn service_of_action(&self, of: &ServiceType) -> Option<Arc<ServiceDef>> {
        if of.name.starts_with("action_msgs/") {
            // Every registry has what is common to all actions.
            let common = Registry::for_version(self.version).service(&of.name).ok()?;
            return of.matches(&ServiceType::from_service(&common)).then_some(common);
        }
        let (action, _) = of.name.rsplit_once('_')?;
        let twin = self.action_with_twin(action)?;
        let services = twin.twin.services.as_ref()?;
        let mut parts = [&services.send_goal, &services.get_result].into_iter();
        parts.find(|part| of.matches(&ServiceType::from_service(part))).cloned()
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
