use std::os::unix::fs::PermissionsExt;

use super::*;
use crate::{Refusal, TreeOptions};

struct ReceiveFixture {
    root: tempfile::TempDir,
    image: Image,
    store: Store,
}

fn store(root: &Path, name: &str) -> Store {
    let place = root.join(name);
    Store::open(&place.join("images"), &place.join("layers")).expect("a store")
}

/// Creates a store with an image of two layers.
fn new_fixture() -> ReceiveFixture {
    let root = tempfile::tempdir().expect("a directory");
    let store = store(root.path(), "one");
    let mut layers = Vec::new();
    for name in ["lower", "upper"] {
        let tree = root.path().join(name);
        std::fs::create_dir_all(tree.join("opt")).expect("made");
        std::fs::write(tree.join("opt").join(name), name).expect("written");
        let layer = store.layer_from_tree(&tree, &TreeOptions::default());
        layers.push(layer.expect("a layer"));
    }
    let spec = ImageSpec {
        layers,
        env: BTreeMap::from([("ROS_DISTRO".to_owned(), "noetic".to_owned())]),
        labels: BTreeMap::from([("a".to_owned(), "b".to_owned())]),
        ..ImageSpec::default()
    };
    let digest = store.put_image(&spec).expect("an image");
    store.tag("one:1", &digest).expect("a tag");
    let image = store.image(&digest).expect("it is there");
    ReceiveFixture { root, image, store }
}

impl ReceiveFixture {
    fn layout(&self) -> Tree {
        Tree::open(self.store.images_dir()).expect("a layout")
    }

    /// Receives the layout into an empty store, which fails.
    fn receive_refusal(&self, limits: &Limits) -> Error {
        let empty = tempfile::tempdir_in(self.root.path()).expect("a directory");
        let other = store(empty.path(), "other");
        let refused = other.receive(&self.layout(), limits);
        refused.expect_err("it is refused")
    }

    /// Returns the path of the blob of the upper layer.
    fn upper(&self) -> PathBuf {
        let digest = self.image.spec.layers[1].digest;
        self.store.images_dir().join(blob_path(&digest))
    }
}

#[test]
fn an_image_of_another_store_is_the_same_here() {
    let place = new_fixture();
    let other = store(place.root.path(), "other");
    assert!(is_layout(&place.layout()));
    let received = other.receive(&place.layout(), &Limits::default()).expect("good");
    assert_eq!(received.image.digest, place.image.digest);
    assert_eq!(received.image.spec, place.image.spec);
    assert_eq!(received.known, [false, false]);
    assert_eq!(received.annotations[oci::REF_NAME], "one:1");
    for layer in &received.image.spec.layers {
        let tree = other.ensure_extracted(&layer.diff_id).expect("extracted");
        assert!(tree.join("opt").is_dir());
    }
    let again = other.receive(&place.layout(), &Limits::default()).expect("good");
    assert_eq!(again.known, [true, true]);
    // A layer in the store may not be used by those who do not send it.
    std::fs::remove_file(place.upper()).expect("removed");
    let refused = other.receive(&place.layout(), &Limits::default());
    let refused = refused.expect_err("it is not sent").to_string();
    assert!(refused.contains("is missing"), "{refused}");
    std::fs::write(place.upper(), "another").expect("written");
    let refused = other.receive(&place.layout(), &Limits::default());
    let refused = refused.expect_err("another is sent").to_string();
    assert!(refused.contains("has the content of"), "{refused}");
}

