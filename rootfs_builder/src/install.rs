//! Layers of Debian packages: downloaded by the host's apt, installed by dpkg in a container without network.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{Digest, TreeOptions};
use servant::container::{Mount, Profile};

use crate::apt::Deb;
use crate::archive::Archive;
use crate::base::Base;
use crate::bootstrap::{EPOCH, tree_options};
use crate::chain::{Chains, Found, Link, MOST_LINKS};
use crate::complaint::Complaint;
use crate::deb::{self, Content, Member};
use crate::error::{Error, IoAt};
use crate::event::Progress;
use crate::key::{Key, sha256};
use crate::sandbox::Run;
use crate::split;
use crate::steps;
use crate::workshop::{Layer, Packing, Workshop};

/// What is put on top of some layers.
pub(crate) struct Addition<'a> {
    /// Short, for names of directories and steps.
    pub(crate) name: &'static str,
    /// Layers below, lowest first.
    pub(crate) below: &'a [Digest],
    /// Packages in the order of installation.
    pub(crate) debs: Vec<Deb>,
    /// Files added without their package.
    pub(crate) extras: Vec<Member>,
}

/// Layers, lowest first; none where nothing is added.
#[derive(Debug, Clone, Default)]
pub(crate) struct Made {
    pub(crate) layers: Vec<Layer>,
}

impl Made {
    pub(crate) fn one(diff_id: Digest, cached: bool) -> Self {
        Self {
            layers: vec![Layer { diff_id, cached }],
        }
    }

    pub(crate) fn diff_ids(&self) -> impl Iterator<Item = Digest> + '_ {
        self.layers.iter().map(|layer| layer.diff_id)
    }
}

/// One link of a chain, before it is made.
#[derive(Default)]
struct Part {
    debs: Vec<Deb>,
    extras: Vec<Member>,
}

impl Part {
    fn items(&self) -> BTreeSet<String> {
        let debs = self.debs.iter().map(Deb::to_string);
        debs.chain(self.extras.iter().map(item)).collect()
    }
}

/// A file by all that makes a difference.
fn item(member: &Member) -> String {
    let content = match &member.content {
        Content::File(bytes) => format!("file {}", sha256(bytes)),
        Content::Link(target) => format!(
            "link {}",
            hex::encode(target.as_os_str().as_encoded_bytes())
        ),
    };
    let path = hex::encode(member.path.as_os_str().as_encoded_bytes());
    format!("{path} {:o} {} {content}", member.mode, member.mtime)
}

