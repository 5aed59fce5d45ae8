//! Devices by the Container Device Interface (CNCF CDI 0.3 to 0.8): a specification, in JSON or YAML, names a device
//! and says what a container needs for it. Device nodes, mounts and environment are provided. Hooks, which are programs
//! to run on the host, are not run (docs/adr/027): a device with hooks works if it can do without them, and its push is
//! told of each by name.

use std::collections::BTreeMap;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::ResolvedGrants;
use crate::container::Mount;
use crate::grant_error::{CdiError, GrantError};

/// Returns the standard directories of specifications; later ones override earlier ones.
pub(super) fn directories() -> Vec<PathBuf> {
    ["/etc/cdi", "/var/run/cdi"].map(PathBuf::from).into()
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Specification {
    kind: String,
    #[serde(default)]
    devices: Vec<Device>,
    #[serde(default)]
    container_edits: Edits,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Device {
    name: String,
    #[serde(default)]
    container_edits: Edits,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Edits {
    env: Vec<String>,
    device_nodes: Vec<CdiDeviceNode>,
    mounts: Vec<Bind>,
    hooks: Vec<Hook>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Hook {
    hook_name: String,
    path: PathBuf,
    #[serde(default)]
    args: Vec<String>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct CdiDeviceNode {
    path: PathBuf,
    host_path: Option<PathBuf>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Bind {
    host_path: PathBuf,
    container_path: PathBuf,
}

/// Adds the mounts and variables that the device `name` needs.
pub(super) fn add_device(name: &str, directories: &[PathBuf], granted: &mut ResolvedGrants) -> Result<(), GrantError> {
    let mut devices = BTreeMap::new();
    for path in specification_files(directories) {
        let specification = read_specification(&path)?;
        for device in &specification.devices {
            let full = format!("{}={}", specification.kind, device.name);
            let edits = (path.clone(), [&specification.container_edits, &device.container_edits].map(resolve_edits));
            devices.insert(full, edits);
        }
    }
    let known = devices.keys().cloned().collect::<Vec<_>>().join(", ");
    let (path, edits) = devices.remove(name).ok_or_else(|| GrantError::UnknownDevice {
        name: name.to_owned(),
        directories: directories.iter().map(|one| one.display().to_string()).collect::<Vec<_>>().join(" and "),
        known: if known.is_empty() { "none".to_owned() } else { known },
    })?;
    for edit in edits {
        let edit = edit.map_err(|reason| GrantError::Specification { path: path.clone(), reason })?;
        for mount in edit.mounts {
            // Devices of one vendor may share files.
            if !granted.mounts.iter().any(|there| there.target == mount.target) {
                granted.mounts.push(mount);
            }
        }
        granted.environment.extend(edit.environment);
        for hook in edit.unfulfilled {
            let told = format!("device {name}: {hook}");
            if !granted.unfulfilled.contains(&told) {
                granted.unfulfilled.push(told);
            }
        }
    }
    Ok(())
}

fn specification_files(directories: &[PathBuf]) -> Vec<PathBuf> {
    let is_one = |path: &PathBuf| {
        let ending = path.extension().and_then(|ending| ending.to_str());
        matches!(ending, Some("json" | "yaml"))
    };
    let mut all = Vec::new();
    for directory in directories {
        let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
        let mut found: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(is_one).collect();
        found.sort();
        all.extend(found);
    }
    all
}

fn read_specification(path: &Path) -> Result<Specification, GrantError> {
    let broken = |reason: CdiError| GrantError::Specification { path: path.to_owned(), reason };
    let text = std::fs::read_to_string(path).map_err(|error| broken(CdiError::Unreadable(error)))?;
    // Every JSON text is valid YAML.
    serde_norway::from_str(&text).map_err(|error| broken(CdiError::Malformed(error)))
}

fn resolve_edits(edits: &Edits) -> Result<ResolvedGrants, CdiError> {
    let mut granted = ResolvedGrants::default();
    for variable in &edits.env {
        let (name, value) = variable.split_once('=').ok_or_else(|| CdiError::Variable(variable.clone()))?;
        granted.environment.insert(name.to_owned(), value.to_owned());
    }
    for node in &edits.device_nodes {
        let source = node.host_path.clone().unwrap_or_else(|| node.path.clone());
        let kind = match std::fs::metadata(&source) {
            Ok(metadata) => metadata.file_type(),
            Err(error) => {
                return Err(CdiError::Device { path: source, error });
            }
        };
        if !kind.is_char_device() && !kind.is_block_device() {
            return Err(CdiError::NotADevice(source));
        }
        granted.mounts.push(Mount { source, target: node.path.clone(), writable: false, device: true, opened: None });
    }
    for bind in &edits.mounts {
        granted.mounts.push(Mount {
            source: bind.host_path.clone(),
            target: bind.container_path.clone(),
            writable: false,
            device: false,
            opened: None,
        });
    }
    for hook in &edits.hooks {
        // The first argument is the name of the program itself.
        let does = hook.args.get(1..).unwrap_or_default().join(" ");
        let command = format!("{} {does}", hook.path.display());
        granted.unfulfilled.push(format!(
            "its hook {} ({}) is not run; the device may work without it",
            hook.hook_name,
            command.trim_end()
        ));
    }
    Ok(granted)
}

#[cfg(test)]
mod tests {
    use super::*;

    const YAML: &str = "\
cdiVersion: 0.6.0
kind: vendor.com/harmless
containerEdits:
  env: [VENDOR=here]
  hooks:
    - hookName: createContainer
      path: /usr/bin/vendor-hook
      args: [vendor-hook, update-ldcache]
devices:
  - name: zero
    containerEdits:
      deviceNodes:
        - path: /dev/vendor0
          hostPath: /dev/zero
      mounts:
        - hostPath: /etc/hostname
          containerPath: /usr/share/vendor
          options: [ro]
  - name: broken
    containerEdits:
      deviceNodes: [{path: /etc/hostname}]
";

    #[test]
    fn a_device_brings_what_its_specification_says() {
        let place = tempfile::tempdir().expect("a directory");
        std::fs::write(place.path().join("vendor.yaml"), YAML).expect("written");
        let directories = [place.path().to_owned()];
        let mut granted = ResolvedGrants::default();
        add_device("vendor.com/harmless=zero", &directories, &mut granted).expect("known");
        assert_eq!(granted.environment["VENDOR"], "here");
        let targets: Vec<_> =
            granted.mounts.iter().map(|mount| (mount.target.to_str().expect("UTF-8"), mount.device)).collect();
        assert_eq!(targets, [("/dev/vendor0", true), ("/usr/share/vendor", false)]);
        assert_eq!(
            granted.unfulfilled,
            ["device vendor.com/harmless=zero: its hook createContainer (/usr/bin/vendor-hook update-ldcache) is \
                    not run; the device may work without it"]
        );
        let mut refused = |name| add_device(name, &directories, &mut granted).expect_err(name).to_string();
        assert!(
            refused("vendor.com/harmless=one")
                .contains("there are: vendor.com/harmless=broken, vendor.com/harmless=zero")
        );
        assert!(refused("vendor.com/harmless=broken").contains("/etc/hostname is not a device node"));
    }

    #[test]
    fn a_later_directory_overrides_an_earlier() {
        let place = tempfile::tempdir().expect("a directory");
        let directories = ["one", "two"].map(|name| place.path().join(name));
        for (directory, value) in directories.iter().zip(["first", "second"]) {
            std::fs::create_dir(directory).expect("made");
            let text = format!(
                r#"{{"cdiVersion":"0.5.0","kind":"v.com/c","devices":[{{"name":"d","containerEdits":{{"env":["A={value}"]}}}}]}}"#
            );
            std::fs::write(directory.join("v.json"), text).expect("written");
        }
        let mut granted = ResolvedGrants::default();
        add_device("v.com/c=d", &directories, &mut granted).expect("known");
        assert_eq!(granted.environment["A"], "second");
    }
}
