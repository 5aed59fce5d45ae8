//! Types and their twins.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use ros_message::RosVersion;
use ros_message::schema::{ActionDef, MessageType, Registry, SchemaError, ServiceDef};

use crate::compile::Compiler;
use crate::derive::Derivation;
use crate::error::{MAX_DIFFERENCE, NoTwin, NoTwinReason};
use crate::pairing::Pairings;
use crate::rules::TranslationRules;
use crate::translator::MessageTranslator;

/// Maximum number of types of each kind whose twins are kept, and what these may take in bytes: robots and nodes
/// announce any number of definitions, of any size.
const MAX_KEPT: usize = 1024;
pub(crate) const MAX_KEPT_BYTES: usize = 16 << 20;

/// Bytes that a pair of messages takes beside texts and programs.
const OVERHEAD: usize = 4 << 10;

/// Finds the twins of types of either ROS, and keeps them. Share it by `Arc`; all methods take `&self`.
#[derive(Debug)]
pub struct TypeTranslations {
    rules: Arc<TranslationRules>,
    known_one: Option<Arc<Registry>>,
    known_two: Option<Arc<Registry>>,
    messages: Kept<MessageTwin>,
    services: Kept<ServiceTwin>,
    actions: Kept<ActionTwin>,
}

/// A message type and its twin in the other ROS.
#[derive(Debug)]
pub struct MessageTwin {
    /// The type.
    pub original: Arc<MessageType>,
    /// The type in the other ROS.
    pub twin: Arc<MessageType>,
    /// Translates messages of `original` into those of `twin`.
    pub to_twin: Arc<MessageTranslator>,
    /// Translates messages of `twin` into those of `original`.
    pub from_twin: Arc<MessageTranslator>,
}

/// A type with its twin, as something that takes memory.
pub(crate) trait TypePair {
    /// Returns about how many bytes it takes.
    fn bytes_held(&self) -> usize;
}

impl TypePair for MessageTwin {
    fn bytes_held(&self) -> usize {
        let texts = self.original.full_text().len() + self.twin.full_text().len();
        OVERHEAD + texts + self.to_twin.bytes_held() + self.from_twin.bytes_held()
    }
}

impl TypePair for ServiceTwin {
    fn bytes_held(&self) -> usize {
        let parts = [&self.original.request, &self.original.response, &self.twin.request, &self.twin.response];
        let translators =
            [&self.request_to_twin, &self.request_from_twin, &self.response_to_twin, &self.response_from_twin];
        let texts: usize = parts.iter().map(|part| part.full_text().len()).sum();
        OVERHEAD + texts + translators.iter().map(|translator| translator.bytes_held()).sum::<usize>()
    }
}

impl TypePair for ActionTwin {
    fn bytes_held(&self) -> usize {
        // Each text is once more in the messages that carry goals, results and feedback.
        2 * [&self.goal, &self.result, &self.feedback].iter().map(|part| part.bytes_held()).sum::<usize>()
    }
}

impl MessageTwin {
    /// Returns the pair with its sides exchanged.
    pub(crate) fn reverse(&self) -> Self {
        Self {
            original: Arc::clone(&self.twin),
            twin: Arc::clone(&self.original),
            to_twin: Arc::clone(&self.from_twin),
            from_twin: Arc::clone(&self.to_twin),
        }
    }
}

/// A service type and its twin in the other ROS.
#[derive(Debug)]
pub struct ServiceTwin {
    /// The service.
    pub original: Arc<ServiceDef>,
    /// The service in the other ROS.
    pub twin: Arc<ServiceDef>,
    /// Translates requests of `original` into those of `twin`.
    pub request_to_twin: Arc<MessageTranslator>,
    /// Translates requests of `twin` into those of `original`.
    pub request_from_twin: Arc<MessageTranslator>,
    /// Translates responses of `original` into those of `twin`.
    pub response_to_twin: Arc<MessageTranslator>,
    /// Translates responses of `twin` into those of `original`.
    pub response_from_twin: Arc<MessageTranslator>,
}

