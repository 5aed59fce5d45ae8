//! Types of topics and services as declared by their endpoints.

use std::fmt;
use std::sync::Arc;

use ros_message::schema::{MessageType, SchemaError, ServiceDef};

use crate::{BusError, RosVersion};

/// Serialization format of messages on a topic or service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WireFormat {
    /// ROS 1: little endian, unaligned, lengths of four bytes (<http://wiki.ros.org/ROS/Technical%20Overview>).
    #[default]
    Ros1,
    /// ROS 2: an encapsulation header and CDR.
    Cdr,
}

impl WireFormat {
    /// Returns the format of a ROS version.
    pub fn for_version(version: RosVersion) -> Self {
        match version {
            RosVersion::One => Self::Ros1,
            RosVersion::Two => Self::Cdr,
        }
    }

    /// Returns the ROS version that uses the format.
    pub fn version(self) -> RosVersion {
        match self {
            Self::Ros1 => RosVersion::One,
            Self::Cdr => RosVersion::Two,
        }
    }
}

/// Distinguishes definitions of one name: the MD5 of a ROS 1 type, 32 lower-case hex digits, or the type hash of a ROS
/// 2 type (`RIHS01_…`).
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Digest(Arc<str>);

impl Digest {
    /// Returns `*`, which is compatible with all digests.
    pub fn any() -> Self {
        Self::from("*")
    }

    /// Returns true for `*`.
    pub fn is_any(&self) -> bool {
        &*self.0 == "*"
    }

    /// Returns the digest as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns true if endpoints with these digests can communicate.
    pub fn is_compatible_with(&self, other: &Digest) -> bool {
        self.is_any() || other.is_any() || self == other
    }
}

impl From<&str> for Digest {
    fn from(text: &str) -> Self {
        Self(text.into())
    }
}

impl From<&String> for Digest {
    fn from(text: &String) -> Self {
        Self(text.as_str().into())
    }
}

impl From<String> for Digest {
    fn from(text: String) -> Self {
        Self(text.into())
    }
}

impl From<&Digest> for Digest {
    fn from(digest: &Digest) -> Self {
        digest.clone()
    }
}

impl PartialEq<str> for Digest {
    fn eq(&self, other: &str) -> bool {
        &*self.0 == other
    }
}

impl PartialEq<&str> for Digest {
    fn eq(&self, other: &&str) -> bool {
        &*self.0 == *other
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

impl fmt::Debug for Digest {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

/// The type of a topic's messages.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct WireType {
    /// `package/Type`, in ROS 2 `package/msg/Type`, or `*` if unknown.
    pub name: String,
    /// Serialization format.
    pub format: WireFormat,
    /// Digest of the definition with all its dependencies.
    pub digest: Digest,
    /// Full text of the definition with dependencies if known (ROS 1 publishers send it), otherwise empty.
    pub definition: String,
}

impl WireType {
    /// Creates a type of the ROS 1 format.
    pub fn new(name: impl Into<String>, digest: impl Into<Digest>, definition: impl Into<String>) -> Self {
        Self { name: name.into(), format: WireFormat::Ros1, digest: digest.into(), definition: definition.into() }
    }

    /// Returns the type with the format of the given ROS version.
    pub fn with_version(self, version: RosVersion) -> Self {
        let format = WireFormat::for_version(version);
        Self { format, ..self }
    }

    /// Creates the type of a known definition.
    pub fn from_message(message: &MessageType) -> Self {
        Self {
            format: WireFormat::for_version(message.version()),
            ..Self::new(message.name(), message.digest(), message.full_text())
        }
    }

    /// Creates a type of which only the name is known; it is compatible with any definition.
    pub fn with_name(name: &str) -> Self {
        Self::new(name, "*", "")
    }

    /// Returns the type that matches any type.
    pub fn any() -> Self {
        Self::with_name("*")
    }

    /// Returns true if a subscriber of one type understands messages of the other.
    pub fn is_compatible_with(&self, other: &WireType) -> bool {
        self.format == other.format && self.digest.is_compatible_with(&other.digest)
    }

    /// Returns the message type that the definition describes.
    pub fn schema(&self) -> Result<Arc<MessageType>, SchemaError> {
        let version = self.format.version();
        let schema = MessageType::parse_full_text(version, &self.name, &self.definition)?;
        // ROS 2 publishers do not send their definition. An empty definition is valid, but belongs to few types.
        let is_told = version == RosVersion::One || !self.definition.is_empty();
        if is_told || self.digest == *schema.digest() {
            Ok(schema)
        } else {
            Err(SchemaError::Unknown(self.name.clone()))
        }
    }
}

/// Displays name and digest, for messages to users.
impl fmt::Display for WireType {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {}", self.name, self.digest)
    }
}

/// The type of a service's requests and responses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceType {
    /// `package/Type`, in ROS 2 `package/srv/Type`.
    pub name: String,
    /// Serialization format.
    pub format: WireFormat,
    /// Digest of request and response together.
    pub digest: Digest,
    /// Digest of the request alone, where endpoints announce it (ROS 2); otherwise `*`.
    pub request: Digest,
    /// Digest of the response alone, likewise.
    pub response: Digest,
}

