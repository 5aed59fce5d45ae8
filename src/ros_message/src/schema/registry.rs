//! Definitions in one scope (a service, a robot's servant) by name; resolved on first use, then cached.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use parking_lot::RwLock;

use crate::RosVersion;
use crate::schema::action::{ACTION_ENDINGS, action_message, service_message, well_known};
use crate::schema::derived;
use crate::schema::limits::MAX_DEFINITIONS;
use crate::schema::parse::check_identifier;
use crate::schema::resolve::{build_action, build_message, build_service};
use crate::schema::text::split_full_text;
use crate::schema::types::{ActionDef, MessageType, ServiceDef};
use crate::schema::{ExceededLimit, MAX_TEXT_BYTES, SchemaError};

/// Definitions of one ROS version and the types they resolve to. Share it by `Arc`; all methods take `&self`.
#[derive(Debug)]
pub struct Registry {
    state: RwLock<State>,
}

/// A registry of ROS 1.
impl Default for Registry {
    fn default() -> Self {
        Self::new()
    }
}

/// Texts and everything resolved so far, by names as in [`MessageType::name`].
#[derive(Debug)]
pub(crate) struct State {
    pub(crate) version: RosVersion,
    messages: HashMap<String, Arc<str>>,
    services: HashMap<String, Arc<str>>,
    actions: HashMap<String, Arc<str>>,
    pub(crate) resolved_messages: HashMap<String, Arc<MessageType>>,
    pub(crate) resolved_services: HashMap<String, Arc<ServiceDef>>,
    pub(crate) resolved_actions: HashMap<String, Arc<ActionDef>>,
}

impl Registry {
    /// Creates an empty registry of ROS 1. `std_msgs/Header` and actionlib's own messages are built in.
    pub fn new() -> Registry {
        Registry::for_version(RosVersion::One)
    }

    /// Creates an empty registry. Headers, times and the messages that actions need are built in.
    pub fn for_version(version: RosVersion) -> Registry {
        Registry {
            state: RwLock::new(State {
                version,
                messages: HashMap::new(),
                services: HashMap::new(),
                actions: HashMap::new(),
                resolved_messages: HashMap::new(),
                resolved_services: HashMap::new(),
                resolved_actions: HashMap::new(),
            }),
        }
    }

    /// Creates a registry of ROS 1 with these definitions, keyed as for [`insert`](Self::insert).
    pub fn from_definitions(definitions: &BTreeMap<String, String>) -> Result<Registry, SchemaError> {
        Self::with_definitions(RosVersion::One, definitions)
    }

    /// Creates a registry with these definitions, keyed as for [`insert`](Self::insert).
    pub fn with_definitions(
        version: RosVersion,
        definitions: &BTreeMap<String, String>,
    ) -> Result<Registry, SchemaError> {
        let registry = Registry::for_version(version);
        for (key, text) in definitions {
            registry.insert(key, text)?;
        }
        Ok(registry)
    }

    /// Adds or replaces one definition. `key` is `package/msg/Type`, `package/srv/Type`, `package/action/Name`, or
    /// `package/Type` for a message. The text is parsed when the type is first used.
    pub fn insert(&self, key: &str, text: &str) -> Result<(), SchemaError> {
        let mut state = self.state.write();
        let (kind, name) = split_key(state.version, key)?;
        if text.len() > MAX_TEXT_BYTES {
            return Err(too_long(&name));
        }
        state.insert(kind, name, text);
        Ok(())
    }

    /// Adds a message and its dependencies from a full text, as ROS 1 publishers send it in their connection header.
    /// Replaces definitions that differ.
    pub fn insert_full_text(&self, type_name: &str, text: &str) -> Result<(), SchemaError> {
        let mut state = self.state.write();
        let name = state.text_name(type_name)?;
        if text.len() > MAX_TEXT_BYTES {
            return Err(too_long(&name));
        }
        let (own, others) = split_full_text(text);
        if others.len() > MAX_DEFINITIONS {
            let reason = ExceededLimit::Definitions;
            return Err(SchemaError::TooLarge { name, reason });
        }
        let others = others
            .into_iter()
            .map(|(other, part)| Ok((state.text_name(&other)?, part)))
            .collect::<Result<Vec<_>, SchemaError>>()?;
        state.insert(Kind::Message, name, &own);
        for (other, part) in others {
            state.insert(Kind::Message, other, &part);
        }
        Ok(())
    }

