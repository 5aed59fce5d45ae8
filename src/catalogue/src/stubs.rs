//! Stub archives of published services: composed from the image and the interface, and packed with the robot's program.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use api::stub::{ARCHITECTURES, parse_architecture};
use flate2::{Compression, GzBuilder};
use package::inventory::Inventory;
use package::stub::{
    Content, Contents, Files, MANIFEST, PROGRAM, Portal, ProgramRequest, SIGNATURE, SIGNER, StubInfo, compose, manifest,
};
use ros::bus::RosVersion;
use ros::remaps::Remaps;
use ros::ros2::arguments;
use sign::SigningKey;
use store::RevisionRecord;
use tar::{EntryType, Header};
use translation::TranslationRules;

use crate::twins::interface_for_robots;
use crate::{Error, inventory};

/// Modification time of all files, so that the same input gives the same archive.
const MTIME: u64 = 1_700_000_000;

/// The robot's program for each installed architecture: `stubs/ARCHITECTURE/cloudroid-stub` beside this program or in
/// its installation directories.
pub struct StubPrograms {
    found: Vec<StubProgram>,
}

/// The robot's program for one architecture.
pub struct StubProgram {
    /// One of [`ARCHITECTURES`].
    pub architecture: &'static str,
    path: PathBuf,
}

impl StubPrograms {
    /// Finds the installed programs. They may be added while the daemon runs.
    pub fn find_installed() -> StubPrograms {
        let beside = std::env::current_exe().ok().and_then(|path| Some(path.parent()?.to_owned()));
        let installed = ["/usr/local/lib/cloudroid", "/usr/lib/cloudroid"].map(PathBuf::from);
        let places: Vec<PathBuf> = beside.into_iter().chain(installed).collect();
        Self::find_in(&places)
    }

    fn find_in(places: &[PathBuf]) -> StubPrograms {
        let find = |architecture: &'static str| {
            let of = |place: &PathBuf| place.join("stubs").join(architecture).join(PROGRAM);
            let path = places.iter().map(of).find(|path| path.is_file())?;
            Some(StubProgram { architecture, path })
        };
        StubPrograms { found: ARCHITECTURES.into_iter().filter_map(find).collect() }
    }

    /// Returns the architectures for which a program is installed.
    pub fn architectures(&self) -> Vec<String> {
        self.found.iter().map(|program| program.architecture.to_owned()).collect()
    }

    /// Returns the supported architectures for which no program is installed.
    pub fn missing_architectures(&self) -> Vec<String> {
        let held = self.architectures();
        ARCHITECTURES.into_iter().map(str::to_owned).filter(|architecture| !held.contains(architecture)).collect()
    }

    /// Returns the program for an architecture; `None` means that of this machine.
    pub fn for_architecture(self, asked: Option<&str>) -> Result<StubProgram, Error> {
        let asked = asked.unwrap_or(std::env::consts::ARCH);
        let exists = self.architectures();
        let wanted = parse_architecture(asked);
        self.found
            .into_iter()
            .find(|program| Some(program.architecture) == wanted)
            .ok_or_else(|| Error::UnknownArchitecture { asked: asked.to_owned(), exists })
    }
}

/// Returns whether a text is `HOST` or `HOST:PORT` without characters that are special in files or scripts.
pub fn is_authority(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || "-._:[]".contains(c))
}

/// Robots that an archive is for.
pub struct TargetRobots<'a> {
    /// ROS version of the robots.
    pub ros: RosVersion,
    /// Program for the architecture of the robots.
    pub program: &'a StubProgram,
    /// Address at which robots reach the portal.
    pub portal: &'a Portal,
    /// Rules by which types have counterparts in the robots' ROS.
    pub rules: &'a Arc<TranslationRules>,
}

