//! Helpers for tests of both ROS versions.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ros::JoinOptions;
use ros::bus::{Bus, RosVersion, SerializedMessage, WireType};
use ros::net::HostSockets;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;

use crate::local::PrivateDomain;

/// A generous timeout, which only limits the duration of a failing test.
pub const SOON: Duration = Duration::from_secs(120);

/// Runs stories, which take a ROS version as argument, as tests.
macro_rules! stories {
    ($($of:ident = $version:ident: $($story:ident),* $(,)?;)*) => {
        $(mod $of {
            use ros::bus::RosVersion;

            $(#[tokio::test]
            async fn $story() {
                super::$story(RosVersion::$version).await;
            })*
        })*
    };
}
pub(crate) use stories;

/// A ROS system on this machine, which ends when it is dropped: a Master, or a domain without other participants.
pub struct World {
    ros: RosVersion,
    options: JoinOptions,
    domain: Option<PrivateDomain>,
}

impl World {
    pub async fn new(ros: RosVersion) -> Self {
        let (options, domain) = match ros {
            RosVersion::One => (JoinOptions::new(start_master().await, ""), None),
            RosVersion::Two => {
                let domain = PrivateDomain::take(None).unwrap();
                (JoinOptions::in_domain(domain.id(), ""), Some(domain))
            }
        };
        Self { ros, options, domain }
    }

    /// Joins as a node of this name.
    pub async fn node(&self, name: &str) -> Arc<dyn Bus> {
        let options = JoinOptions { node: name.to_owned(), ..self.options.clone() };
        let joined = ros::connect(self.ros, Arc::new(HostSockets), options);
        joined.await.unwrap()
    }

    /// Returns the domain id, if it is a domain.
    pub fn domain(&self) -> Option<u16> {
        self.domain.as_ref().map(PrivateDomain::id)
    }
}

async fn start_master() -> SocketAddr {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions { uri: format!("http://{address}/"), ..MasterOptions::default() });
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    address
}

/// Returns the type `std_msgs/String` of a ROS version.
pub fn string_type(ros: RosVersion) -> WireType {
    let registry = Registry::for_version(ros);
    let inserted = registry.insert("std_msgs/msg/String", "string data\n");
    let known = inserted.and_then(|()| registry.message("std_msgs/String"));
    WireType::from_message(&known.unwrap())
}

/// Serializes a string.
pub fn encode_string(ros: RosVersion, text: &str) -> Bytes {
    let (header, end): (&[u8], &[u8]) = match ros {
        RosVersion::One => (&[], &[]),
        RosVersion::Two => (&[0, 1, 0, 0], &[0]),
    };
    let length = u32::try_from(text.len() + end.len()).unwrap();
    [header, &length.to_le_bytes(), text.as_bytes(), end].concat().into()
}

/// Returns a message of a node of the application.
pub fn string_message(ros: RosVersion, text: &str) -> SerializedMessage {
    SerializedMessage {
        bytes: encode_string(ros, text),
        wire_type: Arc::new(string_type(ros)),
        publisher: "/app".into(),
        latching: false,
    }
}

/// Decodes a serialized string.
pub fn decode_string(ros: RosVersion, message: &[u8]) -> String {
    let begin = match ros {
        RosVersion::One => 4,
        RosVersion::Two => 8,
    };
    let text = String::from_utf8(message[begin..].to_vec()).unwrap();
    // CDR strings end with a zero byte, and are padded to four bytes.
    text.trim_end_matches('\0').to_owned()
}

/// Returns the text of a message.
pub fn message_text(message: &SerializedMessage) -> String {
    decode_string(message.wire_type.format.version(), &message.bytes)
}
