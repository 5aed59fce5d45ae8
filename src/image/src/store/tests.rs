//! Tests of the public interface of the store, with real trees and archives.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt, symlink};

use rustix::fs::{AtFlags, FileType, Mode, XattrFlags};

use super::*;
use crate::entry::{Entry, Kind};
use crate::layer::gunzip_and_hash;
use crate::tar_reader::TarReader;
use crate::tar_writer::TarWriter;
use crate::{ImageSpec, LayerInfo, Mtime, TreeOptions};

struct StoreFixture {
    directory: tempfile::TempDir,
    store: Store,
}

impl StoreFixture {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path());
        Self { directory, store }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Adds a layer of arbitrary entries to the store without extracting it.
    fn layer(&self, entries: &[(Entry, &str)]) -> LayerInfo {
        let mut writer = TarWriter::new(Vec::new());
        for (entry, content) in entries {
            let entry = Entry { size: content.len() as u64, ..entry.clone() };
            writer.write_file(&entry, content.as_bytes(), &mut [0; 64]).unwrap();
        }
        let path = self.path("imported.tar.gz");
        let mut encoder = flate2::write::GzEncoder::new(File::create(&path).unwrap(), flate2::Compression::fast());
        encoder.write_all(&writer.finish().unwrap()).unwrap();
        encoder.finish().unwrap();
        let file = File::open(&path).unwrap();
        self.store.copy_layer(file, &path, |copy| Ok(gunzip_and_hash(copy).unwrap()), |_| Ok(())).unwrap()
    }

    /// Returns the names of files in the store that do not belong there.
    fn leftovers(&self) -> Vec<String> {
        let both = [self.store.images_dir(), self.store.layers_dir()];
        let names = both.into_iter().flat_map(|directory| files::list(directory).unwrap());
        let names = names.map(|entry| entry.file_name().into_string().unwrap());
        names.filter(|name| name.starts_with(files::HALF_MADE)).collect()
    }
}

fn open(home: &Path) -> Store {
    Store::open(&home.join("images"), &home.join("layers")).unwrap()
}

fn write(path: &Path, content: &str) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, content).unwrap();
}

fn is_root() -> bool {
    rustix::process::geteuid().is_root()
}

fn file(name: &str) -> Entry {
    Entry::new(name, Kind::File, 0o644)
}

fn link(name: &str, kind: Kind, target: &str) -> Entry {
    Entry { link: target.into(), ..Entry::new(name, kind, 0o777) }
}

/// Returns names, kinds and links in a layer's blob.
fn entries(store: &Store, layer: &LayerInfo) -> Vec<Entry> {
    let blob = store.blob(&layer.digest).unwrap().unwrap();
    assert_eq!(blob.size, layer.size);
    let mut reader = TarReader::new(crate::gzip::decoder(blob.file).unwrap());
    let mut entries = Vec::new();
    while let Ok(Some(entry)) = reader.next_entry() {
        entries.push(entry);
    }
    entries
}

fn names(entries: &[Entry]) -> Vec<&str> {
    entries.iter().map(|entry| std::str::from_utf8(&entry.name).unwrap()).collect()
}

/// Writes a tree with files of all kinds, created in the order of `seed`.
fn write_sample_tree(tree: &Path, seed: usize) {
    let mut steps: Vec<Box<dyn Fn()>> = Vec::new();
    for name in ["usr/bin/b", "usr/bin/a", "usr/lib/python3/x.py", "etc/passwd", "z"] {
        let path = tree.join(name);
        steps.push(Box::new(move || write(&path, &format!("content of {}", path.file_name().unwrap().display()))));
    }
    let long = tree.join("d".repeat(120)).join("n".repeat(200));
    steps.push(Box::new(move || write(&long, "long")));
    let count = steps.len();
    for step in 0..count {
        steps[(step + seed) % count]();
    }
    symlink("../usr/bin/a", tree.join("etc/link")).unwrap();
    symlink("/nowhere/at/all", tree.join("dangling")).unwrap();
    let (first, second) = (tree.join("usr/bin/a"), tree.join("etc/same"));
    std::fs::hard_link(&first, &second).unwrap();
    std::fs::set_permissions(&first, std::fs::Permissions::from_mode(0o4755)).unwrap();
    let _ = std::os::unix::net::UnixListener::bind(tree.join("socket")).unwrap();
}