/// An action type and its twin in the other ROS. Goal, result and feedback are the messages without ids and status
/// ([`ActionDef::goal`] and so on); what carries them differs between the versions.
#[derive(Debug)]
pub struct ActionTwin {
    /// The action.
    pub original: Arc<ActionDef>,
    /// The action in the other ROS.
    pub twin: Arc<ActionDef>,
    /// The goal.
    pub goal: Arc<MessageTwin>,
    /// The result.
    pub result: Arc<MessageTwin>,
    /// The feedback.
    pub feedback: Arc<MessageTwin>,
}

/// Version, name and digest of a type.
type Key = (RosVersion, String, String);

/// Twins that were found, or the reasons why there are none.
#[derive(Debug)]
struct Kept<T>(Mutex<KeptTwins<T>>);

#[derive(Debug)]
struct KeptTwins<T> {
    found: HashMap<Key, Result<Arc<T>, NoTwin>>,
    bytes: usize,
}

impl<T> Default for Kept<T> {
    fn default() -> Self {
        Kept(Mutex::new(KeptTwins { found: HashMap::new(), bytes: 0 }))
    }
}

impl<T: TypePair> Kept<T> {
    fn get_or_find(&self, key: Key, find: impl FnOnce() -> Result<T, NoTwinReason>) -> Result<Arc<T>, NoTwin> {
        if let Some(kept) = self.0.lock().found.get(&key) {
            return kept.clone();
        }
        // Unlocked: two threads may find the same, and the first one's stays.
        let (version, name, _) = &key;
        let found = find().map(Arc::new).map_err(|reason| NoTwin {
            name: name.clone(),
            version: *version,
            reason: Box::new(reason),
        });
        let bytes = found.as_ref().map_or(OVERHEAD, |found| found.bytes_held());
        let mut kept = self.0.lock();
        if let Some(first) = kept.found.get(&key) {
            return first.clone();
        }
        if kept.found.len() >= MAX_KEPT || kept.bytes.saturating_add(bytes) > MAX_KEPT_BYTES {
            kept.found.clear();
            kept.bytes = 0;
        }
        kept.bytes = kept.bytes.saturating_add(bytes);
        kept.found.insert(key, found.clone());
        found
    }
}

impl TypeTranslations {
    /// Creates translations by these rules; [`TranslationRules::default`] is the built-in table.
    pub fn new(rules: impl Into<Arc<TranslationRules>>) -> Self {
        TypeTranslations {
            rules: rules.into(),
            known_one: None,
            known_two: None,
            messages: Kept::default(),
            services: Kept::default(),
            actions: Kept::default(),
        }
    }

    /// Adds the definitions of one ROS `version` that are known. A type of the other ROS whose twin is among them gets
    /// that definition instead of a derived one.
    pub fn with_known(mut self, registry: Arc<Registry>, version: RosVersion) -> Self {
        let known = match version {
            RosVersion::One => &mut self.known_one,
            RosVersion::Two => &mut self.known_two,
        };
        *known = Some(registry);
        // What was found so far may change.
        TypeTranslations { messages: Kept::default(), services: Kept::default(), actions: Kept::default(), ..self }
    }

    /// Returns the twin of a message type of either ROS.
    pub fn message(&self, of: &Arc<MessageType>) -> Result<Arc<MessageTwin>, NoTwin> {
        self.messages.get_or_find(key(of, of.name(), of.digest()), || self.find_message(of))
    }

    /// Returns the twin of a service type of either ROS.
    pub fn service(&self, of: &Arc<ServiceDef>) -> Result<Arc<ServiceTwin>, NoTwin> {
        self.services.get_or_find(key(&of.request, &of.name, &of.md5), || self.find_service(of))
    }

    /// Returns the twin of an action type of either ROS.
    pub fn action(&self, of: &Arc<ActionDef>) -> Result<Arc<ActionTwin>, NoTwin> {
        self.actions.get_or_find(key(&of.action, &of.name, of.action.digest()), || self.find_action(of))
    }

