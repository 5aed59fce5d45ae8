use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::PathBuf;

use super::*;
use crate::tar_writer::TarWriter;

/// Builder of an archive; the writer checks nothing, so it can contain anything.
struct Archive(TarWriter<Vec<u8>>);

impl Archive {
    fn new() -> Self {
        Self(TarWriter::new(Vec::new()))
    }

    fn file(mut self, name: impl AsRef<[u8]>, content: &str) -> Self {
        let mut entry = Entry::new(name.as_ref(), Kind::File, 0o644);
        entry.size = content.len() as u64;
        self.0.write_file(&entry, content.as_bytes(), &mut [0; 512]).unwrap();
        self
    }

    fn entry(mut self, name: &str, kind: Kind, link: &str) -> Self {
        let mut entry = Entry::new(name, kind, 0o755);
        entry.link = link.into();
        self.0.write_header(&entry).unwrap();
        self
    }

    fn directory(self, name: &str) -> Self {
        self.entry(name, Kind::Directory, "")
    }

    fn symlink(self, name: &str, target: &str) -> Self {
        self.entry(name, Kind::Symlink, target)
    }

    fn hardlink(self, name: &str, target: &str) -> Self {
        self.entry(name, Kind::Hardlink, target)
    }

    fn bytes(self) -> Vec<u8> {
        self.0.finish().unwrap()
    }
}

struct UnpackFixture {
    _directory: tempfile::TempDir,
    destination: PathBuf,
}

fn new_fixture() -> UnpackFixture {
    let directory = tempfile::tempdir().unwrap();
    let destination = directory.path().join("push");
    UnpackFixture { _directory: directory, destination }
}

/// Returns the message of a refusal, after checking that nothing is left.
fn refusal_within(bytes: &[u8], limits: &Limits) -> String {
    let place = new_fixture();
    let error = unpack(bytes, &place.destination, limits).unwrap_err();
    assert!(!place.destination.exists(), "something is left after: {error}");
    error.to_string()
}

fn refusal(archive: Archive) -> String {
    refusal_within(&archive.bytes(), &Limits::default())
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part:?} is not in: {message}");
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn ordinary_archive() -> Vec<u8> {
    let long = format!("pkg/{}/{}.msg", "d".repeat(90), "n".repeat(200));
    let mut archive = Archive::new()
        .directory("./")
        .file("pkg/package.xml", "<package/>")
        .symlink("pkg/scripts/latest", "./run")
        .hardlink("pkg/copy.xml", "pkg/package.xml")
        .symlink("pkg/back", "scripts/../package.xml")
        .directory("pkg")
        .file(long, "int32 x");
    let mut script = Entry::new("pkg/scripts/run", Kind::File, 0o4775);
    script.size = 2;
    archive.0.write_file(&script, &b"#!"[..], &mut [0; 16]).unwrap();
    archive.bytes()
}

#[test]
fn an_ordinary_archive_arrives_gzip_or_not() {
    for bytes in [ordinary_archive(), gzip(&ordinary_archive())] {
        let place = new_fixture();
        let done = unpack(&bytes[..], &place.destination, &Limits::default()).unwrap();
        assert_eq!(done, UnpackStats { entries: 8, bytes: 10 + 7 + 2 });
        let package = place.destination.join("pkg");
        assert_eq!(std::fs::read_to_string(package.join("back")).unwrap(), "<package/>");
        assert_eq!(std::fs::read_to_string(package.join("scripts/latest")).unwrap(), "#!");
        let script = package.join("scripts/run").metadata().unwrap();
        assert_eq!(script.permissions().mode() & 0o7777, 0o755, "set-uid is not taken over");
        let xml = package.join("package.xml").metadata().unwrap();
        assert_eq!((xml.permissions().mode() & 0o7777, xml.nlink()), (0o644, 2));
        assert_eq!(xml.uid(), rustix::process::geteuid().as_raw());
    }
}