#[test]
fn the_same_tree_gives_the_same_layer() {
    let world = StoreFixture::new();
    let layers: Vec<LayerInfo> = (0..3)
        .map(|seed| {
            let tree = world.path(&format!("tree{seed}"));
            std::fs::create_dir(&tree).unwrap();
            write_sample_tree(&tree, seed);
            world.store.layer_from_tree(&tree, &TreeOptions::default()).unwrap()
        })
        .collect();
    assert_eq!(layers[0], layers[1]);
    assert_eq!(layers[0], layers[2]);
    let found = entries(&world.store, &layers[0]);
    let mut sorted = names(&found);
    sorted.sort_by_key(|name| name.replace('/', "\0"));
    assert_eq!(names(&found), sorted);
    assert!(found.iter().all(|entry| entry.mtime == 0));
    assert!(!names(&found).contains(&"socket"));
    // The first path in order is the file, whichever was created first.
    let same = found.iter().find(|entry| entry.name == b"usr/bin/a").unwrap();
    assert_eq!((same.kind, &same.link[..]), (Kind::Hardlink, &b"etc/same"[..]));
    assert!(world.leftovers().is_empty());
}

#[test]
fn a_layer_comes_back_as_the_tree_it_was() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    write_sample_tree(&tree, 1);
    let options = TreeOptions { mtime: Mtime::Fixed(1_700_000_000), ..TreeOptions::default() };
    let layer = world.store.layer_from_tree(&tree, &options).unwrap();
    let extracted = world.store.ensure_extracted(&layer.diff_id).unwrap();
    assert_eq!(extracted, world.store.layers_dir().join(layer.diff_id.hex()));
    let a = extracted.join("usr/bin/a").metadata().unwrap();
    assert_eq!((a.permissions().mode() & 0o7777, a.nlink(), a.mtime()), (0o4755, 2, 1_700_000_000));
    assert_eq!(extracted.join("usr").metadata().unwrap().mtime(), 1_700_000_000);
    assert_eq!(std::fs::read_link(extracted.join("dangling")).unwrap(), Path::new("/nowhere/at/all"));
    let long = extracted.join("d".repeat(120)).join("n".repeat(200));
    assert_eq!(std::fs::read_to_string(long).unwrap(), "long");
    // Packed again, it gives the same layer.
    assert_eq!(world.store.layer_from_tree(&extracted, &options).unwrap(), layer);
}

#[test]
fn what_is_excluded_is_not_in_the_layer() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    for name in ["var/log/dpkg.log", "var/cache/apt/x", "usr/a.pyc", "usr/a.py", "tmp/x"] {
        write(&tree.join(name), "x");
    }
    let exclude = ["var/log/*", "/var/cache/apt", "*.pyc", "/tmp/**"].map(str::to_owned).to_vec();
    let layer = world.store.layer_from_tree(&tree, &TreeOptions { exclude, ..TreeOptions::default() }).unwrap();
    let found = entries(&world.store, &layer);
    assert_eq!(names(&found), ["tmp/", "usr/", "usr/a.py", "var/", "var/cache/", "var/log/"]);
}

#[test]
fn times_can_be_kept_up_to_a_date() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    write(&tree.join("old"), "x");
    write(&tree.join("new"), "x");
    let old = std::time::UNIX_EPOCH + std::time::Duration::from_secs(1_000_000);
    File::options().write(true).open(tree.join("old")).unwrap().set_modified(old).unwrap();
    let options = TreeOptions { mtime: Mtime::Clamp(2_000_000), ..TreeOptions::default() };
    let layer = world.store.layer_from_tree(&tree, &options).unwrap();
    let times: Vec<u64> = entries(&world.store, &layer).iter().map(|entry| entry.mtime).collect();
    assert_eq!(times, [2_000_000, 1_000_000]);
}

/// Writes the upper directory of an overlay: `gone` deleted, `fresh` emptied, `new` created.
fn upper(tree: &Path) {
    write(&tree.join("new"), "x");
    write(&tree.join("fresh/inside"), "x");
    let here = File::open(tree).unwrap();
    rustix::fs::mknodat(&here, "gone", FileType::CharacterDevice, Mode::empty(), 0).unwrap();
    let opaque = if is_root() { "trusted.overlay.opaque" } else { "user.overlay.opaque" };
    rustix::fs::setxattr(tree.join("fresh"), opaque, b"y", XattrFlags::empty()).unwrap();
    rustix::fs::setxattr(tree.join("new"), "user.kept", b"v", XattrFlags::empty()).unwrap();
}

#[test]
fn deletions_in_an_overlay_become_whiteouts_and_back() {
    let world = StoreFixture::new();
    let tree = world.path("upper");
    std::fs::create_dir(&tree).unwrap();
    upper(&tree);
    let options = TreeOptions { overlay_upper: true, ..TreeOptions::default() };
    let layer = world.store.layer_from_tree(&tree, &options).unwrap();
    let found = entries(&world.store, &layer);
    assert_eq!(names(&found), [".wh.gone", "fresh/", "fresh/.wh..wh..opq", "fresh/inside", "new"]);
    assert_eq!(found[4].xattrs, [(b"user.kept".to_vec(), b"v".to_vec())]);
    assert!(found[1].xattrs.is_empty());

    let extracted = world.store.ensure_extracted(&layer.diff_id).unwrap();
    let gone = std::fs::symlink_metadata(extracted.join("gone")).unwrap();
    assert!(gone.file_type().is_char_device() && gone.rdev() == 0);
    assert_eq!(world.store.layer_from_tree(&extracted, &options).unwrap(), layer);
}