/// The layers of an addition: those of the nearest chain there is, and new ones for what that lacks.
pub(crate) async fn layers(
    shop: &Workshop,
    archive: &Archive,
    base: &Base,
    mut addition: Addition<'_>,
    progress: &Progress,
) -> Result<Made, Error> {
    if addition.debs.is_empty() && addition.extras.is_empty() {
        return Ok(Made::default());
    }
    addition.extras.sort_by(|a, b| a.path.cmp(&b.path));
    addition
        .extras
        .dedup_by(|later, first| later.path == first.path);
    let whole = Part {
        debs: std::mem::take(&mut addition.debs),
        extras: std::mem::take(&mut addition.extras),
    };
    let items = whole.items();
    let chains = Arc::new(Chains::new(
        shop.layers.cache(),
        addition.name,
        &base.system_key(),
        addition.below,
    ));
    let memo = chains.memo(&items);
    let _turn = shop.turn(&memo).await;
    // What was put together before is the same again, whatever has been cached since.
    if let Some(keys) = shop.layers.note::<Vec<String>>(&memo)
        && let Some(layers) = at_hand(shop, &keys).await?
    {
        chains.used(&keys);
        return Ok(Made { layers });
    }
    let (asked, wanted) = (chains.clone(), items.clone());
    let candidates = crate::blocking::spawn(move || asked.within(&wanted)).await?;
    let (mut found, mut made) = (Found::default(), Made::default());
    for candidate in candidates {
        // What is left takes a link or two.
        let full = candidate.keys.len() == MOST_LINKS && candidate.items != items;
        if full {
            continue;
        }
        if let Some(layers) = at_hand(shop, &candidate.keys).await? {
            (found, made) = (candidate, Made { layers });
            break;
        }
    }
    let mut keys = found.keys;
    chains.used(&keys);
    let parts = rest(archive, shop, whole, &found.items, MOST_LINKS - keys.len()).await?;
    for part in parts {
        let link = Link {
            parent: keys.last().cloned(),
            items: part.items(),
            bytes: 0,
        };
        let key = chains.key(link.parent.as_deref(), &link.items);
        let turn = shop.turn(&key).await;
        let layer = match at_hand(shop, std::slice::from_ref(&key)).await? {
            Some(mut layers) => layers.remove(0),
            None => {
                let below: Vec<Digest> = addition
                    .below
                    .iter()
                    .copied()
                    .chain(made.diff_ids())
                    .collect();
                let (upper, options) =
                    install(shop, archive, base, addition.name, &below, &part, progress).await?;
                progress
                    .step(&format!("packing the {}", addition.name))
                    .await;
                let packing = Packing {
                    key: key.clone(),
                    made_from: link.items.iter().cloned().collect(),
                    directory: upper.parent().unwrap_or(&upper).to_owned(),
                    tree: upper,
                    options,
                    turn,
                };
                let (chains, named) = (chains.clone(), key.clone());
                let record = move |bytes| chains.keep(&named, &Link { bytes, ..link });
                Layer {
                    diff_id: shop.pack(packing, record).await?,
                    cached: false,
                }
            }
        };
        made.layers.push(layer);
        keys.push(key);
    }
    shop.layers.keep_note(&memo, &keys)?;
    Ok(made)
}

/// The layers of these keys, if all of them are in the cache.
async fn at_hand(shop: &Workshop, keys: &[String]) -> Result<Option<Vec<Layer>>, Error> {
    let mut layers = Vec::new();
    for key in keys {
        match shop.cached(key).await?.and_then(|entry| entry.layer) {
            Some(layer) => layers.push(Layer {
                diff_id: layer.diff_id,
                cached: true,
            }),
            None => return Ok(None),
        }
    }
    Ok(Some(layers))
}

/// What a chain lacks, in at most `most` links: see [`split::split`].
async fn rest(
    archive: &Archive,
    shop: &Workshop,
    whole: Part,
    there: &BTreeSet<String>,
    most: usize,
) -> Result<Vec<Part>, Error> {
    let mut left = whole;
    left.debs.retain(|deb| !there.contains(&deb.to_string()));
    left.extras.retain(|member| !there.contains(&item(member)));
    if left.debs.is_empty() && left.extras.is_empty() {
        return Ok(Vec::new());
    }
    let mut parts = Vec::new();
    if most > 1 && split::may_cut(left.debs.len()) {
        let of_ros = ros_sources(archive, shop).await?;
        let relations = archive.apt.relations(versions(&left.debs)).await?;
        let (first, last) = split::split(&left.debs, &relations, |source| of_ros.contains(source));
        if !first.is_empty() {
            parts.push(Part {
                debs: first,
                extras: Vec::new(),
            });
        }
        left.debs = last;
    }
    parts.push(left);
    Ok(parts)
}

/// Names of packages as apt takes them.
fn versions(debs: &[Deb]) -> impl Iterator<Item = String> + '_ {
    debs.iter()
        .map(|deb| format!("{}={}", deb.name, deb.version))
}

