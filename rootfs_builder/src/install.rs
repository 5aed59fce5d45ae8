//! Layers of Debian packages: downloaded by the host's apt, installed by dpkg in a container without network.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{Digest, TreeOptions};
use servant::container::{Mount, Profile};

use crate::archive::Archive;
use crate::base::Base;
use crate::bootstrap::{EPOCH, tree_options};
use crate::chain::{Chains, FoundChain, Link, MOST_LINKS};
use crate::complaint::FirstError;
use crate::deb::{self, DebMember, MemberContent};
use crate::debian_package::Deb;
use crate::error::{Error, IoContext};
use crate::event::Progress;
use crate::key::{Key, sha256};
use crate::modes::set_mode;
use crate::sandbox::SandboxRun;
use crate::split;
use crate::steps;
use crate::workshop::{BuildContext, PackJob, StagedLayer};

/// An addition on top of some layers.
pub(crate) struct LayerAddition<'a> {
    /// Short name, for directories and steps.
    pub(crate) name: &'static str,
    /// Layers below, lowest first.
    pub(crate) below: &'a [Digest],
    /// Packages in installation order.
    pub(crate) debs: Vec<Deb>,
    /// Files added without their package.
    pub(crate) extras: Vec<DebMember>,
}

/// Layers, lowest first; may be empty.
#[derive(Debug, Clone, Default)]
pub(crate) struct LayerSet {
    pub(crate) layers: Vec<StagedLayer>,
}

impl LayerSet {
    pub(crate) fn single(diff_id: Digest, cached: bool) -> Self {
        Self { layers: vec![StagedLayer { diff_id, cached }] }
    }

    pub(crate) fn diff_ids(&self) -> impl Iterator<Item = Digest> + '_ {
        self.layers.iter().map(|layer| layer.diff_id)
    }
}

/// Content of a link of a chain, before it is created.
#[derive(Default)]
struct LinkContents {
    debs: Vec<Deb>,
    extras: Vec<DebMember>,
}

impl LinkContents {
    fn items(&self) -> BTreeSet<String> {
        let debs = self.debs.iter().map(Deb::to_string);
        debs.chain(self.extras.iter().map(member_item)).collect()
    }
}

/// Describes a file by everything that matters for its content.
fn member_item(member: &DebMember) -> String {
    let content = match &member.content {
        MemberContent::File(bytes) => format!("file {}", sha256(bytes)),
        MemberContent::Link(target) => format!("link {}", hex::encode(target.as_os_str().as_encoded_bytes())),
    };
    let path = hex::encode(member.path.as_os_str().as_encoded_bytes());
    format!("{path} {:o} {} {content}", member.mode, member.mtime)
}

