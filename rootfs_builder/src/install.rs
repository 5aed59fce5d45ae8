//! Layers of Debian packages: downloaded by the host's apt, installed by dpkg in a container without network.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use image::{LayerInfo, TreeOptions};
use servant::spec::{Mount, Profile};

use crate::apt::Deb;
use crate::archive::Archive;
use crate::base::Base;
use crate::bootstrap::{EPOCH, tree_options};
use crate::cache::Entry;
use crate::complaint::Complaint;
use crate::deb::{self, Content, Member};
use crate::error::{Error, IoAt};
use crate::event::Progress;
use crate::key::Key;
use crate::sandbox::Run;
use crate::workshop::Workshop;

/// What is put on top of some layers.
pub(crate) struct Addition<'a> {
    /// Short, for names of directories and steps.
    pub(crate) name: &'static str,
    /// Layers below, lowest first.
    pub(crate) below: &'a [LayerInfo],
    /// Packages in the order of installation.
    pub(crate) debs: Vec<Deb>,
    /// Files added without their package.
    pub(crate) extras: Vec<Member>,
}

/// A layer, and whether it was there already.
pub(crate) struct Made {
    pub(crate) layer: Option<LayerInfo>,
    pub(crate) cached: bool,
}

impl Addition<'_> {
    fn key(&self, base: &Base) -> String {
        let mut names: Vec<String> = self.debs.iter().map(Deb::to_string).collect();
        names.sort();
        let mut key = Key::new("install")
            .with("system", base.system_key())
            .with_all(
                "below",
                self.below.iter().map(|layer| layer.diff_id.to_string()),
            )
            .with_all("deb", names);
        for member in &self.extras {
            key = key.with("extra", member.path.as_os_str().as_encoded_bytes());
            key = match &member.content {
                Content::File(bytes) => key.with("file", bytes),
                Content::Link(target) => key.with("link", target.as_os_str().as_encoded_bytes()),
            };
        }
        key.finish()
    }
}

/// The layer of an addition: from the cache, or made now.
pub(crate) async fn layer(
    shop: &Workshop,
    archive: &Archive,
    base: &Base,
    mut addition: Addition<'_>,
    progress: &Progress,
) -> Result<Made, Error> {
    if addition.debs.is_empty() && addition.extras.is_empty() {
        return Ok(Made {
            layer: None,
            cached: true,
        });
    }
    addition.extras.sort_by(|a, b| a.path.cmp(&b.path));
    let key = addition.key(base);
    let _turn = shop.turns.take(&key).await;
    if let Some(entry) = shop.cached(&key).await? {
        return Ok(Made {
            layer: entry.layer,
            cached: true,
        });
    }
    let layer = make(shop, archive, base, &addition, progress).await?;
    let made_from = addition.debs.iter().map(Deb::to_string).collect();
    shop.keep(
        &key,
        Entry {
            layer: Some(layer),
            made_from,
        },
    )
    .await?;
    Ok(Made {
        layer: Some(layer),
        cached: false,
    })
}

