//! The types of topics and services as their ends declare them to each other.

use std::fmt;
use std::sync::Arc;

use crate::bus::{BusError, RosVersion};
use crate::schema::{MessageType, SchemaError, ServiceDef};

/// How messages are written between the ends of a topic or service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WireFormat {
    /// Little endian, unaligned, lengths of four bytes (<http://wiki.ros.org/ROS/Technical%20Overview>).
    #[default]
    Ros1,
    /// ROS 2's: the header of a representation, and CDR.
    Cdr,
}

impl WireFormat {
    /// That of a version of ROS.
    pub fn of(version: RosVersion) -> Self {
        match version {
            RosVersion::One => Self::Ros1,
            RosVersion::Two => Self::Cdr,
        }
    }

    /// Which ROS writes so.
    pub fn version(self) -> RosVersion {
        match self {
            Self::Ros1 => RosVersion::One,
            Self::Cdr => RosVersion::Two,
        }
    }
}

/// What tells definitions of one name apart: the MD5 of a ROS 1 type, 32 lower-case hex digits, or the type hash of a ROS 2
/// type (`RIHS01_…`).
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Digest(Arc<str>);

impl Digest {
    /// `*`: agrees with all.
    pub fn any() -> Self {
        Self::from("*")
    }

    /// Whether it is `*`.
    pub fn is_any(&self) -> bool {
        &*self.0 == "*"
    }

    /// As text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Whether ends with these digests understand each other.
    pub fn agrees(&self, other: &Digest) -> bool {
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
    /// `package/Type`, of ROS 2 `package/msg/Type`, or `*` where nobody has said.
    pub name: String,
    /// How its messages are written.
    pub format: WireFormat,
    /// Of its definition and all that this contains.
    pub digest: Digest,
    /// The full text with dependencies, where it is known (ROS 1 publishers send it), else empty.
    pub definition: String,
}

impl WireType {
    /// A type of the ROS 1 format.
    pub fn new(
        name: impl Into<String>,
        digest: impl Into<Digest>,
        definition: impl Into<String>,
    ) -> Self {
        Self {
            name: name.into(),
            format: WireFormat::Ros1,
            digest: digest.into(),
            definition: definition.into(),
        }
    }

    /// The same, written as this version of ROS does.
    pub fn written_by(self, version: RosVersion) -> Self {
        let format = WireFormat::of(version);
        Self { format, ..self }
    }

    /// A type whose definition is known.
    pub fn of(message: &MessageType) -> Self {
        Self {
            format: WireFormat::of(message.version()),
            ..Self::new(message.name(), message.digest(), message.full_text())
        }
    }

    /// A type of which only the name is known: any definition will do.
    pub fn named(name: &str) -> Self {
        Self::new(name, "*", "")
    }

    /// Any type.
    pub fn any() -> Self {
        Self::named("*")
    }

    /// Whether messages of one are understood by who expects the other.
    pub fn agrees(&self, other: &WireType) -> bool {
        self.format == other.format && self.digest.agrees(&other.digest)
    }

    /// What its definition says.
    pub fn schema(&self) -> Result<Arc<MessageType>, SchemaError> {
        let version = self.format.version();
        let schema = MessageType::of_full_text(version, &self.name, &self.definition)?;
        // Publishers of ROS 2 do not send it. Nothing is the definition of few types.
        let is_told = version == RosVersion::One || !self.definition.is_empty();
        match is_told || self.digest == *schema.digest() {
            true => Ok(schema),
            false => Err(SchemaError::Unknown(self.name.clone())),
        }
    }
}

/// Name and digest, for messages.
impl fmt::Display for WireType {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {}", self.name, self.digest)
    }
}

/// The type of a service's requests and responses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceType {
    /// `package/Type`, of ROS 2 `package/srv/Type`.
    pub name: String,
    /// How its messages are written.
    pub format: WireFormat,
    /// Of request and response together.
    pub digest: Digest,
    /// Of its requests alone, where ends tell that of each other (ROS 2); else `*`.
    pub request: Digest,
    /// Of its responses alone, likewise.
    pub response: Digest,
}

