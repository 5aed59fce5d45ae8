use std::os::unix::fs::{FileTypeExt, MetadataExt, symlink};

use serde_json::json;
use tar::EntryType;

use super::*;
use crate::Refusal;
use crate::oci;

const DOCKER_MANIFEST: &str = "application/vnd.docker.distribution.manifest.v2+json";
const DOCKER_LAYER: &str = "application/vnd.docker.image.rootfs.diff.tar";

/// A directory with stores and unpacked archives.
struct SavedFixture {
    place: tempfile::TempDir,
}

fn new_fixture() -> SavedFixture {
    SavedFixture { place: tempfile::tempdir().expect("a directory") }
}

/// An entry of a layer: its kind, name, mode, and content or the target of a link.
type Member<'a> = (EntryType, &'a str, u32, &'a str);

/// Returns the tar stream of a layer.
fn make_layer(members: &[Member<'_>]) -> Vec<u8> {
    let mut archive = tar::Builder::new(Vec::new());
    for (kind, name, mode, text) in members {
        let mut header = tar::Header::new_gnu();
        header.set_entry_type(*kind);
        header.set_mode(*mode);
        header.set_uid(0);
        header.set_gid(0);
        header.set_mtime(0);
        if matches!(kind, EntryType::Symlink | EntryType::Link) {
            header.set_size(0);
            archive.append_link(&mut header, name, text).expect("into memory");
        } else {
            if *kind == EntryType::Char {
                header.set_device_major(1).and_then(|()| header.set_device_minor(3)).expect("a device");
            }
            header.set_size(text.len() as u64);
            archive.append_data(&mut header, name, text.as_bytes()).expect("into memory");
        }
    }
    archive.into_inner().expect("into memory")
}

fn compress(bytes: &[u8]) -> Vec<u8> {
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut packed, bytes).expect("packed");
    packed.finish().expect("packed")
}

fn make_config(architecture: &str, layers: &[Vec<u8>]) -> serde_json::Value {
    let diff_ids: Vec<String> = layers.iter().map(|layer| Digest::compute(layer).to_string()).collect();
    json!({
        "architecture": architecture,
        "os": "linux",
        // As docker writes it: null for what is absent.
        "config": {"Env": ["PATH=/usr/bin", "ROS_DISTRO=jazzy"], "Cmd": null, "Labels": null},
        "rootfs": {"type": "layers", "diff_ids": diff_ids},
    })
}

fn architecture() -> &'static str {
    oci::platform().0
}

impl SavedFixture {
    fn store(&self, name: &str) -> Store {
        let place = self.place.path().join(name);
        Store::open(&place.join("images"), &place.join("layers")).expect("a store")
    }

    fn write(&self, name: &str, path: &str, bytes: &[u8]) {
        let path = self.place.path().join(name).join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, bytes).expect("written");
    }

    fn write_blob(&self, name: &str, bytes: &[u8]) -> serde_json::Value {
        let digest = Digest::compute(bytes);
        self.write(name, &blob_name(&digest), bytes);
        json!({"digest": digest.to_string(), "size": bytes.len()})
    }

    /// Writes a manifest with its parts; returns its entry in an index.
    fn write_manifest(&self, name: &str, architecture: &str, layers: &[(&str, Vec<u8>, Vec<u8>)]) -> serde_json::Value {
        let contents: Vec<Vec<u8>> = layers.iter().map(|(_, content, _)| content.clone()).collect();
        let config = self.write_blob(name, make_config(architecture, &contents).to_string().as_bytes());
        let layers: Vec<serde_json::Value> = layers
            .iter()
            .map(|(media, _, blob)| {
                let mut entry = self.write_blob(name, blob);
                entry["mediaType"] = json!(media);
                entry
            })
            .collect();
        let manifest = json!({"schemaVersion": 2, "config": config, "layers": layers});
        let mut entry = self.write_blob(name, manifest.to_string().as_bytes());
        entry["mediaType"] = json!(oci::MEDIA_MANIFEST);
        entry["platform"] = json!({"architecture": architecture, "os": "linux"});
        entry
    }

    fn write_layout(&self, name: &str, manifests: &[serde_json::Value]) {
        self.write(name, "oci-layout", br#"{"imageLayoutVersion": "1.0.0"}"#);
        let index = json!({"schemaVersion": 2, "manifests": manifests});
        self.write(name, "index.json", index.to_string().as_bytes());
    }

    fn receive(&self, name: &str) -> Result<SavedImage, Error> {
        self.receive_within(name, &Limits::default())
    }

    fn receive_within(&self, name: &str, limits: &Limits) -> Result<SavedImage, Error> {
        let archive = Tree::open(&self.place.path().join(name)).expect("an archive");
        self.store(&format!("store-{name}")).receive_saved(&archive, limits)
    }

    fn expect_refusal(&self, name: &str) -> String {
        self.receive(name).expect_err(name).to_string()
    }
}