#[test]
fn a_staged_tree_is_the_one_that_is_extracted() {
    let world = StoreFixture::new();
    let tree = world.path("upper");
    std::fs::create_dir(&tree).unwrap();
    upper(&tree);
    write(&tree.join("left/out"), "x");
    let options = TreeOptions { overlay_upper: true, exclude: vec!["left".into()], ..TreeOptions::default() };
    let (diff_id, bytes) = world.store.stage_tree(&tree, &options).unwrap();
    // It can be used before its blob exists.
    let staged = world.store.ensure_extracted(&diff_id).unwrap();
    assert!(staged.join("fresh/inside").exists() && !staged.join("left").exists());
    assert_eq!(world.store.layer(&diff_id).unwrap(), None);
    assert!(
        world
            .store
            .put_image(&ImageSpec {
                layers: vec![LayerInfo { digest: diff_id, diff_id, size: 0, unpacked: bytes }],
                ..ImageSpec::default()
            })
            .is_err(),
        "no image has a layer without its blob"
    );
    let layer = world.store.layer_from_tree(&tree, &options).unwrap();
    assert_eq!((layer.diff_id, layer.unpacked), (diff_id, bytes));
    // The blob contains what was staged: extracted from it, the tree packs to the same layer.
    world.store.discard_tree(&diff_id).unwrap();
    let extracted = world.store.ensure_extracted(&diff_id).unwrap();
    let unchanged = TreeOptions { overlay_upper: true, ..TreeOptions::default() };
    assert_eq!(world.store.layer_from_tree(&extracted, &unchanged).unwrap(), layer);
    // Staging an existing layer changes nothing.
    assert_eq!(world.store.stage_tree(&extracted, &unchanged).unwrap(), (diff_id, bytes));
    assert_eq!(world.leftovers(), Vec::<String>::new());
}

#[test]
fn a_tree_that_cannot_be_packed_is_not_staged() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    write(&tree.join("usr/.wh.x"), "x");
    let error = world.store.stage_tree(&tree, &TreeOptions::default()).unwrap_err().to_string();
    assert!(error.contains("tree/usr/.wh.x cannot go into a layer"), "{error}");
    assert_eq!(files::list(world.store.layers_dir()).unwrap().len(), 0);
}

#[test]
fn a_tree_that_would_be_misread_is_refused() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    write(&tree.join("usr/.wh.x"), "x");
    let error = world.store.layer_from_tree(&tree, &TreeOptions::default()).unwrap_err().to_string();
    assert!(error.contains("tree/usr/.wh.x cannot go into a layer"), "{error}");
    let deep = world.path("deep").join("d/".repeat(300));
    std::fs::create_dir_all(deep).unwrap();
    let error = world.store.layer_from_tree(&world.path("deep"), &TreeOptions::default()).unwrap_err().to_string();
    assert!(error.contains("more than 256 directories deep"), "{error}");
    assert!(world.leftovers().is_empty());
}

#[test]
fn owners_and_capabilities_leave_the_user_namespace() {
    // Only root can create files of other owners.
    if !is_root() {
        return;
    }
    let world = StoreFixture::new();
    let tree = world.path("tree");
    for (name, uid) in [("mapped", 101_000), ("daemons", 0)] {
        write(&tree.join(name), "x");
        std::os::unix::fs::chown(tree.join(name), Some(uid), Some(uid)).unwrap();
    }
    // CAP_NET_RAW, effective, bound to the namespace whose root is 100000.
    let mut capability = 0x0300_0001_u32.to_le_bytes().to_vec();
    capability.extend(0x2000_u32.to_le_bytes());
    capability.extend([0; 12]);
    capability.extend(100_000_u32.to_le_bytes());
    rustix::fs::setxattr(tree.join("mapped"), "security.capability", &capability, XattrFlags::empty()).unwrap();
    let options = TreeOptions { uid_offset: 100_000, ..TreeOptions::default() };
    let layer = world.store.layer_from_tree(&tree, &options).unwrap();
    let found = entries(&world.store, &layer);
    assert_eq!((found[0].uid, found[0].gid), (0, 0));
    assert_eq!((found[1].uid, found[1].gid), (1000, 1000));
    assert_eq!(found[1].xattrs.len(), 1);
    assert_eq!(found[1].xattrs[0].1[..4], 0x0200_0001_u32.to_le_bytes());

    let extracted = world.store.ensure_extracted(&layer.diff_id).unwrap().join("mapped");
    assert_eq!(extracted.metadata().unwrap().uid(), 1000);
    let mut value = [0; 64];
    assert_eq!(rustix::fs::getxattr(&extracted, "security.capability", &mut value[..]).unwrap(), 20);
}