impl ServiceType {
    /// Creates a type of the ROS 1 format.
    pub fn new(name: impl Into<String>, digest: impl Into<Digest>) -> Self {
        Self {
            name: name.into(),
            format: WireFormat::Ros1,
            digest: digest.into(),
            request: Digest::any(),
            response: Digest::any(),
        }
    }

    /// Returns the type with the format of the given ROS version.
    pub fn with_version(self, version: RosVersion) -> Self {
        let format = WireFormat::for_version(version);
        Self { format, ..self }
    }

    /// Creates the type of a known definition.
    pub fn from_service(service: &ServiceDef) -> Self {
        let of = |message: &MessageType| match message.version() {
            RosVersion::One => Digest::any(),
            RosVersion::Two => Digest::from(message.digest()),
        };
        Self {
            format: WireFormat::for_version(service.request.version()),
            request: of(&service.request),
            response: of(&service.response),
            ..Self::new(&*service.name, &*service.md5)
        }
    }

    /// Returns true if a client of one type can call a server of the other.
    pub fn is_compatible_with(&self, other: &ServiceType) -> bool {
        self.digest.is_compatible_with(&other.digest)
            && self.request.is_compatible_with(&other.request)
            && self.response.is_compatible_with(&other.response)
    }

    /// Returns true if name and digests agree, as far as they are known.
    pub fn matches(&self, other: &ServiceType) -> bool {
        self.name == other.name && self.is_compatible_with(other)
    }

    /// Returns the error for `what` having this type at the peer and `ours` here. It names what differs: the type names
    /// or else the digests.
    pub fn mismatch(&self, ours: &ServiceType, what: String) -> BusError {
        let pairs = [(&self.digest, &ours.digest), (&self.request, &ours.request), (&self.response, &ours.response)];
        let differ = |(theirs, ours): &(&Digest, &Digest)| !theirs.is_compatible_with(ours);
        let digests = pairs.into_iter().find(differ);
        let (theirs, ours) = match digests.filter(|_| self.name == ours.name) {
            Some((theirs, of_ours)) => (format!("{} {theirs}", self.name), format!("{} {of_ours}", ours.name)),
            None => (self.name.clone(), ours.name.clone()),
        };
        BusError::TypeMismatch { what, theirs, ours }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_of_ros_2_that_tells_no_definition_has_none() {
        let of = |text: &str| {
            let found = MessageType::parse_full_text(RosVersion::Two, "a/msg/B", text);
            WireType::from_message(&found.expect("a definition"))
        };
        let (string, empty) = (of("string data"), of(""));
        assert!(string.schema().is_ok() && empty.schema().is_ok());
        let untold = WireType { definition: String::new(), ..string };
        assert_eq!(untold.schema().err(), Some(SchemaError::Unknown("a/msg/B".to_owned())));
    }

    #[test]
    fn services_agree_by_what_is_known_of_them() {
        let known = |request: &str| ServiceType { request: Digest::from(request), ..ServiceType::new("a/srv/B", "*") };
        assert!(known("x").is_compatible_with(&known("x")) && known("x").is_compatible_with(&known("*")));
        assert!(!known("x").is_compatible_with(&known("y")));
        assert!(!ServiceType::new("a/B", "x").is_compatible_with(&ServiceType::new("a/B", "y")));
    }

    #[test]
    fn types_are_told_by_what_they_differ_in() {
        let of =
            |name: &str, request: &str| ServiceType { request: Digest::from(request), ..ServiceType::new(name, "*") };
        let told = |theirs: ServiceType, ours: ServiceType| {
            assert!(!theirs.matches(&ours));
            theirs.mismatch(&ours, "service /x".to_owned()).to_string()
        };
        assert_eq!(told(of("a/srv/B", "x"), of("c/srv/D", "y")), "service /x is a/srv/B there and c/srv/D here");
        assert_eq!(told(of("a/srv/B", "x"), of("a/srv/B", "y")), "service /x is a/srv/B x there and a/srv/B y here");
    }
}