/// Adds the layers of an addition: those of the best existing chain, and new ones for what it lacks.
pub(crate) async fn add_layers(
    shop: &BuildContext,
    archive: &Archive,
    base: &Base,
    mut addition: LayerAddition<'_>,
    progress: &Progress,
) -> Result<LayerSet, Error> {
    if addition.debs.is_empty() && addition.extras.is_empty() {
        return Ok(LayerSet::default());
    }
    addition.extras.sort_by(|a, b| a.path.cmp(&b.path));
    addition.extras.dedup_by(|later, first| later.path == first.path);
    let whole = LinkContents { debs: std::mem::take(&mut addition.debs), extras: std::mem::take(&mut addition.extras) };
    let items = whole.items();
    let chains = Arc::new(Chains::new(shop.layers.cache(), addition.name, &base.system_key(), addition.below));
    let memo = chains.memo_key(&items);
    let _turn = shop.lock_key(&memo).await;
    // The same set gets the same chain again, even if better ones have been cached since.
    if let Some(keys) = shop.layers.read_note::<Vec<String>>(&memo)
        && let Some(layers) = cached_layers(shop, &keys).await?
    {
        chains.mark_used(&keys);
        return Ok(LayerSet { layers });
    }
    let (asked, wanted) = (chains.clone(), items.clone());
    let candidates = crate::blocking::spawn(move || asked.find_subsets(&wanted)).await?;
    let (mut found, mut made) = (FoundChain::default(), LayerSet::default());
    for candidate in candidates {
        // The remainder takes one or two links.
        let full = candidate.keys.len() == MOST_LINKS && candidate.items != items;
        if full {
            continue;
        }
        if let Some(layers) = cached_layers(shop, &candidate.keys).await? {
            (found, made) = (candidate, LayerSet { layers });
            break;
        }
    }
    let mut keys = found.keys;
    chains.mark_used(&keys);
    let parts = missing_parts(archive, shop, whole, &found.items, MOST_LINKS - keys.len()).await?;
    for part in parts {
        let link = Link { parent: keys.last().cloned(), items: part.items(), bytes: 0 };
        let key = chains.key(link.parent.as_deref(), &link.items);
        let turn = shop.lock_key(&key).await;
        let layer = match cached_layers(shop, std::slice::from_ref(&key)).await? {
            Some(mut layers) => layers.remove(0),
            None => {
                let below: Vec<Digest> = addition.below.iter().copied().chain(made.diff_ids()).collect();
                let (upper, options) =
                    install_part(shop, archive, base, addition.name, &below, &part, progress).await?;
                progress.step(&format!("packing the {}", addition.name)).await;
                let packing = PackJob {
                    key: key.clone(),
                    made_from: link.items.iter().cloned().collect(),
                    directory: upper.parent().unwrap_or(&upper).to_owned(),
                    tree: upper,
                    options,
                    turn,
                };
                let (chains, named) = (chains.clone(), key.clone());
                let record = move |bytes| chains.write_link(&named, &Link { bytes, ..link });
                StagedLayer { diff_id: shop.pack(packing, record).await?, cached: false }
            }
        };
        made.layers.push(layer);
        keys.push(key);
    }
    shop.layers.write_note(&memo, &keys)?;
    Ok(made)
}

/// Returns the layers of these keys, if all of them are in the cache.
async fn cached_layers(shop: &BuildContext, keys: &[String]) -> Result<Option<Vec<StagedLayer>>, Error> {
    let mut layers = Vec::new();
    for key in keys {
        match shop.get_cached(key).await?.and_then(|entry| entry.layer) {
            Some(layer) => layers.push(StagedLayer { diff_id: layer.diff_id, cached: true }),
            None => return Ok(None),
        }
    }
    Ok(Some(layers))
}

/// Returns what a chain lacks, in at most `most` links; see [`split::split`].
async fn missing_parts(
    archive: &Archive,
    shop: &BuildContext,
    whole: LinkContents,
    there: &BTreeSet<String>,
    most: usize,
) -> Result<Vec<LinkContents>, Error> {
    let mut left = whole;
    left.debs.retain(|deb| !there.contains(&deb.to_string()));
    left.extras.retain(|member| !there.contains(&member_item(member)));
    if left.debs.is_empty() && left.extras.is_empty() {
        return Ok(Vec::new());
    }
    let mut parts = Vec::new();
    if most > 1 && split::is_worth_splitting(left.debs.len()) {
        let of_ros = ros_sources(archive, shop).await?;
        let relations = archive.apt.relations(versioned_names(&left.debs)).await?;
        let (first, last) = split::split(&left.debs, &relations, |source| of_ros.contains(source));
        if !first.is_empty() {
            parts.push(LinkContents { debs: first, extras: Vec::new() });
        }
        left.debs = last;
    }
    parts.push(left);
    Ok(parts)
}

/// Returns the names of packages as apt expects them.
fn versioned_names(debs: &[Deb]) -> impl Iterator<Item = String> + '_ {
    debs.iter().map(|deb| format!("{}={}", deb.name, deb.version))
}

