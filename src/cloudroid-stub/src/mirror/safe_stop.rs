//! The message that brings the robot to rest when nobody answers in time.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use bytes::Bytes;
use qos::SafeStop;
use ros::bus::{Bus, Publisher, Qos, WireType};
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
        let of = definition(&stop.type_name, &shares())
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

/// A message of zeros.
pub fn zeros(wire_type: &WireType) -> Result<Bytes, String> {
    let of = MessageType::from_full_text(&wire_type.name, &wire_type.definition);
    let of = of.map_err(|error| error.to_string())?;
    Ok(vec![0; of.min_size()].into())
}

/// Directories that hold packages' definitions.
fn shares() -> Vec<PathBuf> {
    let named = |name: &str| -> Vec<PathBuf> {
        let value = std::env::var_os(name).unwrap_or_default();
        std::env::split_paths(&value).collect()
    };
    let mut shares = named("ROS_PACKAGE_PATH");
    let prefixes = named("CMAKE_PREFIX_PATH")
        .into_iter()
        .chain(["/usr".into()]);
    shares.extend(prefixes.map(|prefix| prefix.join("share")));
    shares
}

/// A type with all it contains, from the robot's packages.
fn definition(type_name: &str, shares: &[PathBuf]) -> anyhow::Result<Arc<MessageType>> {
    let registry = Registry::new();
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
        assert_eq!(definition("a_msgs/Halt", &shares).unwrap().min_size(), 49);
        let twist = definition("geometry_msgs/Twist", &[]).unwrap();
        assert_eq!(twist.md5(), "9f195f881246fdfa2798d1d3eebca84a");
        assert!(definition("c_msgs/None", &shares).is_err());
    }
}