/// Returns the files of a revision's stub, except the robot's program.
fn compose_files(
    store: &image::Store,
    revision: &RevisionRecord,
    inventory: &Inventory,
    robots: &TargetRobots<'_>,
) -> Result<Files, Error> {
    let no_stub = |error: package::Error| match error {
        package::Error::NoTwins { .. } => Error::NoTwins { service: revision.service.clone(), reason: error },
        error => Error::NoStub { service: revision.service.clone(), reason: error.to_string() },
    };
    let service_ros = revision.flavour.ros.ros_version();
    let ros = robots.ros;
    let interface = interface_for_robots(revision, ros, robots.rules).map_err(no_stub)?;
    let layers = inventory::layers(store, &revision.image)?;
    let contents = match inventory.packages.get(&revision.package) {
        Some(package) => Contents::read(&layers, package).map_err(no_stub)?,
        None => Contents::default(),
    };
    let about = StubInfo {
        ros,
        service_ros,
        service: &revision.service,
        package: &revision.package,
        revision: revision.number,
        image: &revision.image,
        portal: robots.portal,
        architecture: robots.program.architecture,
        outsourced: &inventory.programs.keys().cloned().collect(),
        names: &node_names(revision, inventory, ros),
        interface: &interface,
        stateful: revision.plan.stateful,
        requests: &request_pairs(revision, inventory),
        times: response_times(&revision.plan.sla),
    };
    compose(&about, contents).map_err(no_stub)
}

/// Returns the names that ROS 2 programs give their own nodes, for programs that run once, or once without an explicit
/// name; for a program of several nodes, the name of the first. A robot's launch files seldom name its nodes, and its
/// parameter files refer to these names. The namespace is included if the program sets it (`/camera/detector`), not if
/// the push did, since a robot has its own. Launch files of ROS 1 always name the nodes of its programs; those of
/// robots of ROS 2 may leave it to the names at the push.
fn node_names(revision: &RevisionRecord, inventory: &Inventory, robot: RosVersion) -> BTreeMap<String, String> {
    let mut names = BTreeMap::new();
    let service = revision.flavour.ros.ros_version();
    if service == RosVersion::One && robot == RosVersion::One {
        return names;
    }
    for (program, path) in &inventory.programs {
        let nodes = revision.plan.nodes.iter();
        let nodes: Vec<_> = nodes.filter(|node| node.argv.contains(path)).collect();
        if let Some(node) = arguments::node_for_stub(nodes, |node| &node.argv) {
            let name = match node.name.rsplit_once('/') {
                Some(("", name)) => name,
                Some((_, name)) if service == RosVersion::One || arguments::sets_namespace(&node.argv) => name,
                _ => &node.name,
            };
            names.insert(program.clone(), name.to_owned());
        }
    }
    names
}

/// Returns the request pairs with topics as the programs name them, since a robot's remappings differ from those of the
/// push. For a revision published without request pairs they are decided now.
fn request_pairs(revision: &RevisionRecord, inventory: &Inventory) -> Vec<ProgramRequest> {
    let ros = revision.flavour.ros.ros_version();
    let mut answered: Vec<ProgramRequest> = Vec::new();
    for request in revision.interface.decided_requests(ros) {
        let node = revision.plan.nodes.iter().find(|node| node.name == request.node);
        let program = node.and_then(|node| {
            let mut programs = inventory.programs.iter();
            programs.find(|(_, path)| node.argv.contains(path))
        });
        let remaps =
            node.map(|node| Remaps::parse(ros, node.argv.get(1..).unwrap_or_default(), &node.name)).unwrap_or_default();
        let one = ProgramRequest {
            program: program.map(|(name, _)| name.clone()),
            request: request.pair.map_names(|name| remaps.undo(name).to_owned()),
            node: request.node,
        };
        if !answered.contains(&one) {
            answered.push(one);
        }
    }
    answered
}

/// Returns T_desire and T_max in seconds; if only one is given, it is used for both.
fn response_times(sla: &api::Sla) -> Option<(f64, f64)> {
    let (desire, max) = (sla.rrt.or(sla.max_rrt)?, sla.max_rrt.or(sla.rrt)?);
    Some((desire.as_seconds(), max.as_seconds()))
}

