//! Stubs of published services: composed from the image and the interface, packed with the robot's program.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use api::stub::{ARCHITECTURES, architecture};
use flate2::{Compression, GzBuilder};
use package::inventory::Inventory;
use package::stub::{
    About, Answered, Content, Contents, Files, MANIFEST, PROGRAM, Portal, SIGNATURE, SIGNER,
    compose, manifest,
};
use ros::bus::RosVersion;
use ros::remaps::Remaps;
use ros::ros2::arguments;
use sign::SigningKey;
use store::RevisionRecord;
use tar::{EntryType, Header};

use crate::{Error, inventory};

/// The time of every file: the same input gives the same archive.
const MTIME: u64 = 1_700_000_000;

/// The robot's program, for each architecture that there is one for: `stubs/ARCHITECTURE/cloudroid-stub` beside
/// this program or where it is installed.
pub struct Programs {
    found: Vec<Program>,
}

/// A program of a stub.
pub struct Program {
    /// As in [`ARCHITECTURES`].
    pub architecture: &'static str,
    path: PathBuf,
}

impl Programs {
    /// Looks for them. They may be added while the daemon runs.
    pub fn look() -> Programs {
        let beside = std::env::current_exe()
            .ok()
            .and_then(|path| Some(path.parent()?.to_owned()));
        let installed = ["/usr/local/lib/cloudroid", "/usr/lib/cloudroid"].map(PathBuf::from);
        let places: Vec<PathBuf> = beside.into_iter().chain(installed).collect();
        Self::below(&places)
    }

    fn below(places: &[PathBuf]) -> Programs {
        let find = |architecture: &'static str| {
            let of = |place: &PathBuf| place.join("stubs").join(architecture).join(PROGRAM);
            let path = places.iter().map(of).find(|path| path.is_file())?;
            Some(Program { architecture, path })
        };
        Programs {
            found: ARCHITECTURES.into_iter().filter_map(find).collect(),
        }
    }

    /// Architectures for which there is a program.
    pub fn held(&self) -> Vec<String> {
        self.found
            .iter()
            .map(|program| program.architecture.to_owned())
            .collect()
    }

    /// Architectures for which there is no program.
    pub fn lacking(&self) -> Vec<String> {
        let held = self.held();
        ARCHITECTURES
            .into_iter()
            .map(str::to_owned)
            .filter(|architecture| !held.contains(architecture))
            .collect()
    }

    /// The one for an architecture; none: this machine's.
    pub fn of(self, asked: Option<&str>) -> Result<Program, Error> {
        let asked = asked.unwrap_or(std::env::consts::ARCH);
        let exists = self.held();
        let wanted = architecture(asked);
        self.found
            .into_iter()
            .find(|program| Some(program.architecture) == wanted)
            .ok_or_else(|| Error::UnknownArchitecture {
                asked: asked.to_owned(),
                exists,
            })
    }
}

/// `HOST` or `HOST:PORT`, nothing that a file or script could misunderstand.
pub fn is_authority(text: &str) -> bool {
    !text.is_empty()
        && text
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "-._:[]".contains(c))
}

/// The files of a revision's stub, but for the robot's program.
pub fn files(
    store: &image::Store,
    revision: &RevisionRecord,
    inventory: &Inventory,
    architecture: &str,
    portal: &Portal,
) -> Result<Files, Error> {
    let no_stub = |error: package::Error| Error::NoStub {
        service: revision.service.clone(),
        reason: error.to_string(),
    };
    let layers = inventory::layers(store, &revision.image)?;
    let contents = match inventory.packages.get(&revision.package) {
        Some(package) => Contents::read(&layers, package).map_err(no_stub)?,
        None => Contents::default(),
    };
    let about = About {
        ros: revision.flavour.ros.bus(),
        service: &revision.service,
        package: &revision.package,
        revision: revision.number,
        image: &revision.image,
        portal,
        architecture,
        outsourced: &inventory.programs.keys().cloned().collect(),
        names: &names(revision, inventory),
        interface: &revision.interface,
        stateful: revision.plan.stateful,
        requests: &requests(revision, inventory),
        times: times(&revision.plan.sla),
    };
    compose(&about, contents).map_err(no_stub)
}