#[test]
fn a_hostile_layer_writes_only_into_its_own_tree() {
    let world = StoreFixture::new();
    let outside = world.path("outside");
    std::fs::create_dir(&outside).unwrap();
    let outside = outside.to_str().unwrap();
    let layer = world.layer(&[
        (link("abs", Kind::Symlink, outside), ""),
        (Entry::new(&outside[1..], Kind::Directory, 0o755), ""),
        (file("abs/x"), "caught"),
        (link("up", Kind::Symlink, "../../../../../../../.."), ""),
        (file("up/y"), "caught too"),
        (file("/rooted"), "x"),
        (file("twice"), "1"),
        (file("twice"), "2"),
        (Entry::new("twice-dir/sub/", Kind::Directory, 0o755), ""),
        (file("twice-dir"), "now a file"),
        (Entry { device: (8, 0), ..Entry::new("sda", Kind::Block, 0o666) }, ""),
        (Entry::new("null", Kind::Character, 0o666), ""),
        (
            Entry {
                xattrs: vec![(b"trusted.overlay.redirect".to_vec(), b"/etc".to_vec())],
                ..Entry::new("r/", Kind::Directory, 0o755)
            },
            "",
        ),
    ]);
    let tree = world.store.ensure_extracted(&layer.diff_id).unwrap();
    assert!(files::list(Path::new(outside)).unwrap().is_empty());
    assert_eq!(std::fs::read_to_string(tree.join(&outside[1..]).join("x")).unwrap(), "caught");
    assert_eq!(std::fs::read_to_string(tree.join("y")).unwrap(), "caught too");
    assert_eq!(std::fs::read_to_string(tree.join("rooted")).unwrap(), "x");
    assert_eq!(std::fs::read_to_string(tree.join("twice")).unwrap(), "2");
    assert_eq!(std::fs::read_to_string(tree.join("twice-dir")).unwrap(), "now a file");
    assert!(!tree.join("sda").exists() && !tree.join("null").exists());
    let mut value = [0; 64];
    assert!(rustix::fs::getxattr(tree.join("r"), "trusted.overlay.redirect", &mut value[..]).is_err());
}

#[test]
fn a_layer_that_cannot_be_extracted_leaves_nothing() {
    let world = StoreFixture::new();
    let bad = [
        (file("a/../../x"), "goes up with '..'"),
        (link("l", Kind::Hardlink, "../../etc/passwd"), "goes up with '..'"),
        (link("l", Kind::Hardlink, "not-there"), "not-there"),
        (file(&"d/".repeat(300)), "300 directories deep"),
        (Entry { uid: u64::from(u32::MAX), ..file("f") }, "out of range"),
    ];
    for (entry, problem) in bad {
        let layer = world.layer(&[(file("good"), "x"), (entry, "")]);
        let error = world.store.ensure_extracted(&layer.diff_id).unwrap_err().to_string();
        assert!(error.contains(problem), "{error}");
        let archive = world.path("imported.tar.gz");
        let error = world.store.import_layer(&archive).unwrap_err().to_string();
        assert!(error.contains(problem), "{error}");
        assert!(!world.store.tree_path(&layer.diff_id).exists());
        assert!(world.leftovers().is_empty());
    }
}

#[test]
fn whiteouts_meet_their_namesakes_in_one_layer() {
    let world = StoreFixture::new();
    let directory = |name: &str| Entry::new(name, Kind::Directory, 0o755);
    let layer = world.layer(&[
        (file(".wh.first"), ""),
        (directory("first/"), ""),
        (directory("second/"), ""),
        (file(".wh.second"), ""),
        (file(".wh..wh.plnk"), ""),
        (file(".wh.."), ""),
        (file("kept"), "x"),
        (file(".wh.kept"), ""),
    ]);
    let tree = world.store.ensure_extracted(&layer.diff_id).unwrap();
    let options = TreeOptions { overlay_upper: true, ..TreeOptions::default() };
    let again = world.store.layer_from_tree(&tree, &options).unwrap();
    let found = entries(&world.store, &again);
    assert_eq!(names(&found), ["first/", "first/.wh..wh..opq", "kept", "second/", "second/.wh..wh..opq"]);
}

