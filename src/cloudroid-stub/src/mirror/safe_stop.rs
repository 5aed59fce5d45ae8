//! The message that stops the robot when neither side answers in time.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use bytes::Bytes;
use qos::SafeStop;
use ros::bus::{Bus, Publisher, QosProfile, RosVersion, WireType};
use ros::schema::{MessageType, Registry, SchemaError};

/// The usual type, built in because robots without development packages have no definitions.
const TWIST: [(&str, &str); 2] = [
    ("geometry_msgs/msg/Twist", "Vector3 linear\nVector3 angular\n"),
    ("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
];

/// Publisher of the safe-stop message, advertised and serialized in advance so that subscribers are connected when it
/// is needed.
pub struct SafeStopPublisher {
    publisher: Box<dyn Publisher>,
    bytes: Bytes,
}

impl SafeStopPublisher {
    /// Advertises the topic for a message with a declared type, whichever other publishers it has.
    pub async fn new(stop: &SafeStop, bus: &Arc<dyn Bus>) -> anyhow::Result<Self> {
        let version = bus.version();
        let of = find_type(version, &stop.type_name, &share_directories(version))
            .with_context(|| format!("safe_stop: {} is not known on this robot", stop.type_name))?;
        let json = serde_json::to_vec(&stop.message)?;
        let mut bytes = Vec::new();
        ros::codec::from_json(&of, &json, &mut bytes, &Default::default())
            .with_context(|| format!("safe_stop: its message is not a {}", stop.type_name))?;
        Ok(Self {
            publisher: bus.advertise(&stop.topic, WireType::from_message(&of), QosProfile::keep_last(1)).await?,
            bytes: bytes.into(),
        })
    }

    /// Publishes the safe-stop message.
    pub fn publish(&self) {
        self.publisher.publish(self.bytes.clone());
    }
}

/// Returns a zero message; for ROS 2, with the defaults of the type's definition.
pub fn zero_message(wire_type: &WireType) -> anyhow::Result<Bytes> {
    let of = wire_type.schema()?;
    if of.version() == RosVersion::One {
        return Ok(vec![0; of.min_size()].into());
    }
    let mut bytes = Vec::new();
    ros::codec::from_json(&of, b"{}", &mut bytes, &Default::default())?;
    Ok(bytes.into())
}

/// Returns the directories that hold definitions of packages.
fn share_directories(version: RosVersion) -> Vec<PathBuf> {
    let named = |name: &str| -> Vec<PathBuf> {
        let value = std::env::var_os(name).unwrap_or_default();
        std::env::split_paths(&value).collect()
    };
    let (mut shares, prefixes) = match version {
        RosVersion::One => (named("ROS_PACKAGE_PATH"), named("CMAKE_PREFIX_PATH")),
        RosVersion::Two => (Vec::new(), named("AMENT_PREFIX_PATH")),
    };
    let prefixes = prefixes.into_iter().chain(["/usr".into()]);
    shares.extend(prefixes.map(|prefix| prefix.join("share")));
    shares
}

/// Finds a type and all that it contains in the robot's packages.
fn find_type(version: RosVersion, type_name: &str, shares: &[PathBuf]) -> anyhow::Result<Arc<MessageType>> {
    let registry = Registry::for_version(version);
    for (key, text) in TWIST {
        registry.insert(key, text)?;
    }
    let mut read = Vec::new();
    let mut wanted = type_name.to_owned();
    loop {
        let package = wanted.split('/').next().unwrap_or_default().to_owned();
        if !read.contains(&package) {
            for share in shares {
                insert_package(&registry, share, &package)?;
            }
            read.push(package);
        }
        match registry.message(type_name) {
            Ok(known) => return Ok(known),
            Err(SchemaError::Missing { name, .. }) if name != wanted => wanted = name,
            Err(error) => bail!("{error}"),
        }
    }
}

fn insert_package(registry: &Registry, share: &Path, package: &str) -> anyhow::Result<()> {
    let Ok(files) = std::fs::read_dir(share.join(package).join("msg")) else {
        return Ok(());
    };
    for file in files {
        let path = file?.path();
        if path.extension().is_some_and(|end| end == "msg") {
            let name = path.file_stem().unwrap_or_default().to_string_lossy();
            let text = std::fs::read_to_string(&path)?;
            registry.insert(&format!("{package}/msg/{name}"), &text)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_found_with_what_they_contain() {
        let place = tempfile::tempdir().unwrap();
        for (name, text) in [
            ("a_msgs/msg/Halt.msg", "b_msgs/Why why\ngeometry_msgs/Twist twist\n"),
            ("b_msgs/msg/Why.msg", "uint8 code\n"),
        ] {
            let path = place.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        let shares = [place.path().to_owned()];
        let of_one = |name: &str, shares: &[PathBuf]| find_type(RosVersion::One, name, shares);
        assert_eq!(of_one("a_msgs/Halt", &shares).unwrap().min_size(), 49);
        let twist = of_one("geometry_msgs/Twist", &[]).unwrap();
        assert_eq!(twist.md5(), "9f195f881246fdfa2798d1d3eebca84a");
        assert!(of_one("c_msgs/None", &shares).is_err());
        // The same files result in other names and hashes.
        let of_two = |name: &str| find_type(RosVersion::Two, name, &shares).unwrap();
        assert_eq!(of_two("a_msgs/Halt").name(), "a_msgs/msg/Halt");
        let twist = of_two("geometry_msgs/msg/Twist");
        assert_eq!(twist.digest(), "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a");
    }

    #[test]
    fn zeros_of_ros_2_are_cdr() {
        let of = find_type(RosVersion::Two, "geometry_msgs/Twist", &[]).unwrap();
        let zeros = zero_message(&WireType::from_message(&of)).unwrap();
        assert_eq!(zeros.len(), 4 + 6 * 8);
        assert_eq!((&zeros[..4], zeros[4..].iter().max()), (&[0, 1, 0, 0][..], Some(&0)));
    }
}