impl ServiceType {
    /// A type of the ROS 1 format.
    pub fn new(name: impl Into<String>, digest: impl Into<Digest>) -> Self {
        Self {
            name: name.into(),
            format: WireFormat::Ros1,
            digest: digest.into(),
            request: Digest::any(),
            response: Digest::any(),
        }
    }

    /// The same, written as this version of ROS does.
    pub fn written_by(self, version: RosVersion) -> Self {
        let format = WireFormat::of(version);
        Self { format, ..self }
    }

    /// A type whose definition is known.
    pub fn of(service: &ServiceDef) -> Self {
        let of = |message: &MessageType| match message.version() {
            RosVersion::One => Digest::any(),
            RosVersion::Two => Digest::from(message.digest()),
        };
        Self {
            format: WireFormat::of(service.request.version()),
            request: of(&service.request),
            response: of(&service.response),
            ..Self::new(&*service.name, &*service.md5)
        }
    }

    /// Whether who expects one understands a server of the other.
    pub fn agrees(&self, other: &ServiceType) -> bool {
        self.digest.agrees(&other.digest)
            && self.request.agrees(&other.request)
            && self.response.agrees(&other.response)
    }

    /// Whether it is the other one, as far as is known.
    pub fn is(&self, other: &ServiceType) -> bool {
        self.name == other.name && self.agrees(other)
    }

    /// That `what` is this there, and not what it is here: by what they differ in, their names or else their digests.
    pub fn not(&self, ours: &ServiceType, what: String) -> BusError {
        let pairs = [
            (&self.digest, &ours.digest),
            (&self.request, &ours.request),
            (&self.response, &ours.response),
        ];
        let differ = |(theirs, ours): &(&Digest, &Digest)| !theirs.agrees(ours);
        let digests = pairs.into_iter().find(differ);
        let (theirs, ours) = match digests.filter(|_| self.name == ours.name) {
            Some((theirs, of_ours)) => (
                format!("{} {theirs}", self.name),
                format!("{} {of_ours}", ours.name),
            ),
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
            let found = MessageType::of_full_text(RosVersion::Two, "a/msg/B", text);
            WireType::of(&found.expect("a definition"))
        };
        let (string, empty) = (of("string data"), of(""));
        assert!(string.schema().is_ok() && empty.schema().is_ok());
        let untold = WireType {
            definition: String::new(),
            ..string
        };
        assert_eq!(
            untold.schema().err(),
            Some(SchemaError::Unknown("a/msg/B".to_owned()))
        );
    }

    #[test]
    fn services_agree_by_what_is_known_of_them() {
        let known = |request: &str| ServiceType {
            request: Digest::from(request),
            ..ServiceType::new("a/srv/B", "*")
        };
        assert!(known("x").agrees(&known("x")) && known("x").agrees(&known("*")));
        assert!(!known("x").agrees(&known("y")));
        assert!(!ServiceType::new("a/B", "x").agrees(&ServiceType::new("a/B", "y")));
    }

    #[test]
    fn types_are_told_by_what_they_differ_in() {
        let of = |name: &str, request: &str| ServiceType {
            request: Digest::from(request),
            ..ServiceType::new(name, "*")
        };
        let told = |theirs: ServiceType, ours: ServiceType| {
            assert!(!theirs.is(&ours));
            theirs.not(&ours, "service /x".to_owned()).to_string()
        };
        assert_eq!(
            told(of("a/srv/B", "x"), of("c/srv/D", "y")),
            "service /x is a/srv/B there and c/srv/D here"
        );
        assert_eq!(
            told(of("a/srv/B", "x"), of("a/srv/B", "y")),
            "service /x is a/srv/B x there and a/srv/B y here"
        );
    }
}
