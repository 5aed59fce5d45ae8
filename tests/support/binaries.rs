//! Locations of the programs under test: next to this test executable, where cargo and make build them, or in
//! `CLOUDROID_BIN`.

use std::path::PathBuf;

/// Returns the path of the program `name`.
pub fn path(name: &str) -> PathBuf {
    if let Some(installed) = std::env::var_os("CLOUDROID_BIN") {
        return PathBuf::from(installed).join(name);
    }
    let test = std::env::current_exe().expect("the path of the running test");
    let directory = test.parent().and_then(|deps| deps.parent()).expect("target/PROFILE/deps");
    let path = directory.join(name);
    assert!(path.exists(), "{} is missing; run make build-dev", path.display());
    path
}

/// Returns the checkout of these stories.
pub fn checkout() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the checkout").to_owned()
}

/// Returns a package below `tests/packages`.
pub fn package(name: &str) -> PathBuf {
    checkout().join("tests/packages").join(name)
}

/// Returns the Python that has roslibpy (see scripts/python).
pub fn python() -> PathBuf {
    std::env::var_os("CLOUDROID_PYTHON")
        .map(PathBuf::from)
        .expect("CLOUDROID_PYTHON names the Python environment; run the stories by make stories")
}

/// Returns the environment with rclpy (see scripts/ros2-wheels).
pub fn ros2() -> PathBuf {
    std::env::var_os("CLOUDROID_ROS2_PREFIX")
        .map(PathBuf::from)
        .expect("CLOUDROID_ROS2_PREFIX names the environment with ROS 2; run the stories by make stories")
}

/// Returns the directory of Python programs that parse the daemon's HTTP responses (see scripts/python).
pub fn readers() -> PathBuf {
    std::env::var_os("CLOUDROID_READERS")
        .map(PathBuf::from)
        .expect("CLOUDROID_READERS names programs that read HTTP; run the stories by make stories")
}

/// Returns the directory of roslib and oidc-provider (see scripts/node).
pub fn node_modules() -> PathBuf {
    std::env::var_os("CLOUDROID_NODE_MODULES")
        .map(PathBuf::from)
        .expect("CLOUDROID_NODE_MODULES names Node's packages; run the stories by make stories")
}

/// Returns the directory of the browser automation (see scripts/node).
pub fn web_modules() -> PathBuf {
    std::env::var_os("CLOUDROID_WEB_MODULES")
        .map(PathBuf::from)
        .expect("CLOUDROID_WEB_MODULES names Node's packages; run the stories by make stories or make test-web")
}

/// Returns the cache directory shared by all checkouts.
pub fn cache() -> PathBuf {
    let caches = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from);
    let home = || PathBuf::from(std::env::var_os("HOME").unwrap_or_else(|| "/root".into()));
    caches.unwrap_or_else(|| home().join(".cache")).join("cloudroid")
}

/// Returns the directory for results of this checkout: its `target`, or `CLOUDROID_TARGET` for runs that are themselves
/// under test.
pub fn target() -> PathBuf {
    std::env::var_os("CLOUDROID_TARGET").map_or_else(|| checkout().join("target"), PathBuf::from)
}