fn blob_name(digest: &Digest) -> String {
    format!("blobs/sha256/{}", digest.hex())
}

#[test]
fn layers_of_a_layout_are_kept_whatever_they_are_compressed_with() {
    let place = new_fixture();
    let layers = ["plain", "gzip", "zstd"].map(|name| make_layer(&[(EntryType::Regular, name, 0o644, name)]));
    let packed_zstd = zstd::stream::encode_all(&layers[2][..], 1).expect("packed");
    let entry = place.write_manifest(
        "saved",
        architecture(),
        &[
            ("application/vnd.oci.image.layer.v1.tar", layers[0].clone(), layers[0].clone()),
            (oci::MEDIA_LAYER_GZIP, layers[1].clone(), compress(&layers[1])),
            ("application/vnd.oci.image.layer.v1.tar+zstd", layers[2].clone(), packed_zstd),
        ],
    );
    place.write_layout("saved", &[entry]);
    let image = place.receive("saved").expect("good");
    assert_eq!(image.env["ROS_DISTRO"], "jazzy");
    let expected: Vec<Digest> = layers.iter().map(Digest::compute).collect();
    let diff_ids: Vec<Digest> = image.layers.iter().map(|layer| layer.diff_id).collect();
    assert_eq!(diff_ids, expected);
    // That of gzip stays as it was sent.
    assert_eq!(image.layers[1].digest, Digest::compute(compress(&layers[1])));
    let store = place.store("store-saved");
    for (layer, name) in diff_ids.iter().zip(["plain", "gzip", "zstd"]) {
        let tree = store.ensure_extracted(layer).expect("extracted");
        assert_eq!(std::fs::read_to_string(tree.join(name)).expect("there"), name);
    }
    assert!(store.verify().expect("read").is_empty());
    assert_eq!(place.receive("saved").expect("again").layers, image.layers);
}

#[test]
fn of_several_architectures_that_of_this_machine_is_taken() {
    let place = new_fixture();
    let layer = make_layer(&[(EntryType::Regular, "f", 0o644, "own")]);
    let other = make_layer(&[(EntryType::Regular, "f", 0o644, "other")]);
    let plain = |layer: &Vec<u8>| [(DOCKER_LAYER, layer.clone(), layer.clone())];
    let mut own = place.write_manifest("many", architecture(), &plain(&layer));
    own["mediaType"] = json!(DOCKER_MANIFEST);
    let foreign = place.write_manifest("many", "riscv64", &plain(&other));
    let mut record = own.clone();
    record["platform"] = json!({"architecture": "unknown", "os": "unknown"});
    record["annotations"] = json!({"vnd.docker.reference.type": "attestation-manifest"});
    let inner = json!({"schemaVersion": 2, "manifests": [foreign, own, record]});
    let mut index = place.write_blob("many", inner.to_string().as_bytes());
    index["mediaType"] = json!(oci::MEDIA_INDEX);
    index["annotations"] = json!({"io.containerd.image.name": "docker.io/library/ros:jazzy"});
    place.write_layout("many", &[index]);
    let image = place.receive("many").expect("good");
    assert_eq!(image.layers[0].diff_id, Digest::compute(&layer));
    assert_eq!(image.name, "docker.io/library/ros:jazzy");

    let foreign = [
        place.write_manifest("others", "riscv64", &plain(&other)),
        place.write_manifest("others", "s390x", &plain(&other)),
    ];
    place.write_layout("others", &foreign);
    let refused = place.expect_refusal("others");
    assert!(refused.contains("it is for riscv64, s390x, but this machine is"), "{refused}");

    let mut two = [
        place.write_manifest("two", architecture(), &plain(&layer)),
        place.write_manifest("two", architecture(), &plain(&other)),
    ];
    two[0]["annotations"] = json!({"org.opencontainers.image.ref.name": "ros:jazzy"});
    place.write_layout("two", &two);
    let refused = place.expect_refusal("two");
    assert!(refused.contains("several images (one without a name, ros:jazzy); save one"), "{refused}");
    place.write_layout("none", &[]);
    assert!(place.expect_refusal("none").contains("it contains no image"));
}