#[test]
fn many_threads_ask_for_one_layer() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    write_sample_tree(&tree, 2);
    let made = || world.store.layer_from_tree(&tree, &TreeOptions::default()).unwrap();
    let layers: Vec<LayerInfo> =
        std::thread::scope(|scope| [(); 4].map(|()| scope.spawn(made)).map(|made| made.join().unwrap()).to_vec());
    assert!(layers.iter().all(|layer| layer == &layers[0]));
    // A second store represents a second process.
    let other = open(world.directory.path());
    let extract = |store: &Store| store.ensure_extracted(&layers[0].diff_id).unwrap();
    std::thread::scope(|scope| {
        let own = [(); 3].map(|()| scope.spawn(|| extract(&world.store)));
        let others = [(); 3].map(|()| scope.spawn(|| extract(&other)));
        for extracted in own.into_iter().chain(others) {
            assert!(extracted.join().unwrap().join("etc/passwd").exists());
        }
    });
    assert!(world.leftovers().is_empty());
    assert!(world.store.verify().unwrap().is_empty());
}

#[test]
fn damaged_content_never_becomes_a_tree() {
    let world = StoreFixture::new();
    let layer = world.layer(&[(file("a"), "x")]);
    let other = world.layer(&[(file("b"), "x")]);
    // A record with another diff-id.
    let wrong = LayerInfo { digest: other.digest, size: other.size, ..layer };
    files::write_atomically(&world.store.record_path(&layer.diff_id), &to_json(&wrong)).unwrap();
    let error = world.store.ensure_extracted(&layer.diff_id).unwrap_err().to_string();
    assert!(error.contains("is damaged") && error.contains(&layer.diff_id.to_string()), "{error}");
    assert!(!world.store.tree_path(&layer.diff_id).exists());
    assert!(world.leftovers().is_empty());
}

#[test]
fn layers_go_out_and_come_in_unchanged() {
    let world = StoreFixture::new();
    let layer = world.layer(&[(file("a"), "x")]);
    let cached = world.path("cached.tar.gz");
    world.store.export_layer(&layer.diff_id, &cached).unwrap();
    let second = StoreFixture::new();
    assert_eq!(second.store.layer(&layer.diff_id).unwrap(), None);
    assert_eq!(second.store.import_layer(&cached).unwrap(), layer);
    let tree = second.store.layers_dir().join(layer.diff_id.hex());
    assert_eq!(std::fs::read(tree.join("a")).unwrap(), b"x", "it is extracted at once");
    assert_eq!(second.store.layer(&layer.diff_id).unwrap(), Some(layer));
    assert!(files::list(world.directory.path()).unwrap().iter().all(|e| e.file_name() != "tmp-"));
}

#[test]
fn what_is_no_layer_is_not_imported() {
    let world = StoreFixture::new();
    let path = world.path("x.tar.gz");
    std::fs::write(&path, "plain").unwrap();
    let error = world.store.import_layer(&path).unwrap_err().to_string();
    assert!(error.contains("x.tar.gz") && error.contains("not gzip"), "{error}");
    let layer = world.layer(&[(file("a"), "x")]);
    let mut whole = Vec::new();
    world.store.blob(&layer.digest).unwrap().unwrap().file.read_to_end(&mut whole).unwrap();
    std::fs::write(&path, &whole[..whole.len() - 9]).unwrap();
    let error = world.store.import_layer(&path).unwrap_err().to_string();
    assert!(error.contains("x.tar.gz: the archive is truncated"), "{error}");
    let missing = world.store.import_layer(&world.path("missing")).unwrap_err().to_string();
    assert!(missing.starts_with("cannot open ") && missing.contains("missing"), "{missing}");
    assert!(world.leftovers().is_empty());
    let unknown = Digest::compute("unknown");
    let error = world.store.ensure_extracted(&unknown).unwrap_err().to_string();
    assert!(error.contains(&unknown.to_string()) && error.contains("is not in the store"), "{error}");
}

fn spec(layers: &[LayerInfo]) -> ImageSpec {
    let pair = |a: &str, b: &str| (a.to_owned(), b.to_owned());
    ImageSpec {
        layers: layers.to_vec(),
        env: BTreeMap::from([pair("PATH", "/usr/bin"), pair("ROS_HOME", "/tmp=x")]),
        cmd: vec!["/bin/sh".to_owned()],
        working_dir: "/root".to_owned(),
        labels: (0..20).map(|i| pair(&format!("label{i}"), "v")).collect(),
        annotations: BTreeMap::from([pair("org.opencontainers.image.title", "x")]),
        created: 0,
    }
}

