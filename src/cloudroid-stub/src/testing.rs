//! What tests of both ROSes share: one text, two worlds.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ros::JoinOptions;
use ros::bus::{Bus, Message, RosVersion, WireType};
use ros::net::HostSockets;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;

use crate::local::PrivateDomain;

/// Generous: it only bounds how long a failing test takes.
pub const SOON: Duration = Duration::from_secs(120);

/// Has stories, which take the ROS that they are told of, run as tests.
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

/// A ROS system of this machine, which ends with it: a Master, or a domain that nobody else is in.
pub struct World {
    ros: RosVersion,
    options: JoinOptions,
    domain: Option<PrivateDomain>,
}

impl World {
    pub async fn new(ros: RosVersion) -> Self {
        let (options, domain) = match ros {
            RosVersion::One => (JoinOptions::new(master().await, ""), None),
            RosVersion::Two => {
                let domain = PrivateDomain::take(None).unwrap();
                (JoinOptions::in_domain(domain.id(), ""), Some(domain))
            }
        };
        Self {
            ros,
            options,
            domain,
        }
    }

    /// A node of this name there.
    pub async fn node(&self, name: &str) -> Arc<dyn Bus> {
        let options = JoinOptions {
            node: name.to_owned(),
            ..self.options.clone()
        };
        let joined = ros::connect(self.ros, Arc::new(HostSockets), options);
        joined.await.unwrap()
    }

    /// Its number, where it is a domain.
    pub fn domain(&self) -> Option<u16> {
        self.domain.as_ref().map(PrivateDomain::id)
    }
}

async fn master() -> SocketAddr {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions {
        uri: format!("http://{address}/"),
        ..MasterOptions::default()
    });
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    address
}

/// `std_msgs/String`, as each ROS has it.
pub fn string_type(ros: RosVersion) -> WireType {
    let registry = Registry::of(ros);
    let inserted = registry.insert("std_msgs/msg/String", "string data\n");
    let known = inserted.and_then(|()| registry.message("std_msgs/String"));
    WireType::of(&known.unwrap())
}

/// A serialized string.
pub fn written(ros: RosVersion, text: &str) -> Bytes {
    let (header, end): (&[u8], &[u8]) = match ros {
        RosVersion::One => (&[], &[]),
        RosVersion::Two => (&[0, 1, 0, 0], &[0]),
    };
    let length = u32::try_from(text.len() + end.len()).unwrap();
    [header, &length.to_le_bytes(), text.as_bytes(), end]
        .concat()
        .into()
}

/// A message of a node of the application.
pub fn string(ros: RosVersion, text: &str) -> Message {
    Message {
        bytes: written(ros, text),
        wire_type: Arc::new(string_type(ros)),
        publisher: "/app".into(),
        latching: false,
    }
}

/// What a serialized string says.
pub fn read(ros: RosVersion, message: &[u8]) -> String {
    let begin = match ros {
        RosVersion::One => 4,
        RosVersion::Two => 8,
    };
    let text = String::from_utf8(message[begin..].to_vec()).unwrap();
    // CDR has its end, and fills up to four bytes.
    text.trim_end_matches('\0').to_owned()
}

/// What a message says.
pub fn text(message: &Message) -> String {
    read(message.wire_type.format.version(), &message.bytes)
}