    /// Returns the message `package/Type` (or `package/msg/Type`). Messages generated from a service (`…Request`,
    /// `…Response`) or an action (`…Goal`, `…ActionGoal`, …) are derived from it; those of ROS 2 (`…_Request`) are also
    /// found by full name (`package/srv/Type_Request`).
    pub fn message(&self, name: &str) -> Result<Arc<MessageType>, SchemaError> {
        let state = self.state.read();
        if let Some(found) = state.resolved_messages.get(name) {
            return Ok(found.clone());
        }
        let name = state.message_name(name)?;
        if let Some(found) = state.resolved_messages.get(&name) {
            return Ok(found.clone());
        }
        drop(state);
        build_message(&mut self.state.write(), &name)
    }

    /// Returns the service `package/Type` (or `package/srv/Type`).
    pub fn service(&self, name: &str) -> Result<Arc<ServiceDef>, SchemaError> {
        if let Some(found) = self.state.read().resolved_services.get(name) {
            return Ok(found.clone());
        }
        let mut state = self.state.write();
        let name = match state.version {
            RosVersion::One => plain_name(name, "srv")?,
            RosVersion::Two => full_name(name, "srv")?,
        };
        build_service(&mut state, &name)
    }

    /// Returns the action `package/Name` (or `package/action/Name`).
    pub fn action(&self, name: &str) -> Result<Arc<ActionDef>, SchemaError> {
        if let Some(found) = self.state.read().resolved_actions.get(name) {
            return Ok(found.clone());
        }
        let mut state = self.state.write();
        let name = match state.version {
            RosVersion::One => plain_name(name, "action")?,
            RosVersion::Two => full_name(name, "action")?,
        };
        build_action(&mut state, &name)
    }

    /// Returns the names of all definitions that were added, sorted, as `package/msg/Type`, `package/srv/Type` or
    /// `package/action/Name`.
    pub fn keys(&self) -> Vec<String> {
        let state = self.state.read();
        let full = state.version == RosVersion::Two;
        let kinds = [("msg", &state.messages), ("srv", &state.services), ("action", &state.actions)];
        let mut keys: Vec<String> = kinds
            .into_iter()
            .flat_map(|(kind, texts)| {
                texts.keys().map(
                    move |name| {
                        if full { name.clone() } else { name.replacen('/', &format!("/{kind}/"), 1) }
                    },
                )
            })
            .collect();
        keys.sort();
        keys
    }
}

impl MessageType {
    /// Creates a message type of ROS 1 from its full text alone, as a publisher's connection header has it, independent
    /// of other definitions.
    pub fn from_full_text(name: &str, text: &str) -> Result<Arc<MessageType>, SchemaError> {
        Self::parse_full_text(RosVersion::One, name, text)
    }

    /// Creates a message type from its full text alone.
    pub fn parse_full_text(version: RosVersion, name: &str, text: &str) -> Result<Arc<MessageType>, SchemaError> {
        let registry = Registry::for_version(version);
        registry.insert_full_text(name, text)?;
        registry.message(name)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Message,
    Service,
    Action,
}

impl State {
    fn insert(&mut self, kind: Kind, name: String, text: &str) {
        let texts = match kind {
            Kind::Message => &mut self.messages,
            Kind::Service => &mut self.services,
            Kind::Action => &mut self.actions,
        };
        if texts.get(&name).is_some_and(|known| **known == *text) {
            return;
        }
        texts.insert(name, text.into());
        // Anything resolved so far may contain the definition just replaced.
        self.resolved_messages.clear();
        self.resolved_services.clear();
        self.resolved_actions.clear();
    }

    /// Returns the text of message `name`, given or derived.
    pub(crate) fn message_text(&self, name: &str) -> Result<Option<Arc<str>>, SchemaError> {
        if let Some(text) = self.messages.get(name) {
            return Ok(Some(text.clone()));
        }
        match self.version {
            RosVersion::One => self.derived_ros1_text(name),
            RosVersion::Two => self.derived_ros2_text(name),
        }
    }

    fn derived_ros1_text(&self, name: &str) -> Result<Option<Arc<str>>, SchemaError> {
        for (ending, request) in [("Request", true), ("Response", false)] {
            if let Some((service, text)) = owner(&self.services, name, ending) {
                return Ok(Some(service_message(service, text, request)?.into()));
            }
        }
        for ending in ACTION_ENDINGS {
            if let Some((action, text)) = owner(&self.actions, name, ending) {
                return Ok(Some(action_message(action, text, ending)?.into()));
            }
        }
        Ok(well_known(name).map(Into::into))
    }