/// Returns the source packages that contain ROS packages. Cached, since it queries about a thousand packages.
async fn ros_sources(archive: &Archive, shop: &BuildContext) -> Result<BTreeSet<String>, Error> {
    let note = Key::new("ros-sources").input("archive", &archive.stamp).finish();
    if let Some(sources) = shop.layers.read_note(&note) {
        return Ok(sources);
    }
    let mut carriers = archive.contents.ros_carriers();
    carriers.retain(|name| archive.candidates.contains(name));
    let sources: BTreeSet<String> = if carriers.is_empty() {
        BTreeSet::new()
    } else {
        let relations = archive.apt.relations(carriers).await?;
        relations.into_values().map(|about| about.source).collect()
    };
    shop.layers.write_note(&note, &sources)?;
    Ok(sources)
}

/// Installs a part in a container on top of `below`; returns the container's upper directory, in a separate directory,
/// and the options for packing it.
async fn install_part(
    shop: &BuildContext,
    archive: &Archive,
    base: &Base,
    name: &'static str,
    below: &[Digest],
    part: &LinkContents,
    progress: &Progress,
) -> Result<(PathBuf, TreeOptions), Error> {
    let files = archive.apt.download(&part.debs, progress).await?;
    progress
        .step(&match part.debs.len() {
            0 => format!("adding files of the {name}"),
            count => format!("installing {count} packages of the {name}"),
        })
        .await;
    let directory = shop.site.fresh_directory(name)?;
    let (tools, debs, upper) = (directory.join("tools"), directory.join("debs"), directory.join("upper"));
    fs::create_dir(&debs).io_context("making", &debs)?;
    fs::create_dir(&upper).io_context("making", &upper)?;
    set_mode(&debs, 0o755)?;
    let mut inside = Vec::new();
    for file in &files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        link_or_copy(file, &debs.join(name.as_ref()))?;
        inside.push(format!("/cloudroid/debs/{name}"));
    }
    let relations = archive.apt.relations(versioned_names(&part.debs)).await?;
    let steps = steps::script_files(&steps::plan_steps(&part.debs, &relations), &inside);
    let mut given = BTreeMap::from([
        (PathBuf::from("cloudroid/install.sh"), INSTALL.as_bytes().to_vec()),
        (PathBuf::from("cloudroid/debs/.keep"), Vec::new()),
    ]);
    given.extend(steps.into_iter().map(|(name, text)| {
        let path = Path::new("cloudroid/steps").join(name);
        (path, text.into_bytes())
    }));
    if !part.extras.is_empty() {
        let path = directory.join("extras.tar");
        deb::write_tar(&part.extras, &path)?;
        given.insert("cloudroid/extras.tar".into(), fs::read(&path).io_context("reading", &path)?);
    }
    write_tree(&tools, &given)?;
    // Prevents services from being started by package scripts; this file is in a layer that does not become part of the
    // image.
    let policy = tools.join("usr/sbin/policy-rc.d");
    write_file(&policy, b"#!/bin/sh\nexit 101\n", 0o755)?;

    let mut layers = shop.extract_layers(below).await?;
    layers.push(tools);
    let mut environment = BTreeMap::from([
        ("DEBIAN_FRONTEND".to_owned(), "noninteractive".to_owned()),
        ("SOURCE_DATE_EPOCH".to_owned(), EPOCH.to_string()),
        ("PERL_HASH_SEED".to_owned(), "0".to_owned()),
        ("PYTHONHASHSEED".to_owned(), "0".to_owned()),
        ("LC_ALL".to_owned(), "C.UTF-8".to_owned()),
        ("HOME".to_owned(), "/root".to_owned()),
    ]);
    environment.extend(base.environment.get_key_value("PATH").map(|(key, value)| (key.clone(), value.clone())));
    // Each package is unpacked, and set up later.
    let total = 2 * part.debs.len() as u64;
    let mut done = 0;
    let mut complaint = FirstError::default();
    let finished = shop
        .site
        .run(
            SandboxRun {
                name,
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
                argv: ["/bin/sh", "/cloudroid/install.sh"].map(str::to_owned).into(),
            },
            |line| {
                complaint.push_line(line);
                if line.starts_with("Unpacking ") || line.starts_with("Setting up ") {
                    done = total.min(done + 1);
                    progress.count("packages unpacked or set up", done, Some(total));
                }
            },
        )
        .await?;
    if !finished.success() {
        return Err(Error::InstallFailed { first_error: complaint.text().unwrap_or_else(|| finished.last_output()) });
    }
    let options = TreeOptions { uid_offset: finished.uid_offset, overlay_upper: true, ..tree_options(base) };
    Ok((upper, options))
}