#[test]
fn lists_that_name_a_list_many_times_are_not_read_as_often() {
    let place = new_fixture();
    let mut entry = place.write_blob("lists", br#"{"schemaVersion": 2, "manifests": []}"#);
    for _ in 0..2 {
        entry["mediaType"] = json!(oci::MEDIA_INDEX);
        let index = json!({"schemaVersion": 2, "manifests": vec![entry.clone(); 1000]});
        entry = place.write_blob("lists", index.to_string().as_bytes());
    }
    entry["mediaType"] = json!(oci::MEDIA_INDEX);
    place.write_layout("lists", &vec![entry; 1000]);
    let refused = place.expect_refusal("lists");
    assert!(refused.contains("more than 100 lists"), "{refused}");
}

#[test]
fn an_archive_of_docker_is_read_with_its_links() {
    let place = new_fixture();
    let lower = make_layer(&[(EntryType::Regular, "etc/a", 0o644, "lower")]);
    let upper = make_layer(&[(EntryType::Regular, "etc/b", 0o644, "upper")]);
    let all = [lower.clone(), upper.clone(), lower.clone()];
    place.write("docker", "one/layer.tar", &lower);
    place.write("docker", "two/layer.tar", &upper);
    // Of equal layers docker packs one, and links to it.
    std::fs::create_dir(place.place.path().join("docker/three")).expect("made");
    symlink("../one/layer.tar", place.place.path().join("docker/three/layer.tar")).expect("linked");
    place.write("docker", "config.json", make_config(architecture(), &all).to_string().as_bytes());
    let image = json!({
        "Config": "config.json",
        "RepoTags": ["ros:jazzy"],
        "Layers": ["one/layer.tar", "two/layer.tar", "three/layer.tar"],
    });
    place.write("docker", "manifest.json", json!([image]).to_string().as_bytes());
    let received = place.receive("docker").expect("good");
    assert_eq!(received.name, "ros:jazzy");
    // The uppermost of equal ones.
    let diff_ids: Vec<Digest> = received.layers.iter().map(|layer| layer.diff_id).collect();
    assert_eq!(diff_ids, [Digest::compute(&upper), Digest::compute(&lower)]);
    place.write("docker", "manifest.json", json!([image, image]).to_string().as_bytes());
    assert!(place.expect_refusal("docker").contains("several images (ros:jazzy, ros:jazzy)"));
}

#[test]
fn what_an_archive_cannot_be_is_refused_with_the_reason() {
    let place = new_fixture();
    let layer = make_layer(&[(EntryType::Regular, "f", 0o644, "x")]);
    let config = make_config(architecture(), std::slice::from_ref(&layer)).to_string();
    place.write("outside", "config.json", config.as_bytes());
    std::fs::write(place.place.path().join("secret"), &layer).expect("written");
    let with = |config: &str, layers: &[&str]| {
        let image = json!([{"Config": config, "RepoTags": null, "Layers": layers}]);
        place.write("outside", "manifest.json", image.to_string().as_bytes());
        place.expect_refusal("outside")
    };
    for path in ["../secret", "/etc/passwd", "link"] {
        let link = place.place.path().join("outside/link");
        if !link.is_symlink() {
            symlink("../secret", link).expect("linked");
        }
        let refused = with("config.json", &[path]);
        assert!(refused.contains("cannot import the image"), "{path}: {refused}");
        assert!(with(path, &["f"]).contains("cannot import the image"), "{path}");
    }
    let refused = with("config.json", &["gone.tar"]);
    assert!(refused.contains("gone.tar is missing"), "{refused}");
    let refused = with("config.json", &[]);
    assert!(refused.contains("0 layers and 1 diff-ids"), "{refused}");
    place.write("outside", "other.tar", &make_layer(&[(EntryType::Regular, "f", 0o644, "y")]));
    let refused = with("config.json", &["other.tar"]);
    assert!(refused.contains("has the content of"), "{refused}");
    place.write("outside", "cut.tar", &layer[..600]);
    let refused = with("config.json", &["cut.tar"]);
    assert!(refused.contains("truncated"), "{refused}");
    std::fs::create_dir(place.place.path().join("empty")).expect("made");
    assert!(place.expect_refusal("empty").contains("neither oci-layout"));
    // Nothing of it stays.
    let left = std::fs::read_dir(place.place.path().join("store-outside/images/blobs/sha256")).expect("listed");
    assert_eq!(left.count(), 0);
}

#[test]
fn layers_hold_no_more_than_is_allowed_in_all() {
    let place = new_fixture();
    let layer = |name: &str| make_layer(&[(EntryType::Regular, name, 0o644, &"x".repeat(100_000))]);
    let (one, two) = (layer("one"), layer("two"));
    let packed = zstd::stream::encode_all(&two[..], 1).expect("packed");
    let entry = place.write_manifest("big", architecture(), &[("x", one.clone(), compress(&one)), ("x", two, packed)]);
    place.write_layout("big", &[entry]);
    for (limits, is_size) in
        [(Limits { bytes: 150_000, ..Limits::default() }, true), (Limits { entries: 1, ..Limits::default() }, false)]
    {
        match place.receive_within("big", &limits) {
            Err(Error::Archive { problem: Refusal::TooLarge { .. }, .. }) => assert!(is_size),
            Err(Error::Archive { problem: Refusal::TooManyEntries { .. }, .. }) => assert!(!is_size),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_root_file_system_is_taken_with_all_that_one_has_but_devices() {
    let place = new_fixture();
    let tar = make_layer(&[
        (EntryType::Directory, "./", 0o755, ""),
        (EntryType::Directory, "./usr/", 0o755, ""),
        (EntryType::Regular, "./usr/bin/tool", 0o4755, "#!/bin/sh\n"),
        (EntryType::Link, "./usr/bin/same", 0o755, "./usr/bin/tool"),
        (EntryType::Symlink, "./bin", 0o777, "/usr/bin"),
        (EntryType::Directory, "./etc/", 0o755, ""),
        (EntryType::Symlink, "./escape", 0o777, "/etc"),
        (EntryType::Regular, "./escape/passwd", 0o644, "mine"),
        (EntryType::Char, "./dev/null", 0o666, ""),
        (EntryType::Fifo, "./run/pipe", 0o600, ""),
        (EntryType::Regular, "./etc/.wh.gone", 0o644, ""),
    ]);
    let store = place.store("store");
    for (name, bytes) in [
        ("plain.tar", tar.clone()),
        ("root.tar.gz", compress(&tar)),
        ("root.tar.zst", zstd::stream::encode_all(&tar[..], 1).expect("packed")),
    ] {
        place.write("given", name, &bytes);
        let file = File::open(place.place.path().join("given").join(name)).expect("there");
        let layer = store.receive_root(file, &Limits::default()).expect("good");
        assert_eq!(layer.diff_id, Digest::compute(&tar), "{name}");
    }
    let tree = store.ensure_extracted(&Digest::compute(&tar)).expect("extracted");
    let about = |path: &str| tree.join(path).symlink_metadata().expect(path);
    assert_eq!(about("usr/bin/tool").mode() & 0o7777, 0o4755);
    assert_eq!(about("usr/bin/tool").ino(), about("usr/bin/same").ino());
    assert_eq!(std::fs::read_link(tree.join("bin")).expect("a link"), Path::new("/usr/bin"));
    assert!(about("run/pipe").file_type().is_fifo());
    assert!(tree.join("dev").is_dir() && tree.join("dev/null").symlink_metadata().is_err());
    // Nothing is written through a link, which stays inside the tree.
    assert!(std::fs::read_to_string("/etc/passwd").expect("the host's") != "mine");
    let mut up = make_layer(&[(EntryType::Regular, "a", 0o644, "")]);
    up[..7].copy_from_slice(b"../../x");
    // The checksum of the changed header.
    up[148..156].copy_from_slice(b"        ");
    let sum: u32 = up[..512].iter().map(|&byte| u32::from(byte)).sum();
    up[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
    place.write("given", "up.tar", &up);
    let file = File::open(place.place.path().join("given/up.tar")).expect("there");
    let taken = store.receive_root(file, &Limits::default()).and_then(|layer| store.ensure_extracted(&layer.diff_id));
    let refused = taken.expect_err("it goes up").to_string();
    assert!(refused.contains("goes up with '..'"), "{refused}");
}
