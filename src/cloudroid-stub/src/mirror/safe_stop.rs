//! The message that brings the robot to rest when nobody answers in time.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use bytes::Bytes;
use qos::SafeStop;
use ros::bus::{Bus, Publisher, Qos, RosVersion, WireType};
use ros::schema::{MessageType, Registry, SchemaError};

/// The usual one; robots without development packages have no definitions at all.
const TWIST: [(&str, &str); 2] = [
    (
        "geometry_msgs/msg/Twist",
        "Vector3 linear\nVector3 angular\n",
    ),
    (
        "geometry_msgs/msg/Vector3",
        "float64 x\nfloat64 y\nfloat64 z\n",
    ),
];

/// Advertised and serialized ahead: listeners are connected when it is needed.
pub struct Stop {
    publisher: Box<dyn Publisher>,
    bytes: Bytes,
}

impl Stop {
    /// For a message whose type is given, whoever else publishes on its topic.
    pub async fn new(stop: &SafeStop, bus: &Arc<dyn Bus>) -> anyhow::Result<Self> {
        let version = bus.version();
        let of = definition(version, &stop.type_name, &shares(version))
            .with_context(|| format!("safe_stop: {} is not known on this robot", stop.type_name))?;
        let json = serde_json::to_vec(&stop.message)?;
        let mut bytes = Vec::new();
        ros::codec::from_json(&of, &json, &mut bytes, &Default::default())
            .with_context(|| format!("safe_stop: its message is no {}", stop.type_name))?;
        Ok(Self {
            publisher: bus
                .advertise(&stop.topic, WireType::of(&of), Qos::keep_last(1))
                .await?,
            bytes: bytes.into(),
        })
    }

    /// Publishes the safe message.
    pub fn publish(&self) {
        self.publisher.publish(self.bytes.clone());
    }
}

/// A message of zeros; of ROS 2, of what its definition gives fields that nobody sets.
pub fn zeros(wire_type: &WireType) -> Result<Bytes, String> {
    let of = wire_type.schema().map_err(|error| error.to_string())?;
    if of.version() == RosVersion::One {
        return Ok(vec![0; of.min_size()].into());
    }
    let mut bytes = Vec::new();
    ros::codec::from_json(&of, b"{}", &mut bytes, &Default::default())
        .map_err(|error| error.to_string())?;
    Ok(bytes.into())
}

/// Directories that hold packages' definitions.
fn shares(version: RosVersion) -> Vec<PathBuf> {
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

/// A type with all it contains, from the robot's packages.
fn definition(
    version: RosVersion,
    type_name: &str,
    shares: &[PathBuf],
) -> anyhow::Result<Arc<MessageType>> {
    let registry = Registry::of(version);
    for (key, text) in TWIST {
        registry.insert(key, text)?;
    }
    let mut read = Vec::new();
    let mut wanted = type_name.to_owned();
    loop {
        let package = wanted.split('/').next().unwrap_or_default().to_owned();
        if !read.contains(&package) {
            for share in shares {
                insert(&registry, share, &package)?;
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

fn insert(registry: &Registry, share: &Path, package: &str) -> anyhow::Result<()> {
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
            (
                "a_msgs/msg/Halt.msg",
                "b_msgs/Why why\ngeometry_msgs/Twist twist\n",
            ),
            ("b_msgs/msg/Why.msg", "uint8 code\n"),
        ] {
            let path = place.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        let shares = [place.path().to_owned()];
        let of_one = |name: &str, shares: &[PathBuf]| definition(RosVersion::One, name, shares);
        assert_eq!(of_one("a_msgs/Halt", &shares).unwrap().min_size(), 49);
        let twist = of_one("geometry_msgs/Twist", &[]).unwrap();
        assert_eq!(twist.md5(), "9f195f881246fdfa2798d1d3eebca84a");
        assert!(of_one("c_msgs/None", &shares).is_err());
        // The same files, and other names and hashes.
        let of_two = |name: &str| definition(RosVersion::Two, name, &shares).unwrap();
        assert_eq!(of_two("a_msgs/Halt").name(), "a_msgs/msg/Halt");
        let twist = of_two("geometry_msgs/msg/Twist");
        assert_eq!(
            twist.digest(),
            "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
        );
    }

    #[test]
    fn zeros_of_ros_2_are_cdr() {
        let of = definition(RosVersion::Two, "geometry_msgs/Twist", &[]).unwrap();
        let zeros = zeros(&WireType::of(&of)).unwrap();
        assert_eq!(zeros.len(), 4 + 6 * 8);
        assert_eq!(
            (&zeros[..4], zeros[4..].iter().max()),
            (&[0, 1, 0, 0][..], Some(&0))
        );
    }
}