#[test]
fn images_have_names_and_keep_them() {
    let world = StoreFixture::new();
    let layers = [world.layer(&[(file("a"), "x")]), world.layer(&[(file("b"), "x")])];
    let image = world.store.put_image(&spec(&layers)).unwrap();
    assert_eq!(world.store.put_image(&spec(&layers)).unwrap(), image);
    let other = world.store.put_image(&spec(&layers[..1])).unwrap();
    world.store.tag("opencv_apps:1", &image).unwrap();
    world.store.tag("opencv_apps:latest", &image).unwrap();
    world.store.tag("opencv_apps:latest", &other).unwrap();
    world.store.tag("opencv_apps:latest", &other).unwrap();
    // Both tags of one image are recognised: the index is rewritten for neither.
    world.store.tag("opencv_apps:2", &image).unwrap();
    let index = || std::fs::metadata(world.store.images_dir().join("index.json")).unwrap().ino();
    let written = index();
    for name in ["opencv_apps:1", "opencv_apps:2"] {
        world.store.tag(name, &image).unwrap();
        assert_eq!(index(), written, "{name}");
    }
    world.store.untag("opencv_apps:2").unwrap();

    let reopened = open(world.directory.path());
    let tags = reopened.tags().unwrap();
    let expected = [("opencv_apps:1", image), ("opencv_apps:latest", other)];
    assert_eq!(tags, expected.map(|(name, image)| (name.to_owned(), image)).into());
    assert_eq!(reopened.resolve("opencv_apps:latest").unwrap(), Some(other));
    assert_eq!(reopened.resolve(&image.to_string()).unwrap(), Some(image));
    assert_eq!(reopened.resolve("nothing").unwrap(), None);
    assert_eq!(reopened.resolve(&layers[0].digest.to_string()).unwrap(), None);
    assert_eq!(reopened.image(&image).unwrap().spec, spec(&layers));
    let manifest = reopened.manifest("opencv_apps:1").unwrap().unwrap();
    assert_eq!((manifest.digest, &manifest.media_type[..]), (image, oci::MEDIA_MANIFEST));
    assert_eq!(Digest::compute(&manifest.bytes), image);

    assert!(reopened.untag("opencv_apps:latest").unwrap());
    assert!(!reopened.untag("opencv_apps:latest").unwrap());
    assert_eq!(reopened.images().unwrap(), BTreeSet::from([image, other]));
}

#[test]
fn bad_names_and_unknown_images_are_refused() {
    let world = StoreFixture::new();
    let layer = world.layer(&[(file("a"), "x")]);
    let image = world.store.put_image(&spec(&[layer])).unwrap();
    for name in ["", "../x", "a b", "ä", &"x".repeat(256), &image.to_string()] {
        let error = world.store.tag(name, &image).unwrap_err().to_string();
        assert!(error.contains("is not a tag"), "{error}");
    }
    let unknown = Digest::compute("unknown");
    let error = world.store.tag("x:1", &unknown).unwrap_err().to_string();
    assert!(error.contains(&unknown.to_string()), "{error}");
    assert!(world.store.image(&unknown).is_err());
    let absent = LayerInfo { digest: unknown, ..layer };
    assert!(matches!(world.store.put_image(&spec(&[absent])), Err(Error::UnknownLayer { .. })));
}

#[test]
fn many_threads_and_stores_tag_at_once() {
    let world = StoreFixture::new();
    let image = world.store.put_image(&spec(&[world.layer(&[(file("a"), "x")])])).unwrap();
    let other = open(world.directory.path());
    std::thread::scope(|scope| {
        for number in 0..8 {
            let store = if number % 2 == 0 { &world.store } else { &other };
            scope.spawn(move || store.tag(&format!("service:{number}"), &image).unwrap());
        }
    });
    assert_eq!(world.store.tags().unwrap().len(), 8);
}

#[test]
fn what_nobody_needs_goes_and_the_rest_stays() {
    let world = StoreFixture::new();
    let shared = world.layer(&[(file("shared"), "x")]);
    let old = world.layer(&[(file("old"), "x")]);
    let new = world.layer(&[(file("new"), "x")]);
    let in_use = world.layer(&[(file("in-use"), "x")]);
    let first = world.store.put_image(&spec(&[shared, old])).unwrap();
    let second = world.store.put_image(&spec(&[shared, new])).unwrap();
    world.store.tag("s:1", &first).unwrap();
    world.store.tag("s:2", &second).unwrap();
    for layer in [shared, old, new, in_use] {
        world.store.ensure_extracted(&layer.diff_id).unwrap();
    }
    let keep = BTreeSet::from([in_use.diff_id]);
    let swept = world.store.gc(&keep).unwrap();
    assert_eq!((swept.blobs, swept.trees, swept.deferred), (0, 0, false));

    world.store.untag("s:1").unwrap();
    let both = BTreeSet::from([in_use.diff_id, first]);
    assert_eq!(world.store.gc(&both).unwrap().blobs, 0, "a kept image stays without a tag");
    let hold = world.store.hold().unwrap();
    std::fs::write(world.store.images_dir().join("tmp-dead"), "x").unwrap();
    let swept = world.store.gc(&keep).unwrap();
    assert_eq!((swept.blobs, swept.leftovers, swept.deferred), (0, 1, true));
    drop(hold);
    let swept = world.store.gc(&keep).unwrap();
    // Manifest, configuration and layer.
    assert_eq!((swept.blobs, swept.trees), (3, 1));
    assert!(world.store.layer(&old.diff_id).unwrap().is_none());
    assert!(world.store.layer(&in_use.diff_id).unwrap().is_some());
    assert!(world.store.tree_path(&shared.diff_id).exists());
    assert!(world.store.verify().unwrap().is_empty());

    world.store.untag("s:2").unwrap();
    world.store.gc(&BTreeSet::new()).unwrap();
    assert!(files::list(&world.store.blobs_dir()).unwrap().is_empty());
    assert!(world.store.images().unwrap().is_empty());
}