async fn make(
    shop: &Workshop,
    archive: &Archive,
    base: &Base,
    addition: &Addition<'_>,
    progress: &Progress,
) -> Result<LayerInfo, Error> {
    let files = archive.apt.download(&addition.debs, progress).await?;
    progress
        .step(&match addition.debs.len() {
            0 => format!("adding files of the {}", addition.name),
            count => format!("installing {count} packages of the {}", addition.name),
        })
        .await;
    let room = shop.site.fresh(addition.name)?;
    let (tools, debs, upper) = (room.join("tools"), room.join("debs"), room.join("upper"));
    fs::create_dir(&debs).at("making", &debs)?;
    fs::create_dir(&upper).at("making", &upper)?;
    set_mode(&debs, 0o755)?;
    let mut order = String::new();
    for file in &files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        link_or_copy(file, &debs.join(name.as_ref()))?;
        order.push_str(&format!("/cloudroid/debs/{name}\n"));
    }
    let mut given = BTreeMap::from([
        (
            PathBuf::from("cloudroid/install.sh"),
            INSTALL.as_bytes().to_vec(),
        ),
        (PathBuf::from("cloudroid/order"), order.into_bytes()),
        (PathBuf::from("cloudroid/debs/.keep"), Vec::new()),
    ]);
    if !addition.extras.is_empty() {
        let path = room.join("extras.tar");
        deb::write_tar(&addition.extras, &path)?;
        given.insert(
            "cloudroid/extras.tar".into(),
            fs::read(&path).at("reading", &path)?,
        );
    }
    lay_out(&tools, &given)?;
    // Nothing may be started by a package's scripts; the refusal is in a layer that does not become part of it.
    let policy = tools.join("usr/sbin/policy-rc.d");
    write_file(&policy, b"#!/bin/sh\nexit 101\n", 0o755)?;

    let mut layers = shop.extracted(addition.below).await?;
    layers.push(tools);
    let mut environment = BTreeMap::from([
        ("DEBIAN_FRONTEND".to_owned(), "noninteractive".to_owned()),
        ("SOURCE_DATE_EPOCH".to_owned(), EPOCH.to_string()),
        ("PERL_HASH_SEED".to_owned(), "0".to_owned()),
        ("PYTHONHASHSEED".to_owned(), "0".to_owned()),
        ("LC_ALL".to_owned(), "C.UTF-8".to_owned()),
        ("HOME".to_owned(), "/root".to_owned()),
    ]);
    environment.extend(
        base.environment
            .get_key_value("PATH")
            .map(|(key, value)| (key.clone(), value.clone())),
    );
    let total = addition.debs.len() as u64;
    let mut done = 0;
    let mut complaint = Complaint::default();
    let finished = shop
        .site
        .run(
            Run {
                name: addition.name,
                profile: Profile::Install,
                layers,
                writable: Some(upper.clone()),
                owned: Vec::new(),
                mounts: vec![Mount {
                    source: debs,
                    target: "/cloudroid/debs".into(),
                    writable: false,
                    device: false,
                    opened: None,
                }],
                environment,
                argv: ["/bin/sh", "/cloudroid/install.sh"]
                    .map(str::to_owned)
                    .into(),
            },
            |line| {
                complaint.hear(line);
                if line.starts_with("Setting up ") {
                    done += 1;
                    progress.count("packages", done, Some(total));
                }
            },
        )
        .await?;
    if !finished.success() {
        return Err(Error::InstallFailed {
            first_error: complaint.text().unwrap_or_else(|| finished.last_words()),
        });
    }
    progress
        .step(&format!("packing the {}", addition.name))
        .await;
    let store = shop.layers.store().clone();
    let options = TreeOptions {
        uid_offset: finished.uid_offset,
        overlay_upper: true,
        ..tree_options(base)
    };
    let layer = crate::blocking::spawn(move || -> Result<_, Error> {
        let layer = store.layer_from_tree(&upper, &options)?;
        foreign::remove(&room)?;
        Ok(layer)
    })
    .await??;
    Ok(layer)
}

const INSTALL: &str = include_str!("inside/install.sh");

/// Makes a tree of files that everybody may read.
pub(crate) fn lay_out(root: &Path, files: &BTreeMap<PathBuf, Vec<u8>>) -> Result<(), Error> {
    fs::create_dir_all(root).at("making", root)?;
    set_mode(root, 0o755)?;
    for (path, bytes) in files {
        write_file(
            &root.join(path.strip_prefix("/").unwrap_or(path)),
            bytes,
            0o644,
        )?;
    }
    Ok(())
}

fn write_file(path: &Path, bytes: &[u8], mode: u32) -> Result<(), Error> {
    if let Some(parent) = path.parent() {
        let mut new = Vec::new();
        for directory in parent
            .ancestors()
            .take_while(|directory| !directory.exists())
        {
            new.push(directory.to_owned());
        }
        fs::create_dir_all(parent).at("making", parent)?;
        for directory in new {
            set_mode(&directory, 0o755)?;
        }
    }
    fs::write(path, bytes).at("writing", path)?;
    set_mode(path, mode)
}

/// Whatever the umask.
pub(crate) fn set_mode(path: &Path, mode: u32) -> Result<(), Error> {
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).at("changing the mode of", path)
}

fn link_or_copy(from: &Path, to: &Path) -> Result<(), Error> {
    if fs::hard_link(from, to).is_err() {
        fs::copy(from, to).at("copying", from)?;
    }
    set_mode(to, 0o644)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_sandbox_is_given_can_be_read_by_all() {
        let root = tempfile::tempdir().expect("a directory");
        let tree = root.path().join("t");
        lay_out(
            &tree,
            &BTreeMap::from([(PathBuf::from("/a/b/c"), b"x".to_vec())]),
        )
        .expect("made");
        let mode = |path: &str| {
            tree.join(path)
                .metadata()
                .expect("there")
                .permissions()
                .mode()
                & 0o777
        };
        assert_eq!(
            (mode(""), mode("a"), mode("a/b"), mode("a/b/c")),
            (0o755, 0o755, 0o755, 0o644)
        );
    }
}