#[test]
fn owners_left_blank_are_root_and_owners_that_are_no_numbers_refused() {
    let with_owner = |owner: &[u8; 8]| {
        let mut bytes = Archive::new().file("package.xml", "<package/>").bytes();
        bytes[108..116].copy_from_slice(owner);
        // The checksum is computed with spaces in the checksum field.
        bytes[148..156].fill(b' ');
        let sum: u32 = bytes[..512].iter().map(|byte| u32::from(*byte)).sum();
        bytes[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
        bytes
    };
    for blank in [b"\0\0\0\0\0\0\0\0", b"        "] {
        let place = new_fixture();
        unpack(with_owner(blank).as_slice(), &place.destination, &Limits::default()).unwrap();
        assert!(place.destination.join("package.xml").exists());
    }
    let refused = refusal_within(&with_owner(b"nobody\0\0"), &Limits::default());
    assert_says(&refused, &["package.xml"]);
}

#[test]
fn an_empty_destination_is_taken_and_a_full_one_left_alone() {
    let place = new_fixture();
    std::fs::create_dir(&place.destination).unwrap();
    unpack(&ordinary_archive()[..], &place.destination, &Limits::default()).unwrap();
    let error = unpack(&ordinary_archive()[..], &place.destination, &Limits::default()).unwrap_err();
    assert_says(&error.to_string(), &["cannot unpack into", "not empty"]);
    assert!(place.destination.join("pkg/package.xml").exists());
}

#[test]
fn paths_that_leave_are_refused() {
    assert_says(&refusal(Archive::new().file("a/../../etc/passwd", "")), &["a/../../etc/passwd", "goes up with '..'"]);
    assert_says(&refusal(Archive::new().file("/etc/passwd", "")), &["\"/etc/passwd\"", "absolute path"]);
    assert_says(&refusal(Archive::new().directory("ok").directory("..")), &["\"..\"", "goes up"]);
}

#[test]
fn devices_and_fifos_are_refused() {
    for (kind, word) in [(Kind::Character, "character device"), (Kind::Block, "block device"), (Kind::Fifo, "fifo")] {
        assert_says(&refusal(Archive::new().entry("dev/x", kind, "")), &["\"dev/x\"", word, "only files"]);
    }
    assert_says(&refusal(Archive::new().entry("x", Kind::Other(b'V'), "")), &["\"x\"", "entry of type 'V'"]);
}

#[test]
fn symbolic_links_that_leave_are_refused() {
    for (name, target) in [("a/l", "/etc/passwd"), ("a/l", "../../etc/passwd"), ("l", ".."), ("l", "")] {
        assert_says(&refusal(Archive::new().symlink(name, target)), &[name, "leaves the archive"]);
    }
    // p/q/up is p/q itself, so going up three times from there leaves the tree, though its text does not show it.
    let sly = Archive::new().symlink("p/q/up", ".").symlink("p/q/x", "up/../../..");
    assert_says(&refusal(sly), &["\"p/q/x\"", "leaves the archive"]);
    // A missing target cannot be checked.
    let dangling = Archive::new().symlink("p/x", "not-there/../../..");
    assert_says(&refusal(dangling), &["\"p/x\"", "leaves the archive"]);
}

#[test]
fn links_that_stay_are_fine_even_if_they_lead_nowhere() {
    let place = new_fixture();
    let archive = Archive::new()
        .symlink("a/b/up", "../..")
        .symlink("later", "a/b/real")
        .symlink("nowhere", "not/there")
        .symlink("loop", "loop")
        .directory("a/b/real");
    unpack(&archive.bytes()[..], &place.destination, &Limits::default()).unwrap();
    assert!(place.destination.join("later").is_dir());
}

#[test]
fn hard_links_that_leave_or_lead_nowhere_are_refused() {
    assert_says(
        &refusal(Archive::new().hardlink("l", "/etc/passwd")),
        &["\"l\"", "\"/etc/passwd\"", "leaves the archive"],
    );
    assert_says(&refusal(Archive::new().hardlink("l", "../x")), &["\"l\"", "leaves the archive"]);
    assert_says(&refusal(Archive::new().hardlink("l", "x")), &["\"l\"", "no earlier file"]);
    assert_says(&refusal(Archive::new().directory("d").hardlink("l", "d")), &["\"l\"", "no earlier file"]);
    // The same relative target means something else there.
    let moved = Archive::new().symlink("a/b/c", "../../x").hardlink("c", "a/b/c");
    assert_says(&refusal(moved), &["\"c\"", "no earlier file"]);
    let behind = Archive::new().file("d/f", "").symlink("s", "d").hardlink("l", "s/f");
    assert_says(&refusal(behind), &["\"l\"", "no earlier file"]);
}

#[test]
fn nothing_may_lie_behind_a_link() {
    let behind = || Archive::new().directory("d").symlink("s", "d");
    assert_says(&refusal(behind().file("s/f", "x")), &["\"s/f\"", "behind the symbolic link \"s\""]);
    assert_says(&refusal(behind().directory("s/deep/er")), &["\"s/deep/er\"", "behind the symbolic link \"s\""]);
    assert_says(&refusal(behind().symlink("s/l", "f")), &["\"s/l\"", "behind"]);
    assert_says(&refusal(behind().directory("s")), &["\"s\"", "twice"]);
    assert_says(&refusal(behind().file("s", "x")), &["\"s\"", "twice"]);
}

#[test]
fn one_name_is_one_thing() {
    assert_says(&refusal(Archive::new().file("f", "1").file("./f", "2")), &["\"./f\"", "twice"]);
    assert_says(&refusal(Archive::new().file("f", "1").directory("f")), &["\"f\"", "twice"]);
    assert_says(&refusal(Archive::new().file("f", "1").file("f/g", "2")), &["\"f/g\"", "twice"]);
    assert_says(&refusal(Archive::new().directory("d").file("d", "2")), &["\"d\"", "twice"]);
    assert_says(&refusal(Archive::new().symlink(".", "x")), &["\".\"", "the root of the archive"]);
}

#[test]
fn names_that_cannot_be_are_refused() {
    // Beyond 100 bytes the name goes into a pax record, which can contain NUL.
    let nul = [&b"a\0"[..], &[b'x'; 120]].concat();
    assert_says(&refusal(Archive::new().file(nul, "")), &["NUL byte", "a\\0xxx"]);
    assert_says(&refusal(Archive::new().file("n".repeat(256), "")), &["one part is 256 bytes long"]);
    assert_says(&refusal(Archive::new().file("long/".repeat(300), "")), &["1500 bytes long; the limit is 1024"]);
}

#[test]
fn too_much_is_refused() {
    let archive = Archive::new().file("a", "1").file("b", "2").file("c", "3").bytes();
    let limits = Limits { entries: 2, ..Limits::default() };
    assert_says(&refusal_within(&archive, &limits), &["\"c\" exceeds the limit", "limit of 2 entries"]);

    let bomb = gzip(&Archive::new().file("small", "x").file("zeros", &"0".repeat(5 << 20)).bytes());
    assert!(bomb.len() < 64 << 10);
    let limits = Limits { bytes: 1 << 20, ..Limits::default() };
    assert_says(&refusal_within(&bomb, &limits), &["\"zeros\"", "larger than the limit of 1048 kB"]);

    let exact = Archive::new().file("a", "1").bytes();
    let limits = Limits { bytes: exact.len() as u64, ..Limits::default() };
    assert!(unpack(&exact[..], &new_fixture().destination, &limits).is_ok());
}

#[test]
fn an_archive_that_is_cut_off_is_refused() {
    let whole = Archive::new().file("a", "1").file("b", &"2".repeat(600)).bytes();
    // In a header, in a content, in the padding, and where only the end mark is missing.
    for length in [300, 512 + 100, 3 * 512 + 100, 3 * 512 + 700, 5 * 512] {
        let message = refusal_within(&whole[..length], &Limits::default());
        assert_says(&message, &["truncated after entry"]);
    }
    let packed = gzip(&whole);
    for length in [packed.len() - 1, packed.len() / 2, 5] {
        assert_says(&refusal_within(&packed[..length], &Limits::default()), &["truncated after entry"]);
    }
    assert_says(&refusal_within(b"", &Limits::default()), &["truncated after entry \"\""]);
}

#[test]
fn what_is_no_archive_is_refused() {
    assert_says(&refusal_within(&[b'x'; 2048], &Limits::default()), &["cannot read the archive", "checksum"]);
    assert_says(&refusal_within(&[0x28, 0xb5, 0x2f, 0xfd, 0, 0], &Limits::default()), &["zstd", "tar.gz"]);
    let mut damaged = gzip(&Archive::new().file("a", &"0123456789".repeat(500)).bytes());
    let middle = damaged.len() - 6;
    damaged[middle] ^= 0xff;
    assert_says(&refusal_within(&damaged, &Limits::default()), &["cannot read the archive"]);
}

#[test]
fn sparse_files_and_endless_headers_are_refused() {
    assert_says(&refusal(Archive::new().entry("s", Kind::Other(b'S'), "")), &["sparse"]);
    let mut archive = Archive::new();
    let mut endless = Entry::new("x", Kind::Other(b'x'), 0o644);
    endless.size = 1 << 32;
    archive.0.write_header(&endless).unwrap();
    assert_says(&refusal(archive), &["extended headers of 4294967296 bytes"]);
}

#[test]
fn a_source_that_fails_leaves_nothing() {
    struct Fails;
    impl Read for Fails {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::ErrorKind::ConnectionReset.into())
        }
    }
    let archive = Archive::new().file("a", "1").bytes();
    let place = new_fixture();
    let error = unpack((&archive[..600]).chain(Fails), &place.destination, &Limits::default()).unwrap_err();
    assert_says(&error.to_string(), &["cannot read the archive", "connection reset"]);
    assert!(!place.destination.exists());
}

#[test]
fn extended_headers_count_as_entries() {
    use crate::tar_reader::tests::{extension, member};
    let mut bytes = Vec::new();
    for name in ["one", "two", "three"] {
        bytes.extend(extension(1));
        bytes.extend(member(tar::EntryType::Regular, name, b"content"));
    }
    bytes.extend([0; 1024]);
    let within = |entries| Limits { entries, ..Limits::default() };
    let place = new_fixture();
    let unpacked = unpack(&bytes[..], &place.destination, &within(6)).unwrap();
    assert_eq!(unpacked.entries, 3);
    assert_says(&refusal_within(&bytes, &within(5)), &["three", "limit of 5"]);
}