#[test]
fn images_outlive_the_directory_of_layers() {
    let world = StoreFixture::new();
    let layer = world.layer(&[(file("a"), "x")]);
    world.store.put_image(&spec(&[layer])).unwrap();
    std::fs::remove_dir_all(world.store.layers_dir()).unwrap();
    let store = open(world.directory.path());
    assert_eq!(store.layer(&layer.diff_id).unwrap(), Some(LayerInfo { unpacked: 0, ..layer }));
    assert!(store.ensure_extracted(&layer.diff_id).unwrap().join("a").exists());
}

#[test]
fn a_check_names_what_is_damaged_and_what_is_missing() {
    let world = StoreFixture::new();
    let damaged = world.layer(&[(file("a"), "x")]);
    let missing = world.layer(&[(file("b"), "x")]);
    let image = world.store.put_image(&spec(&[damaged, missing])).unwrap();
    std::fs::write(world.store.blob_path(&damaged.digest), "rubbish").unwrap();
    std::fs::remove_file(world.store.blob_path(&missing.digest)).unwrap();
    let damages = world.store.verify().unwrap();
    let problem = |digest: &Digest| {
        let path = world.store.blob_path(digest);
        let of_it = damages.iter().filter(|damage| damage.path == path);
        of_it.map(|damage| damage.problem.as_str()).collect::<Vec<_>>().join("; ")
    };
    assert!(problem(&damaged.digest).contains("its content is sha256:"), "{damages:?}");
    assert!(problem(&missing.digest).contains(&format!("a layer of image {image} is missing")), "{damages:?}");
    std::fs::write(world.store.blob_path(&image), "{}").unwrap();
    let error = world.store.image(&image).unwrap_err().to_string();
    assert!(error.contains("is damaged"), "{error}");
}

#[test]
fn a_start_sweeps_what_a_crash_or_power_failure_left() {
    let world = StoreFixture::new();
    let layer = world.layer(&[(file("a"), "x")]);
    let tree = world.store.ensure_extracted(&layer.diff_id).unwrap();
    std::fs::write(world.store.images_dir().join("tmp-1"), "half a blob").unwrap();
    write(&world.store.layers_dir().join("tmp-2/usr/x"), "half a tree");
    // Marked by an earlier boot: its files may be empty now.
    let lost = Digest::compute("lost");
    write(&world.store.tree_path(&lost).join("empty"), "");
    let mark = world.store.layers_dir().join(format!("{}.volatile", lost.hex()));
    std::fs::write(&mark, "another boot").unwrap();
    let store = open(world.directory.path());
    assert!(world.leftovers().is_empty());
    assert!(tree.join("a").exists());
    assert!(!store.tree_path(&lost).exists() && !mark.exists());
}

