//! Every message, service and action of the ROS 2 packages at hand, and the digests of Debian's packages of ROS 1.

use std::path::{Path, PathBuf};

use ros_message::RosVersion::{One, Two};
use ros_message::codec::CodecErrorKind;
use ros_message::schema::Base;

use super::property::{Choices, random_message};
use super::*;

/// MD5 of Debian bookworm's message packages: `package/Type` or `package/srv/Type`, then the MD5 that `rosmsg md5` and
/// `rossrv md5` print.
const DEBIAN: &str = include_str!("debian.txt");

/// Types of which ROS 2 alone has some fields or a shorter array.
const LOSSY: [&str; 4] = [
    "sensor_msgs/msg/Range",
    "visualization_msgs/msg/Marker",
    "shape_msgs/msg/SolidPrimitive",
    "rcl_interfaces/msg/Log",
];

/// Returns the definitions of the environment with ROS 2.
fn packaged_registry() -> Arc<Registry> {
    let prefix = std::env::var_os("CLOUDROID_ROS2_PREFIX");
    let prefix = prefix.expect("CLOUDROID_ROS2_PREFIX names the environment with ROS 2; run the tests by make test");
    let registry = Registry::for_version(Two);
    let list = |path: &Path| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(path).into_iter().flatten();
        entries.map(|entry| entry.unwrap().path()).collect()
    };
    for package in list(&Path::new(&prefix).join("share")) {
        for kind in ["msg", "srv", "action"] {
            for file in list(&package.join(kind)) {
                if file.extension().is_some_and(|extension| extension == kind) {
                    let name = |path: &Path| path.file_stem().unwrap().to_str().unwrap().to_owned();
                    let key = format!("{}/{kind}/{}", name(&package), name(&file));
                    registry.insert(&key, &std::fs::read_to_string(&file).unwrap()).unwrap();
                }
            }
        }
    }
    Arc::new(registry)
}

fn is_lossy(message: &MessageType) -> bool {
    LOSSY.contains(&message.name())
        || message.fields().iter().any(|field| matches!(&field.base, Base::Message(inner) if is_lossy(inner)))
}

/// Carries random messages there and back, from both sides.
fn check(
    original: &MessageType,
    twin: &MessageType,
    to_twin: &crate::MessageTranslator,
    from_twin: &crate::MessageTranslator,
) {
    let mut dice = 0x9e37_79b9_7f4a_7c15u64;
    let mut choices = vec![0; 4000];
    for round in 0..8 {
        for choice in &mut choices {
            // xorshift64
            dice ^= dice << 13;
            dice ^= dice >> 7;
            dice ^= dice << 17;
            *choice = dice as u8;
        }
        let bytes = random_message(original, false, &mut Choices::new(&choices));
        let carried = to_twin.translate(&bytes).unwrap();
        ros_message::codec::validate(twin, &carried).unwrap();
        let back = from_twin.translate(&carried).unwrap();
        if !is_lossy(original) {
            assert_eq!(back, bytes, "{original:?}, round {round}");
        }
        assert_eq!(to_twin.translate(&back).unwrap(), carried, "{original:?}, round {round}");
        let big = random_message(original, true, &mut Choices::new(&choices));
        assert_eq!(to_twin.translate(&big).unwrap(), carried, "{original:?}, round {round}");

        let bytes = random_message(twin, false, &mut Choices::new(&choices));
        let carried = match from_twin.translate(&bytes) {
            // ROS 1 has no bounds.
            Err(error) if matches!(error.kind, CodecErrorKind::TooMany { .. }) => continue,
            carried => carried.unwrap(),
        };
        ros_message::codec::validate(original, &carried).unwrap();
        if !original.name().ends_with("/Log") {
            assert_eq!(to_twin.translate(&carried).unwrap(), bytes, "{twin:?}, round {round}");
        }
    }
    assert_eq!(to_twin.saturated_count() + from_twin.saturated_count(), 0, "{original:?}");
}

#[test]
fn every_packaged_definition_has_a_twin_and_its_messages_come_back() {
    let registry = packaged_registry();
    let translations = TypeTranslations::new(TranslationRules::default());
    let (mut messages, mut services, mut actions) = (0, 0, 0);
    for key in registry.keys() {
        match key.split('/').nth(1) {
            Some("msg") => {
                let pair = translations.message(&registry.message(&key).unwrap()).unwrap();
                check(&pair.original, &pair.twin, &pair.to_twin, &pair.from_twin);
                messages += 1;
            }
            Some("srv") => {
                let pair = translations.service(&registry.service(&key).unwrap()).unwrap();
                check(&pair.original.request, &pair.twin.request, &pair.request_to_twin, &pair.request_from_twin);
                check(&pair.original.response, &pair.twin.response, &pair.response_to_twin, &pair.response_from_twin);
                services += 1;
            }
            _ => {
                let pair = translations.action(&registry.action(&key).unwrap()).unwrap();
                for part in [&pair.goal, &pair.result, &pair.feedback] {
                    check(&part.original, &part.twin, &part.to_twin, &part.from_twin);
                }
                actions += 1;
            }
        }
    }
    assert!(messages > 150 && services > 20 && actions > 1, "{messages} {services} {actions}");
}

/// A node of ROS 1 refuses messages whose MD5 is not that of the definition that it was compiled with.
#[test]
fn derived_definitions_have_the_md5_of_debian_s_packages() {
    let registry = packaged_registry();
    let translations = TypeTranslations::new(TranslationRules::default());
    let mut compared = 0;
    for line in DEBIAN.lines() {
        let (name, md5) = line.split_once(' ').unwrap();
        let derived = if name.contains("/srv/") {
            registry.service(name).map(|service| translations.service(&service).unwrap().twin.md5.clone())
        } else {
            let two = translations.message_name(name, One);
            registry.message(&two).map(|message| translations.message(&message).unwrap().twin.md5().to_owned())
        };
        if let Ok(derived) = derived {
            assert_eq!(derived, md5, "{name}");
            compared += 1;
        }
    }
    assert!(compared > 125, "{compared}");
}

/// A node of ROS 2 reads messages by the definition that it was compiled with, whatever they were written by.
#[test]
fn twins_of_twins_have_the_hash_of_the_package() {
    let registry = packaged_registry();
    let translations = TypeTranslations::new(TranslationRules::default());
    for line in DEBIAN.lines().filter(|line| !line.contains("/srv/")) {
        let name = line.split_once(' ').unwrap().0;
        let Ok(packaged) = registry.message(&translations.message_name(name, One)) else {
            continue;
        };
        let one = translations.message(&packaged).unwrap().twin.clone();
        let two = translations.message(&one).unwrap().twin.clone();
        assert_eq!((two.name(), two.digest()), (packaged.name(), packaged.digest()));
    }
}