#[test]
fn a_layout_that_is_not_what_it_says_is_refused_with_the_reason() {
    let place = new_fixture();
    let blob = std::fs::read(place.upper()).expect("read");
    let lower = place.image.spec.layers[0].digest;
    let lower = place.store.images_dir().join(blob_path(&lower));
    let set = |content: &[u8]| {
        std::fs::remove_file(place.upper()).expect("removed");
        std::fs::write(place.upper(), content).expect("written");
    };
    set(&std::fs::read(lower).expect("read"));
    let refused = place.receive_refusal(&Limits::default()).to_string();
    assert!(refused.contains("has the content of"), "{refused}");
    set(&blob[..blob.len() / 2]);
    let refused = place.receive_refusal(&Limits::default());
    assert!(matches!(refused, Error::Archive { .. }), "{refused}");
    std::fs::remove_file(place.upper()).expect("removed");
    let refused = place.receive_refusal(&Limits::default()).to_string();
    assert!(refused.contains("is missing"), "{refused}");
    // A link is not accepted as a blob, wherever it points.
    std::os::unix::fs::symlink("/etc/passwd", place.upper()).expect("linked");
    let refused = place.receive_refusal(&Limits::default());
    assert!(matches!(refused, Error::Unreceivable { .. }), "{refused}");
    let index = place.store.images_dir().join("index.json");
    std::fs::write(index, r#"{"schemaVersion": 2, "manifests": []}"#).expect("written");
    let refused = place.receive_refusal(&Limits::default()).to_string();
    assert!(refused.contains("contains 0 images"), "{refused}");
}

#[test]
fn layers_hold_no_more_than_is_allowed() {
    let place = new_fixture();
    let of = |limits: Limits| match place.receive_refusal(&limits) {
        Error::Archive { problem, .. } => problem,
        other => panic!("{other}"),
    };
    let few = Limits { entries: 3, ..Limits::default() };
    assert!(matches!(of(few), Refusal::TooManyEntries { .. }));
    let small = Limits { bytes: 4096, ..Limits::default() };
    assert!(matches!(of(small), Refusal::TooLarge { .. }));
}

#[test]
fn extended_headers_of_layers_are_bounded_too() {
    use crate::tar_reader::tests::{archive, extension};
    let place = new_fixture();
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    io::Write::write_all(&mut gzip, &archive(&vec![extension(10_000); 9])).expect("packed");
    std::fs::remove_file(place.upper()).expect("removed");
    std::fs::write(place.upper(), gzip.finish().expect("packed")).expect("written");
    let refused = place.receive_refusal(&Limits::default()).to_string();
    assert!(refused.contains("extended headers"), "{refused}");
}

/// Threads of the engine have untrusted data parsed by unprivileged threads: these can access what they need, and
/// written files have the right owner.
#[test]
fn an_image_is_taken_in_by_a_daemon_whose_readers_have_no_rights() {
    let place = new_fixture();
    // Only root has access there.
    let closed = std::fs::Permissions::from_mode(0o700);
    std::fs::set_permissions(place.root.path(), closed).expect("set");
    let other = store(place.root.path(), "other");
    let (layout, expected) = (place.layout(), place.image.digest);
    let received = crate::run_as_engine(move || other.receive(&layout, &Limits::default()));
    assert_eq!(received.expect("good").image.digest, expected);
}

#[test]
fn the_same_layer_twice_is_refused() {
    let root = tempfile::tempdir().expect("a directory");
    let store = store(root.path(), "one");
    let tree = root.path().join("tree");
    std::fs::create_dir_all(tree.join("opt")).expect("made");
    let layer = store.layer_from_tree(&tree, &TreeOptions::default());
    let layer = layer.expect("a layer");
    let twice = ImageSpec { layers: vec![layer, layer], ..ImageSpec::default() };
    let digest = store.put_image(&twice).expect("an image");
    let image = store.image(&digest).expect("it is there");
    let place = ReceiveFixture { root, image, store };
    let refused = place.receive_refusal(&Limits::default()).to_string();
    assert!(refused.contains("same layer twice"), "{refused}");
}

#[test]
fn what_is_refused_leaves_no_layer() {
    let place = new_fixture();
    let [lower, upper] = place.image.spec.layers[..] else { panic!("two layers") };
    let of = |layer: &LayerInfo| place.store.images_dir().join(blob_path(&layer.digest));
    std::fs::copy(of(&lower), of(&upper)).expect("another content under its name");
    let other = store(place.root.path(), "other");
    let refused = other.receive(&place.layout(), &Limits::default());
    refused.expect_err("a layer is another");
    assert!(!other.images_dir().join(blob_path(&upper.digest)).exists());
}

#[test]
fn a_layer_in_another_blob_changes_no_image_of_this_store() {
    let place = new_fixture();
    let lower = place.image.spec.layers[0];
    let path = place.store.images_dir().join(blob_path(&lower.digest));
    let mut content = Vec::new();
    let archive = std::fs::read(path).expect("a blob");
    io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&archive[..]), &mut content).expect("a gzip file");
    let again = place.root.path().join("again.tar.gz");
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::none());
    io::Write::write_all(&mut packed, &content).expect("packed");
    std::fs::write(&again, packed.finish().expect("packed")).expect("written");
    let other = place.store.import_layer(&again).expect("a layer");
    assert_eq!(other.diff_id, lower.diff_id);
    assert_ne!(other.digest, lower.digest);
    let known = place.store.layer(&lower.diff_id).expect("it is read");
    assert_eq!(known, Some(lower));
}