/// Source packages that hold ROS packages. Remembered: it asks about a thousand packages.
async fn ros_sources(archive: &Archive, shop: &Workshop) -> Result<BTreeSet<String>, Error> {
    let note = Key::new("ros-sources")
        .with("archive", &archive.stamp)
        .finish();
    if let Some(sources) = shop.layers.note(&note) {
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
    shop.layers.keep_note(&note, &sources)?;
    Ok(sources)
}

/// Installs a part in a container on top of `below`; gives the container's upper directory, in a directory of its own, and how
/// it is to be packed.
async fn install(
    shop: &Workshop,
    archive: &Archive,
    base: &Base,
    name: &'static str,
    below: &[Digest],
    part: &Part,
    progress: &Progress,
) -> Result<(PathBuf, TreeOptions), Error> {
    let files = archive.apt.download(&part.debs, progress).await?;
    progress
        .step(&match part.debs.len() {
            0 => format!("adding files of the {name}"),
            count => format!("installing {count} packages of the {name}"),
        })
        .await;
    let directory = shop.site.fresh(name)?;
    let (tools, debs, upper) = (
        directory.join("tools"),
        directory.join("debs"),
        directory.join("upper"),
    );
    fs::create_dir(&debs).at("making", &debs)?;
    fs::create_dir(&upper).at("making", &upper)?;
    set_mode(&debs, 0o755)?;
    let mut inside = Vec::new();
    for file in &files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        link_or_copy(file, &debs.join(name.as_ref()))?;
        inside.push(format!("/cloudroid/debs/{name}"));
    }
    let relations = archive.apt.relations(versions(&part.debs)).await?;
    let steps = steps::written(&steps::steps(&part.debs, &relations), &inside);
    let mut given = BTreeMap::from([
        (
            PathBuf::from("cloudroid/install.sh"),
            INSTALL.as_bytes().to_vec(),
        ),
        (PathBuf::from("cloudroid/debs/.keep"), Vec::new()),
    ]);
    given.extend(steps.into_iter().map(|(name, text)| {
        let path = Path::new("cloudroid/steps").join(name);
        (path, text.into_bytes())
    }));
    if !part.extras.is_empty() {
        let path = directory.join("extras.tar");
        deb::write_tar(&part.extras, &path)?;
        given.insert(
            "cloudroid/extras.tar".into(),
            fs::read(&path).at("reading", &path)?,
        );
    }
    lay_out(&tools, &given)?;
    // Nothing may be started by a package's scripts; the refusal is in a layer that does not become part of it.
    let policy = tools.join("usr/sbin/policy-rc.d");
    write_file(&policy, b"#!/bin/sh\nexit 101\n", 0o755)?;

    let mut layers = shop.extracted(below).await?;
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
    let total = part.debs.len() as u64;
    let mut done = 0;
    let mut complaint = Complaint::default();
    let finished = shop
        .site
        .run(
            Run {
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
    let options = TreeOptions {
        uid_offset: finished.uid_offset,
        overlay_upper: true,
        ..tree_options(base)
    };
    Ok((upper, options))
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

pub(crate) fn link_or_copy(from: &Path, to: &Path) -> Result<(), Error> {
    if fs::hard_link(from, to).is_err() {
        fs::copy(from, to).at("copying", from)?;
    }
    set_mode(to, 0o644)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_tell_everything_that_makes_a_difference() {
        let member = |path: &str, mode, mtime, content| Member {
            path: path.into(),
            mode,
            mtime,
            content,
        };
        let text = |text: &str| Content::File(text.into());
        let deb = |name: &str, version: &str, architecture: &str| Part {
            debs: vec![Deb {
                name: name.into(),
                version: version.into(),
                architecture: architecture.into(),
            }],
            extras: Vec::new(),
        };
        let extra = |member| Part {
            debs: Vec::new(),
            extras: vec![member],
        };
        let parts = [
            deb("a", "1", "amd64"),
            deb("a", "2", "amd64"),
            deb("a", "1", "all"),
            extra(member("usr/share/x", 0o644, 1, text("1"))),
            extra(member("usr/share/y", 0o644, 1, text("1"))),
            extra(member("usr/share/x", 0o755, 1, text("1"))),
            extra(member("usr/share/x", 0o644, 2, text("1"))),
            extra(member("usr/share/x", 0o644, 1, text("2"))),
            extra(member("usr/share/x", 0o644, 1, Content::Link("1".into()))),
            // A file whose name looks like a package.
            extra(member("a=1:amd64", 0o644, 1, text("1"))),
        ];
        let all: BTreeSet<String> = parts.iter().flat_map(Part::items).collect();
        assert_eq!(all.len(), parts.len(), "{all:#?}");
    }

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