#[test]
fn strange_directories_are_left_alone() {
    let directory = tempfile::tempdir().unwrap();
    let (images, layers) = (directory.path().join("images"), directory.path().join("layers"));
    write(&images.join("holiday.jpg"), "x");
    let error = Store::open(&images, &layers).unwrap_err().to_string();
    assert!(error.contains("holiday.jpg") && error.contains("choose another directory"), "{error}");
    std::fs::remove_file(images.join("holiday.jpg")).unwrap();
    std::fs::write(images.join("oci-layout"), r#"{"imageLayoutVersion":"2.0.0"}"#).unwrap();
    let error = Store::open(&images, &layers).unwrap_err().to_string();
    assert!(error.contains("its version is \"2.0.0\""), "{error}");
    std::fs::write(images.join("oci-layout"), r#"{"imageLayoutVersion":"1.0.0"}"#).unwrap();
    std::fs::write(images.join("index.json"), "{").unwrap();
    let error = Store::open(&images, &layers).unwrap_err().to_string();
    assert!(error.contains("index.json: "), "{error}");
}

#[test]
fn nobody_else_may_enter() {
    let world = StoreFixture::new();
    for directory in [world.store.images_dir(), world.store.layers_dir()] {
        assert_eq!(directory.metadata().unwrap().permissions().mode() & 0o777, 0o700);
    }
}

/// Runs the test `name` again in a mount namespace in which `DISK` is a file system of 2 MB; returns a directory on it
/// there, and `None` here.
fn on_a_small_disk(name: &str) -> Option<PathBuf> {
    const DISK: &str = "CLOUDROID_TEST_SMALL_DISK";
    if let Some(disk) = std::env::var_os(DISK) {
        return Some(disk.into());
    }
    let directory = tempfile::tempdir().unwrap();
    let mut unshare = std::process::Command::new("unshare");
    if !is_root() {
        unshare.arg("--map-root-user");
    }
    let script = r#"mount -t tmpfs -o size=2m none "$1" && exec "$2" --exact "$3""#;
    let output = unshare
        .args(["--mount", "sh", "-c", script, "sh"])
        .arg(directory.path())
        .arg(std::env::current_exe().unwrap())
        .arg(name)
        .env(DISK, directory.path())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && text.contains("1 passed"), "{text}{}", String::from_utf8_lossy(&output.stderr));
    None
}

#[test]
fn a_full_disk_is_told_and_leaves_nothing() {
    let Some(disk) = on_a_small_disk("store::tests::a_full_disk_is_told_and_leaves_nothing") else {
        return;
    };
    let store = open(&disk);
    let elsewhere = tempfile::tempdir().unwrap();
    let tree = elsewhere.path().join("tree");
    // Incompressible, so neither blob nor tree fits.
    let mut state = 1_u64;
    let noise: Vec<u8> = (0..6 << 20)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 56) as u8
        })
        .collect();
    std::fs::create_dir(&tree).unwrap();
    std::fs::write(tree.join("noise"), &noise).unwrap();
    let told = |error: Error| {
        let text = error.to_string();
        assert!(matches!(error, Error::DiskFull { .. }), "{text}");
        assert!(text.contains(disk.to_str().unwrap()) && text.contains("free some space"), "{text}");
        for directory in [store.images_dir(), store.layers_dir()] {
            let names = files::list(directory).unwrap();
            assert!(names.iter().all(|entry| !entry.file_name().to_string_lossy().starts_with("tmp-")), "{names:?}");
        }
        assert!(files::list(&store.blobs_dir()).unwrap().is_empty());
        text
    };
    told(store.layer_from_tree(&tree, &TreeOptions::default()).unwrap_err());

    let large = Store::open(&elsewhere.path().join("images"), &elsewhere.path().join("layers")).unwrap();
    let layer = large.layer_from_tree(&tree, &TreeOptions::default()).unwrap();
    let archive = elsewhere.path().join("layer.tar.gz");
    large.export_layer(&layer.diff_id, &archive).unwrap();
    let text = told(store.import_layer(&archive).unwrap_err());
    assert!(text.contains("6293 kB are needed"), "{text}");
    assert!(matches!(large.export_layer(&layer.diff_id, &disk.join("x")), Err(Error::DiskFull { .. })));

    // The blob fits, the tree does not.
    std::fs::write(tree.join("noise"), vec![0; 6 << 20]).unwrap();
    let layer = store.layer_from_tree(&tree, &TreeOptions::default()).unwrap();
    let error = store.ensure_extracted(&layer.diff_id).unwrap_err();
    let text = error.to_string();
    assert!(matches!(error, Error::DiskFull { needed: Some(_), .. }) && text.contains("noise"), "{text}");
    assert!(!store.tree_path(&layer.diff_id).exists());
    assert!(
        rustix::fs::accessat(File::open(&disk).unwrap(), "layers", rustix::fs::Access::EXISTS, AtFlags::empty())
            .is_ok()
    );
    // There is room again for small files.
    files::write_atomically(&disk.join("small"), &[0; 4096]).unwrap();
}

#[test]
fn packing_and_extracting_end_when_they_are_cancelled() {
    let world = StoreFixture::new();
    let tree = world.path("tree");
    write(&tree.join("a/b"), "content");
    let layer = world.store.layer_from_tree(&tree, &TreeOptions::default()).unwrap();
    let cancel = foreign::cancel::Cancel::default();
    cancel.cancel();
    write(&tree.join("a/c"), "more");
    cancel.run(|| {
        world.store.layer_from_tree(&tree, &TreeOptions::default()).unwrap_err();
        world.store.ensure_extracted(&layer.diff_id).unwrap_err();
    });
    assert_eq!(world.leftovers(), Vec::<String>::new());
    // Cancelled work succeeds when it is requested again.
    let extracted = world.store.ensure_extracted(&layer.diff_id).unwrap();
    assert_eq!(std::fs::read_to_string(extracted.join("a/b")).unwrap(), "content");
}