/// A packed stub archive.
pub struct Archive {
    /// Archive, positioned at its start; the file is deleted when closed.
    pub file: File,
    /// Signature in the namespace [`api::stub::ARCHIVE`].
    pub signature: String,
}

/// Builds the archive of a revision's stub.
pub fn build_archive(
    store: &image::Store,
    revision: &RevisionRecord,
    inventory: &Inventory,
    robots: &TargetRobots<'_>,
    key: &SigningKey,
) -> Result<Archive, Error> {
    let mut files = compose_files(store, revision, inventory, robots)?;
    let failed = |error: std::io::Error| Error::NoStub {
        service: revision.service.clone(),
        reason: format!("it could not be packed: {error}"),
    };
    let bytes = std::fs::read(&robots.program.path).map_err(failed)?;
    let executable = true;
    files.insert(format!("lib/{}/{PROGRAM}", revision.package), Content::File { bytes, executable });
    pack(&revision.service, files, key).map_err(failed)
}

fn pack(service: &str, mut files: Files, key: &SigningKey) -> std::io::Result<Archive> {
    sign_all(&mut files, key)?;
    let file = tempfile::tempfile()?;
    let gzip = GzBuilder::new().mtime(0).write(file, Compression::default());
    let mut archive = tar::Builder::new(gzip);
    let top = format!("{service}-stub");
    for directory in directories(files.keys()) {
        let mut header = header(EntryType::Directory, true, 0);
        archive.append_data(&mut header, format!("{top}/{directory}"), std::io::empty())?;
    }
    for (path, content) in &files {
        let at = format!("{top}/{path}");
        match content {
            Content::File { bytes, executable } => {
                let mut header = header(EntryType::Regular, *executable, bytes.len() as u64);
                archive.append_data(&mut header, at, bytes.as_slice())?;
            }
            Content::Link(target) => {
                let mut header = header(EntryType::Symlink, true, 0);
                archive.append_link(&mut header, at, Path::new(target))?;
            }
        }
    }
    let mut file = archive.into_inner()?.finish()?;
    file.flush()?;
    file.seek(SeekFrom::Start(0))?;
    let digest = sign::digest(&mut file)?;
    file.seek(SeekFrom::Start(0))?;
    Ok(Archive { file, signature: key.sign(api::stub::ARCHIVE, &digest) })
}

/// Adds the public key, the list of all files, and the list's signature.
fn sign_all(files: &mut Files, key: &SigningKey) -> std::io::Result<()> {
    let plain = |text: String| Content::File { bytes: text.into_bytes(), executable: false };
    let signer = format!("{}\n", key.public_key().allowed_signers_line());
    files.insert(SIGNER.to_owned(), plain(signer));
    let list = manifest(files);
    let signature = key.sign(api::stub::CONTENTS, &sign::digest(&mut list.as_bytes())?);
    files.insert(MANIFEST.to_owned(), plain(list));
    files.insert(SIGNATURE.to_owned(), plain(signature));
    Ok(())
}

/// Returns all parent directories of the paths, each after its own parent.
fn directories<'a>(paths: impl Iterator<Item = &'a String>) -> BTreeSet<String> {
    let mut directories = BTreeSet::from([String::new()]);
    for path in paths {
        let mut path = path.as_str();
        while let Some((parent, _)) = path.rsplit_once('/') {
            directories.insert(format!("{parent}/"));
            path = parent;
        }
    }
    directories
}