    fn derived_ros2_text(&self, name: &str) -> Result<Option<Arc<str>>, SchemaError> {
        // The names of services and actions may contain underscores themselves.
        let ends = name.match_indices('_').map(|(at, _)| at);
        for end in ends.chain([name.len()]) {
            let (owner, ending) = name.split_at(end);
            let given = self.services.get(owner).map(|text| &**text);
            if let Some(text) = given.or_else(|| derived::well_known_service(owner)) {
                if let Some(text) = derived::service_text(owner, text, ending)? {
                    return Ok(Some(text.into()));
                }
            }
            if let Some(text) = self.actions.get(owner) {
                if let Some(text) = derived::action_text(owner, text, ending)? {
                    return Ok(Some(text.into()));
                }
            }
        }
        Ok(derived::well_known(name).map(Into::into))
    }

    /// Returns the normalized name of a message whose text is given.
    fn text_name(&self, name: &str) -> Result<String, SchemaError> {
        match self.version {
            RosVersion::One => plain_name(name, "msg"),
            RosVersion::Two => full_name(name, "msg"),
        }
    }

    /// Returns the normalized name of a message that is looked up.
    fn message_name(&self, name: &str) -> Result<String, SchemaError> {
        let given = self.text_name(name)?;
        let short = name.split_once('/').map_or("", |(_, short)| short);
        let derived = self.version == RosVersion::Two && !short.contains('/');
        if derived && short.contains('_') && !self.messages.contains_key(&given) {
            for kind in ["srv", "action"] {
                let derived = full_name(name, kind)?;
                if self.message_text(&derived)?.is_some() {
                    return Ok(derived);
                }
            }
        }
        Ok(given)
    }

    pub(crate) fn has_service(&self, name: &str) -> bool {
        match self.version {
            RosVersion::One => self.services.contains_key(name),
            // The services of actions are derived.
            RosVersion::Two => matches!(self.message_text(name), Ok(Some(_))),
        }
    }

    pub(crate) fn has_action(&self, name: &str) -> bool {
        self.actions.contains_key(name)
    }
}

fn owner<'a>(texts: &'a HashMap<String, Arc<str>>, name: &str, ending: &str) -> Option<(&'a str, &'a str)> {
    let (name, text) = texts.get_key_value(name.strip_suffix(ending)?)?;
    Some((name, text))
}

fn split_key(version: RosVersion, key: &str) -> Result<(Kind, String), SchemaError> {
    let parts: Vec<&str> = key.split('/').collect();
    let (package, kind, short) = match parts[..] {
        [package, short] | [package, "msg", short] => (package, Kind::Message, short),
        [package, "srv", short] => (package, Kind::Service, short),
        [package, "action", short] => (package, Kind::Action, short),
        _ => return Err(SchemaError::BadName(key.to_owned())),
    };
    let legal = check_identifier(package).and_then(|()| check_identifier(short));
    legal.map_err(|_| SchemaError::BadName(key.chars().take(100).collect()))?;
    let name = match (version, kind) {
        (RosVersion::One, _) => format!("{package}/{short}"),
        (RosVersion::Two, Kind::Message) => format!("{package}/msg/{short}"),
        (RosVersion::Two, _) => key.to_owned(),
    };
    Ok((kind, name))
}

/// Returns `package/<kind>/Type` for `package/Type`; a full name is returned as it is.
fn full_name(name: &str, kind: &str) -> Result<String, SchemaError> {
    let bad = || SchemaError::BadName(name.chars().take(100).collect());
    let parts: Vec<&str> = name.split('/').collect();
    let (package, kind, short) = match parts[..] {
        [package, short] => (package, kind, short),
        [package, kind @ ("msg" | "srv" | "action"), short] => (package, kind, short),
        _ => return Err(bad()),
    };
    let legal = check_identifier(package).and_then(|()| check_identifier(short));
    legal.map_err(|_| bad())?;
    Ok(format!("{package}/{kind}/{short}"))
}

/// Returns `package/Type` for `package/Type` or `package/<kind>/Type`.
fn plain_name(name: &str, kind: &str) -> Result<String, SchemaError> {
    let bad = || SchemaError::BadName(name.chars().take(100).collect());
    let (package, rest) = name.split_once('/').ok_or_else(bad)?;
    let short = rest.strip_prefix(kind).and_then(|rest| rest.strip_prefix('/')).unwrap_or(rest);
    check_identifier(package).and_then(|()| check_identifier(short)).map_err(|_| bad())?;
    Ok(format!("{package}/{short}"))
}

fn too_long(name: &str) -> SchemaError {
    SchemaError::TooLarge { name: name.to_owned(), reason: ExceededLimit::TextBytes }
}