/// What nodes of ROS 2 are called by their programs, where each runs once, or once without being told a name; of a program of several nodes the first. A
/// robot's launch files seldom name its nodes, and parameters files go by what those are called. With the namespace where the program gives one (`/camera/detector`), and not where the push has:
/// a robot has its own. ROS 1's always name them.
fn names(revision: &RevisionRecord, inventory: &Inventory) -> BTreeMap<String, String> {
    let mut names = BTreeMap::new();
    if revision.flavour.ros.bus() == RosVersion::One {
        return names;
    }
    for (program, path) in &inventory.programs {
        let nodes = revision.plan.nodes.iter();
        let nodes: Vec<_> = nodes.filter(|node| node.argv.contains(path)).collect();
        if let Some(node) = arguments::named_by_program(nodes, |node| &node.argv) {
            let name = match node.name.rsplit_once('/') {
                Some(("", name)) => name,
                Some((_, name)) if arguments::gives_namespace(&node.argv) => name,
                _ => &node.name,
            };
            names.insert(program.clone(), name.to_owned());
        }
    }
    names
}

/// Which inputs are answered by which outputs, as programs call them: a robot remaps its nodes otherwise than the push
/// did. Those of a publication that says nothing of them are decided now.
fn requests(revision: &RevisionRecord, inventory: &Inventory) -> Vec<Answered> {
    let ros = revision.flavour.ros.bus();
    let mut answered: Vec<Answered> = Vec::new();
    for request in revision.interface.decided_requests(ros) {
        let node = revision
            .plan
            .nodes
            .iter()
            .find(|node| node.name == request.node);
        let program = node.and_then(|node| {
            let mut programs = inventory.programs.iter();
            programs.find(|(_, path)| node.argv.contains(path))
        });
        let remaps = node
            .map(|node| Remaps::of(ros, node.argv.get(1..).unwrap_or_default(), &node.name))
            .unwrap_or_default();
        let one = Answered {
            program: program.map(|(name, _)| name.clone()),
            request: request.pair.renamed(|name| remaps.undo(name).to_owned()),
            node: request.node,
        };
        if !answered.contains(&one) {
            answered.push(one);
        }
    }
    answered
}

/// T_desire and T_max in seconds; where one of them is given it is both.
fn times(sla: &api::Sla) -> Option<(f64, f64)> {
    let (desire, max) = (sla.rrt.or(sla.max_rrt)?, sla.max_rrt.or(sla.rrt)?);
    Some((desire.as_seconds(), max.as_seconds()))
}

/// A packed stub.
pub struct Archive {
    /// It, from its beginning; the file is gone when it is closed.
    pub file: File,
    /// Its signature, of [`api::stub::ARCHIVE`].
    pub signature: String,
}

/// The archive of a revision's stub.
pub fn archive(
    store: &image::Store,
    revision: &RevisionRecord,
    inventory: &Inventory,
    program: &Program,
    portal: &Portal,
    key: &SigningKey,
) -> Result<Archive, Error> {
    let mut files = files(store, revision, inventory, program.architecture, portal)?;
    let failed = |error: std::io::Error| Error::NoStub {
        service: revision.service.clone(),
        reason: format!("it could not be packed: {error}"),
    };
    let bytes = std::fs::read(&program.path).map_err(failed)?;
    let executable = true;
    files.insert(
        format!("lib/{}/{PROGRAM}", revision.package),
        Content::File { bytes, executable },
    );
    pack(&revision.service, files, key).map_err(failed)
}

