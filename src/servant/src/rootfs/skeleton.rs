//! The topmost layer: what every servant needs in a root that it cannot write.

use std::fs;
use std::net::IpAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use super::{make_directory, normal_component};
use crate::Error;
use crate::container::Mount;

/// Creates the directories, files and links in an empty root.
pub fn make_skeleton(
    skeleton: &Path,
    id: &str,
    layers: &[PathBuf],
    mounts: &[Mount],
    names: &[(IpAddr, String)],
) -> Result<(), Error> {
    make_directory(skeleton)?;
    for (name, mode) in [
        ("dev", 0o755),
        ("etc", 0o755),
        ("proc", 0o555),
        ("root", 0o700),
        ("run", 0o755),
        ("sys", 0o555),
        ("tmp", 0o1777),
        ("var", 0o755),
        ("var/tmp", 0o1777),
    ] {
        let path = skeleton.join(name);
        make_directory(&path)?;
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).map_err(Error::file("change", &path))?;
    }
    let mut hosts = format!("127.0.0.1\tlocalhost\n127.0.0.1\t{id}\n::1\tlocalhost ip6-localhost ip6-loopback\n");
    for (address, name) in names {
        hosts += &format!("{address}\t{name}\n");
    }
    let files = [("hosts", hosts), ("hostname", format!("{id}\n")), ("resolv.conf", String::new())];
    for (name, text) in files {
        let path = skeleton.join("etc").join(name);
        fs::write(&path, text).map_err(Error::file("write", &path))?;
    }
    for mount in mounts {
        make_mount_point(skeleton, layers, mount)?;
    }
    Ok(())
}

/// Creates a mount point, which a read-only root must already contain. Its directories must not hide a link of the
/// layers.
fn make_mount_point(skeleton: &Path, layers: &[PathBuf], mount: &Mount) -> Result<(), Error> {
    let inside: PathBuf = mount.target.components().filter_map(normal_component).collect();
    for part in inside.ancestors().filter(|part| !part.as_os_str().is_empty()) {
        let found = layers.iter().rev().find_map(|layer| fs::symlink_metadata(layer.join(part)).ok());
        if found.is_some_and(|metadata| metadata.is_symlink()) {
            return Err(Error::Malformed {
                path: mount.target.clone(),
                reason: format!("/{} is a link in the image: mount at its target", part.display()),
            });
        }
    }
    let path = skeleton.join(&inside);
    let is_directory = mount.is_directory();
    if is_directory.map_err(Error::file("mount", &mount.source))? {
        return fs::create_dir_all(&path).map_err(Error::file("make", &path));
    }
    let above = path.parent().unwrap_or(skeleton);
    fs::create_dir_all(above).map_err(Error::file("make", above))?;
    fs::write(&path, "").map_err(Error::file("make", &path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mount_through_a_link_of_the_image_is_refused() {
        let home = tempfile::tempdir().unwrap();
        let layer = home.path().join("layer");
        fs::create_dir_all(layer.join("usr/lib")).unwrap();
        std::os::unix::fs::symlink("usr/lib", layer.join("lib")).unwrap();
        let mount = |target: &str| Mount {
            source: home.path().into(),
            target: target.into(),
            writable: false,
            device: false,
            opened: None,
        };
        let make = |name: &str, target: &str| {
            make_skeleton(&home.path().join(name), "x", std::slice::from_ref(&layer), &[mount(target)], &[])
        };
        let error = make("one", "/lib/models").unwrap_err().to_string();
        assert!(error.contains("/lib is a link in the image"), "{error}");
        make("two", "/usr/lib/models").unwrap();
        assert!(home.path().join("two/usr/lib/models").is_dir());
        assert!(!layer.join("usr/lib/models").exists(), "the layer is not written");
    }
}
