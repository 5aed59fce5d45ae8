//! Types and their twins.

use std::sync::Arc;

use ros_message::RosVersion;
use ros_message::schema::{ActionDef, MessageType, Registry, ServiceDef};

use crate::{MessageTranslator, NoTwin, TranslationRules};

/// Finds the twins of types of either ROS, and keeps them. Share it by `Arc`; all methods take `&self`.
#[derive(Debug)]
pub struct TypeTranslations {}

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

impl TypeTranslations {
    /// Creates translations by these rules; [`TranslationRules::default`] is the built-in table.
    pub fn new(rules: TranslationRules) -> Self {
        let _ = rules;
        todo!()
    }

    /// Adds definitions of one ROS. A type of the other ROS whose twin they name gets their definition instead of a
    /// derived one.
    pub fn with_known(self, registry: Arc<Registry>, version: RosVersion) -> Self {
        let _ = (registry, version);
        todo!()
    }

    /// Returns the twin of a message type of either ROS.
    pub fn message(&self, of: &Arc<MessageType>) -> Result<Arc<MessageTwin>, NoTwin> {
        let _ = of;
        todo!()
    }

    /// Returns the twin of a service type of either ROS.
    pub fn service(&self, of: &Arc<ServiceDef>) -> Result<Arc<ServiceTwin>, NoTwin> {
        let _ = of;
        todo!()
    }

    /// Returns the twin of an action type of either ROS.
    pub fn action(&self, of: &Arc<ActionDef>) -> Result<Arc<ActionTwin>, NoTwin> {
        let _ = of;
        todo!()
    }

    /// Returns the name that a message type of ROS `from` has in the other ROS: `sensor_msgs/Image` for
    /// `sensor_msgs/msg/Image` and the reverse, unless a rule says otherwise.
    pub fn message_name(&self, name: &str, from: RosVersion) -> String {
        let _ = (name, from);
        todo!()
    }

    /// Returns the name that a service type of ROS `from` has in the other ROS (`package/Type`, `package/srv/Type`).
    pub fn service_name(&self, name: &str, from: RosVersion) -> String {
        let _ = (name, from);
        todo!()
    }

    /// Returns the name that an action type of ROS `from` has in the other ROS (`package/Name`, `package/action/Name`).
    pub fn action_name(&self, name: &str, from: RosVersion) -> String {
        let _ = (name, from);
        todo!()
    }
}