const INSTALL: &str = include_str!("inside/install.sh");

/// Writes a tree of files that everybody can read.
pub(crate) fn write_tree(root: &Path, files: &BTreeMap<PathBuf, Vec<u8>>) -> Result<(), Error> {
    fs::create_dir_all(root).io_context("making", root)?;
    set_mode(root, 0o755)?;
    for (path, bytes) in files {
        write_file(&root.join(path.strip_prefix("/").unwrap_or(path)), bytes, 0o644)?;
    }
    Ok(())
}

fn write_file(path: &Path, bytes: &[u8], mode: u32) -> Result<(), Error> {
    if let Some(parent) = path.parent() {
        let mut new = Vec::new();
        for directory in parent.ancestors().take_while(|directory| !directory.exists()) {
            new.push(directory.to_owned());
        }
        fs::create_dir_all(parent).io_context("making", parent)?;
        for directory in new {
            set_mode(&directory, 0o755)?;
        }
    }
    fs::write(path, bytes).io_context("writing", path)?;
    set_mode(path, mode)
}

pub(crate) fn link_or_copy(from: &Path, to: &Path) -> Result<(), Error> {
    if fs::hard_link(from, to).is_err() {
        fs::copy(from, to).io_context("copying", from)?;
    }
    set_mode(to, 0o644)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn items_tell_everything_that_makes_a_difference() {
        let member = |path: &str, mode, mtime, content| DebMember { path: path.into(), mode, mtime, content };
        let text = |text: &str| MemberContent::File(text.into());
        let deb = |name: &str, version: &str, architecture: &str| LinkContents {
            debs: vec![Deb { name: name.into(), version: version.into(), architecture: architecture.into() }],
            extras: Vec::new(),
        };
        let extra = |member| LinkContents { debs: Vec::new(), extras: vec![member] };
        let parts = [
            deb("a", "1", "amd64"),
            deb("a", "2", "amd64"),
            deb("a", "1", "all"),
            extra(member("usr/share/x", 0o644, 1, text("1"))),
            extra(member("usr/share/y", 0o644, 1, text("1"))),
            extra(member("usr/share/x", 0o755, 1, text("1"))),
            extra(member("usr/share/x", 0o644, 2, text("1"))),
            extra(member("usr/share/x", 0o644, 1, text("2"))),
            extra(member("usr/share/x", 0o644, 1, MemberContent::Link("1".into()))),
            // A file whose name looks like a package.
            extra(member("a=1:amd64", 0o644, 1, text("1"))),
        ];
        let all: BTreeSet<String> = parts.iter().flat_map(LinkContents::items).collect();
        assert_eq!(all.len(), parts.len(), "{all:#?}");
    }

    #[test]
    fn what_the_sandbox_is_given_can_be_read_by_all() {
        let root = tempfile::tempdir().expect("a directory");
        let tree = root.path().join("t");
        write_tree(&tree, &BTreeMap::from([(PathBuf::from("/a/b/c"), b"x".to_vec())])).expect("made");
        let mode = |path: &str| tree.join(path).metadata().expect("there").permissions().mode() & 0o777;
        assert_eq!((mode(""), mode("a"), mode("a/b"), mode("a/b/c")), (0o755, 0o755, 0o755, 0o644));
    }
}