    /// Returns the name that a message type of ROS `from` has in the other ROS: `sensor_msgs/Image` for
    /// `sensor_msgs/msg/Image` and the reverse, unless a rule or the known definitions say otherwise.
    pub fn message_name(&self, name: &str, from: RosVersion) -> String {
        let is_known = |known: &Registry, name: &str| known.message(name).is_ok();
        self.choose_name(self.rules.message_name(name, from), from, is_known)
    }

    /// Returns the name that a service type of ROS `from` has in the other ROS (`package/Type`, `package/srv/Type`).
    pub fn service_name(&self, name: &str, from: RosVersion) -> String {
        let is_known = |known: &Registry, name: &str| known.service(name).is_ok();
        self.choose_name(self.rules.service_name(name, from), from, is_known)
    }

    /// Returns the name that an action type of ROS `from` has in the other ROS (`package/Name`, `package/action/Name`).
    pub fn action_name(&self, name: &str, from: RosVersion) -> String {
        let is_known = |known: &Registry, name: &str| known.action(name).is_ok();
        self.choose_name(self.rules.action_name(name, from), from, is_known)
    }

    /// Returns `name`, or, if only that is known, the name in a package whose name ends in `_interfaces` instead of
    /// `_msgs`, as packages of ROS 2 are called: ros1_bridge pairs these without a rule.
    fn choose_name(&self, name: String, from: RosVersion, is_known: impl Fn(&Registry, &str) -> bool) -> String {
        let Some(known) = self.known_registry(from.other()) else {
            return name;
        };
        let (package, rest) = name.split_once('/').unwrap_or((&name, ""));
        let (ending, instead) = match from {
            RosVersion::One => ("_msgs", "_interfaces"),
            RosVersion::Two => ("_interfaces", "_msgs"),
        };
        let other = package.strip_suffix(ending).map(|package| format!("{package}{instead}/{rest}"));
        match other {
            Some(other) if !is_known(known, &name) && is_known(known, &other) => other,
            _ => name,
        }
    }

    /// Returns the number of message types whose twins are kept, and the bytes that they take.
    #[cfg(test)]
    pub(crate) fn kept_messages(&self) -> (usize, usize) {
        let kept = self.messages.0.lock();
        (kept.found.len(), kept.bytes)
    }

    fn known_registry(&self, version: RosVersion) -> Option<&Registry> {
        match version {
            RosVersion::One => self.known_one.as_deref(),
            RosVersion::Two => self.known_two.as_deref(),
        }
    }

    fn find_message(&self, of: &Arc<MessageType>) -> Result<MessageTwin, NoTwinReason> {
        let to = of.version().other();
        let name = self.message_name(of.name(), of.version());
        let twin = match self.find_known(to, |known| known.message(&name))? {
            Some(known) => known,
            None => {
                let name_of = |message: &MessageType| self.message_name(message.name(), message.version());
                let mut derivation = Derivation::new(&self.rules, self.known_registry(to), to, &name_of);
                derivation.add_message(of, &name)?;
                derivation.resolve(|registry| registry.message(&name))?
            }
        };
        self.pair(of, &twin)
    }

    fn find_service(&self, of: &Arc<ServiceDef>) -> Result<ServiceTwin, NoTwinReason> {
        let from = of.request.version();
        let to = from.other();
        let name = self.service_name(&of.name, from);
        let twin = match self.find_known(to, |known| known.service(&name))? {
            Some(known) => known,
            None => {
                let parts = [(&*of.request, "Request"), (&*of.response, "Response")];
                let parts = parts.map(|(part, suffix)| (part, part_name(&name, to, suffix)));
                let name_of = |message: &MessageType| self.message_name(message.name(), message.version());
                let mut derivation = Derivation::new(&self.rules, self.known_registry(to), to, &name_of);
                derivation.add_parts(&key_of(&name, "srv"), &parts)?;
                derivation.resolve(|registry| registry.service(&name))?
            }
        };
        let request = self.pair(&of.request, &twin.request)?;
        let response = self.pair(&of.response, &twin.response)?;
        Ok(ServiceTwin {
            original: of.clone(),
            twin,
            request_to_twin: request.to_twin,
            request_from_twin: request.from_twin,
            response_to_twin: response.to_twin,
            response_from_twin: response.from_twin,
        })
    }