fn pack(service: &str, mut files: Files, key: &SigningKey) -> std::io::Result<Archive> {
    sign_all(&mut files, key)?;
    let file = tempfile::tempfile()?;
    let gzip = GzBuilder::new()
        .mtime(0)
        .write(file, Compression::default());
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
    Ok(Archive {
        file,
        signature: key.sign(api::stub::ARCHIVE, &digest),
    })
}

/// Adds the key, the list of all files, and its signature.
fn sign_all(files: &mut Files, key: &SigningKey) -> std::io::Result<()> {
    let plain = |text: String| Content::File {
        bytes: text.into_bytes(),
        executable: false,
    };
    let signer = format!("{}\n", key.public().signer());
    files.insert(SIGNER.to_owned(), plain(signer));
    let list = manifest(files);
    let signature = key.sign(api::stub::CONTENTS, &sign::digest(&mut list.as_bytes())?);
    files.insert(MANIFEST.to_owned(), plain(list));
    files.insert(SIGNATURE.to_owned(), plain(signature));
    Ok(())
}

/// Every directory that these paths are in, each after its parent.
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

    fn packed(key: &SigningKey) -> (Vec<u8>, String) {
        let executable = true;
        let node = Content::File {
            bytes: b"#!/bin/sh".to_vec(),
            executable,
        };
        let files: Files = [
            ("lib/p/node".to_owned(), node),
            ("share/p/a/b".to_owned(), Content::Link("c".into())),
        ]
        .into();
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
            flavour: Flavour {
                ros: Version::Ros2,
                ..Flavour::default()
            },
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
        // What runs twice says nothing of its own name, unless one of them was told no other.
        let expected = [
            ("camera_node", "camera"),
            ("duet", "alto"),
            ("gripper", "/arm/gripper"),
        ];
        let expected = expected.map(|(program, node)| (program.to_owned(), node.to_owned()));
        assert_eq!(names(&revision, &inventory), expected.into());
        revision.flavour.ros = Version::Ros1;
        assert!(names(&revision, &inventory).is_empty());
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
                    argv: ["/opt/p/lib/p/find", "image:=/camera", "_rate:=2"]
                        .map(str::to_owned)
                        .into(),
                    environment: BTreeMap::new(),
                    directory: String::new(),
                    respawn: false,
                    respawn_delay: 0.0,
                    required: false,
                }],
                ..Plan::default()
            },
            // Of an earlier release: nothing is decided in it.
            interface: Interface {
                topics: vec![
                    topic("/camera", Direction::Input),
                    topic("/left/finder/found", Direction::Output),
                ],
                definitions: [definition].into(),
                ..Interface::default()
            },
        };
        let inventory = Inventory {
            programs: [("find".to_owned(), "/opt/p/lib/p/find".to_owned())].into(),
            ..Inventory::default()
        };
        let expected = Answered {
            node: "/left/finder".into(),
            program: Some("find".into()),
            request: "/left/image -> /left/finder/found by arrival"
                .parse()
                .expect("a pair"),
        };
        assert_eq!(requests(&revision, &inventory), [expected]);
    }

    #[test]
    fn the_same_files_make_the_same_archive_and_each_has_its_mode() {
        let (key, _) = SigningKey::generate().expect("made");
        let (bytes, signature) = packed(&key);
        assert_eq!((bytes.clone(), signature), packed(&key));
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
        let (mut bytes, signature) = packed(&key);
        let verify = |bytes: &[u8]| {
            let digest = sign::digest(&mut &*bytes).expect("read");
            key.public().verify(api::stub::ARCHIVE, &digest, &signature)
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
        let look = || Programs::below(&[place.path().to_owned()]);
        assert_eq!(look().held(), ["aarch64"]);
        assert_eq!(look().lacking(), ["x86_64", "armv7"]);
        assert_eq!(
            look()
                .of(Some("arm64"))
                .ok()
                .map(|program| program.architecture),
            Some("aarch64")
        );
        let refused = look().of(Some("riscv64")).err();
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