fn header(kind: EntryType, executable: bool, size: u64) -> Header {
    let mut header = Header::new_gnu();
    header.set_entry_type(kind);
    header.set_mode(if executable { 0o755 } else { 0o644 });
    header.set_size(size);
    header.set_mtime(MTIME);
    header.set_uid(0);
    header.set_gid(0);
    header
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use package::interface::Interface;
    use ros::flavour::{Flavour, Version};
    use servant::spec::NodeSpec;
    use store::Plan;

    use super::*;

    fn pack_example(key: &SigningKey) -> (Vec<u8>, String) {
        let executable = true;
        let node = Content::File { bytes: b"#!/bin/sh".to_vec(), executable };
        let files: Files =
            [("lib/p/node".to_owned(), node), ("share/p/a/b".to_owned(), Content::Link("c".into()))].into();
        let mut archive = super::pack("serves", files, key).expect("packed");
        let mut bytes = Vec::new();
        archive.file.read_to_end(&mut bytes).expect("read");
        (bytes, archive.signature)
    }

    #[test]
    fn nodes_of_ros_2_are_called_as_their_programs_call_them() {
        let node = |name: &str, program: &str| NodeSpec {
            name: name.into(),
            argv: vec![program.into(), "--fast".into()],
            environment: BTreeMap::new(),
            directory: String::new(),
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        let put = |namespace: &str, name: &str, program: &str| {
            let mut node = node(&format!("{namespace}/{name}"), program);
            let rule = format!("__ns:={namespace}");
            node.argv.extend(["--ros-args".into(), "-r".into(), rule]);
            node
        };
        let mut second = node("/alto_2", "/opt/p/lib/p/duet");
        let rule = ["--ros-args", "-r", "alto:__node:=alto_2"].map(str::to_owned);
        second.argv.extend(rule);
        let mut revision = RevisionRecord {
            service: "s".into(),
            number: 1,
            image: String::new(),
            published: 0,
            package: "p".into(),
            owner: None,
            source: String::new(),
            flavour: Flavour { ros: Version::Ros2, ..Flavour::default() },
            plan: Plan {
                nodes: vec![
                    put("/front", "camera", "/opt/p/lib/p/camera_node"),
                    node("/arm/gripper", "/opt/p/lib/p/gripper"),
                    node("/left", "/opt/p/lib/p/wheel"),
                    node("/right", "/opt/p/lib/p/wheel"),
                    node("/alto", "/opt/p/lib/p/duet"),
                    second,
                ],
                ..Plan::default()
            },
            interface: Interface::default(),
        };
        let inventory = Inventory {
            programs: ["camera_node", "gripper", "wheel", "duet"]
                .map(|name| (name.to_owned(), format!("/opt/p/lib/p/{name}")))
                .into(),
            ..Inventory::default()
        };
        // A program that runs twice does not determine a name, unless only one of its nodes was left unnamed.
        let expected = [("camera_node", "camera"), ("duet", "alto"), ("gripper", "/arm/gripper")];
        let expected = expected.map(|(program, node)| (program.to_owned(), node.to_owned()));
        for robot in [RosVersion::Two, RosVersion::One] {
            assert_eq!(node_names(&revision, &inventory, robot), expected.clone().into());
        }
        revision.flavour.ros = Version::Ros1;
        assert!(node_names(&revision, &inventory, RosVersion::One).is_empty());
        // A robot's launch file of ROS 2 may leave the name to the program; the namespace is the robot's.
        let names = node_names(&revision, &inventory, RosVersion::Two);
        assert_eq!((&*names["camera_node"], &*names["gripper"]), ("camera", "gripper"));
    }

    #[test]
    fn requests_are_told_as_programs_call_their_topics() {
        use package::interface::{Direction, Topic};
        let topic = |name: &str, direction| Topic {
            name: name.into(),
            type_name: "std_msgs/String".into(),
            md5: String::new(),
            direction,
            nodes: vec!["/left/finder".into()],
            latched: false,
            lazy: false,
            qos: None,
        };
        let definition = ("std_msgs/msg/String".to_owned(), "string data\n".to_owned());
        let revision = RevisionRecord {
            service: "s".into(),
            number: 1,
            image: String::new(),
            published: 0,
            package: "p".into(),
            owner: None,
            source: String::new(),
            flavour: Flavour::default(),
            plan: Plan {
                nodes: vec![NodeSpec {
                    name: "/left/finder".into(),
                    argv: ["/opt/p/lib/p/find", "image:=/camera", "_rate:=2"].map(str::to_owned).into(),
                    environment: BTreeMap::new(),
                    directory: String::new(),
                    respawn: false,
                    respawn_delay: 0.0,
                    required: false,
                }],
                ..Plan::default()
            },
            // Published by an earlier release, without request pairs.
            interface: Interface {
                topics: vec![topic("/camera", Direction::Input), topic("/left/finder/found", Direction::Output)],
                definitions: [definition].into(),
                ..Interface::default()
            },
        };
        let inventory = Inventory {
            programs: [("find".to_owned(), "/opt/p/lib/p/find".to_owned())].into(),
            ..Inventory::default()
        };
        let expected = ProgramRequest {
            node: "/left/finder".into(),
            program: Some("find".into()),
            request: "/left/image -> /left/finder/found by arrival".parse().expect("a pair"),
        };
        assert_eq!(request_pairs(&revision, &inventory), [expected]);
    }

    #[test]
    fn the_same_files_make_the_same_archive_and_each_has_its_mode() {
        let (key, _) = SigningKey::generate().expect("made");
        let (bytes, signature) = pack_example(&key);
        assert_eq!((bytes.clone(), signature), pack_example(&key));
        let mut archive = tar::Archive::new(flate2::read::GzDecoder::new(&bytes[..]));
        let entries: Vec<(String, u32)> = archive
            .entries()
            .expect("an archive")
            .map(|entry| {
                let entry = entry.expect("an entry");
                let path = entry.path().expect("a path").display().to_string();
                (path, entry.header().mode().expect("a mode"))
            })
            .collect();
        let expected = [
            ("serves-stub/", 0o755),
            ("serves-stub/lib/", 0o755),
            ("serves-stub/lib/p/", 0o755),
            ("serves-stub/share/", 0o755),
            ("serves-stub/share/p/", 0o755),
            ("serves-stub/share/p/a/", 0o755),
            ("serves-stub/MANIFEST", 0o644),
            ("serves-stub/MANIFEST.sig", 0o644),
            ("serves-stub/lib/p/node", 0o755),
            ("serves-stub/server.pub", 0o644),
            ("serves-stub/share/p/a/b", 0o755),
        ];
        let expected = expected.map(|(path, mode)| (path.to_owned(), mode));
        assert_eq!(entries, expected);
    }

    #[test]
    fn an_archive_is_signed_as_such() {
        let (key, _) = SigningKey::generate().expect("made");
        let (mut bytes, signature) = pack_example(&key);
        let verify = |bytes: &[u8]| {
            let digest = sign::digest(&mut &*bytes).expect("read");
            key.public_key().verify(api::stub::ARCHIVE, &digest, &signature)
        };
        verify(&bytes).expect("signed");
        bytes.pop();
        verify(&bytes).expect_err("truncated");
    }

    #[test]
    fn architectures_are_held_or_lacking() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("stubs/aarch64");
        std::fs::create_dir_all(&directory).expect("made");
        std::fs::write(directory.join(PROGRAM), "").expect("written");
        let look = || StubPrograms::find_in(&[place.path().to_owned()]);
        assert_eq!(look().architectures(), ["aarch64"]);
        assert_eq!(look().missing_architectures(), ["x86_64", "armv7"]);
        assert_eq!(look().for_architecture(Some("arm64")).ok().map(|program| program.architecture), Some("aarch64"));
        let refused = look().for_architecture(Some("riscv64")).err();
        assert!(
            matches!(&refused, Some(Error::UnknownArchitecture { exists, .. }) if *exists == ["aarch64"]),
            "{refused:?}"
        );
    }

    #[test]
    fn an_address_holds_nothing_that_could_be_misunderstood() {
        assert!(is_authority("server.local:9090") && is_authority("[::1]:9090"));
        assert!(!is_authority("a\"b") && !is_authority("") && !is_authority("a/b"));
    }
}