    fn find_action(&self, of: &Arc<ActionDef>) -> Result<ActionTwin, NoTwinReason> {
        let from = of.action.version();
        let to = from.other();
        let name = self.action_name(&of.name, from);
        let twin = match self.find_known(to, |known| known.action(&name))? {
            Some(known) => known,
            None => {
                let parts = [(&*of.goal, "Goal"), (&*of.result, "Result"), (&*of.feedback, "Feedback")];
                let parts = parts.map(|(part, suffix)| (part, part_name(&name, to, suffix)));
                let name_of = |message: &MessageType| self.message_name(message.name(), message.version());
                let mut derivation = Derivation::new(&self.rules, self.known_registry(to), to, &name_of);
                derivation.add_parts(&key_of(&name, "action"), &parts)?;
                derivation.resolve(|registry| registry.action(&name))?
            }
        };
        Ok(ActionTwin {
            original: of.clone(),
            goal: Arc::new(self.pair(&of.goal, &twin.goal)?),
            result: Arc::new(self.pair(&of.result, &twin.result)?),
            feedback: Arc::new(self.pair(&of.feedback, &twin.feedback)?),
            twin,
        })
    }

    /// Returns the known definition, if any; it is an error if there is one that is not valid.
    fn find_known<T>(
        &self,
        version: RosVersion,
        find: impl Fn(&Registry) -> Result<T, SchemaError>,
    ) -> Result<Option<T>, NoTwinReason> {
        match self.known_registry(version).map(find) {
            None | Some(Err(SchemaError::Unknown(_))) => Ok(None),
            Some(Ok(known)) => Ok(Some(known)),
            Some(Err(error)) => Err(NoTwinReason::Definition(error)),
        }
    }

    /// Pairs the fields of two messages and compiles the translators of both ways.
    fn pair(&self, original: &Arc<MessageType>, twin: &Arc<MessageType>) -> Result<MessageTwin, NoTwinReason> {
        let (one, two) = match original.version() {
            RosVersion::One => (original, twin),
            RosVersion::Two => (twin, original),
        };
        if one.min_size().abs_diff(two.min_size()) > MAX_DIFFERENCE {
            return Err(NoTwinReason::EmptySize {
                one: one.name().to_owned(),
                one_bytes: one.min_size(),
                two: two.name().to_owned(),
                two_bytes: two.min_size(),
            });
        }
        let mut pairings = Pairings::default();
        pairings.add(&self.rules, one, two)?;
        let translator = |source: &Arc<MessageType>, target: &Arc<MessageType>| {
            let mut compiler = Compiler::new(&pairings, source.version());
            let program = compiler.message(source, target);
            Arc::new(MessageTranslator::new(source.clone(), target, program, compiler.bytes_held()))
        };
        Ok(MessageTwin {
            original: original.clone(),
            twin: twin.clone(),
            to_twin: translator(original, twin),
            from_twin: translator(twin, original),
        })
    }
}

fn key(message: &MessageType, name: &str, digest: &str) -> Key {
    (message.version(), name.to_owned(), digest.to_owned())
}

/// Returns the name of a service's or action's message: `package/TypeRequest`, `package/srv/Type_Request`.
fn part_name(owner: &str, version: RosVersion, suffix: &str) -> String {
    match version {
        RosVersion::One => format!("{owner}{suffix}"),
        RosVersion::Two => format!("{owner}_{suffix}"),
    }
}

/// Returns the key under which a registry takes a service or action.
fn key_of(name: &str, kind: &str) -> String {
    match name.split('/').collect::<Vec<_>>()[..] {
        [package, short] => format!("{package}/{kind}/{short}"),
        _ => name.to_owned(),
    }
}
