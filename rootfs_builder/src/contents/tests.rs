use super::*;
use flate2::Compression;
use flate2::write::GzEncoder;

/// Writes a list as in the archive.
pub(crate) fn list(directory: &Path, name: &str, text: &str) -> PathBuf {
    let path = directory.join(name);
    let mut gz = GzEncoder::new(File::create(&path).expect("made"), Compression::fast());
    gz.write_all(text.as_bytes()).expect("written");
    gz.finish().expect("written");
    path
}

fn example(directory: &Path) -> Contents {
    let t = triplet();
    let native = format!(
        "usr/lib/nodelet/nodelet   libs/nodelet-tools\n\
         usr/lib/{t}/libfoo.so.1   libs/libfoo1\n\
         usr/lib/{t}/libfoo.so   libdevel/libfoo-dev\n\
         usr/lib/{t}/blas/libblas.so.3   libs/libblas3\n\
         usr/lib/{t}/deep/libdeep.so.3   libs/libdeep3\n\
         usr/lib/{t}/cmake/nodelet/nodeletConfig.cmake   libdevel/libnodelet-dev\n\
         lib/{t}/libc.so.6   libs/libc6,libs/libc6-other\n\
         usr/share/nodelet/package.xml   libs/nodelet-tools\n\
         usr/share/nodelet/srv/NodeletLoad.srv   devel/ros-nodelet-srvs\n"
    );
    let all = "usr/lib/python3/dist-packages/nodelet/__init__.py python/python3-nodelet\n\
               usr/share/doc/with space/x doc/y\n";
    Contents::open(directory, &[list(directory, "a.gz", &native), list(directory, "b.gz", all)]).expect("read")
}

#[test]
fn libraries_and_ros_packages_are_found() {
    let directory = tempfile::tempdir().expect("a directory");
    let contents = example(directory.path());
    assert_eq!(contents.library("libfoo.so.1"), Some("libfoo1"));
    assert_eq!(contents.library("libblas.so.3"), Some("libblas3"));
    assert_eq!(contents.library("libc.so.6"), Some("libc6"));
    assert_eq!(contents.library("libdeep.so.3"), None);
    let nodelet = contents.ros_package("nodelet");
    assert_eq!(nodelet["nodelet-tools"], [RosPackagePart::Manifest, RosPackagePart::Programs].into());
    assert_eq!(nodelet["ros-nodelet-srvs"], [RosPackagePart::Definitions].into());
    assert_eq!(nodelet["python3-nodelet"], [RosPackagePart::Python].into());
    assert_eq!(nodelet["libnodelet-dev"], [RosPackagePart::CMake].into());
    assert!(contents.ros_package("nodele").is_empty());
    assert_eq!(contents.ros_packages_in("python3-nodelet"), ["nodelet"]);
}

#[test]
fn it_is_made_once() {
    let directory = tempfile::tempdir().expect("a directory");
    example(directory.path());
    let made = || {
        let names = fs::read_dir(directory.path()).expect("listed").flatten().map(|entry| entry.file_name());
        names.filter(|name| name.to_string_lossy().starts_with("contents-")).collect::<Vec<_>>()
    };
    let first = made();
    assert_eq!(first.len(), 1);
    let lists = [directory.path().join("a.gz"), directory.path().join("b.gz")];
    fs::write(directory.path().join(&first[0]), "lx.so\tmarked").expect("written");
    let again = Contents::open(directory.path(), &lists).expect("read");
    assert_eq!(again.library("x.so"), Some("marked"), "read, not made again");
}
