//! Stock of a base on this server: its layers and their contents, as the last build found them, or as another server
//! exported them.
//!
//! Layers of an imported base are used as they are, instead of what the archive has now, until their definition
//! changes. The package index serves while the archive cannot be reached: nothing is downloaded for a package that
//! needs only the base.

mod exchange;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use foreign::Tree;
use image::Digest;
use package::system::parse_status;
use serde::{Deserialize, Serialize};

use crate::apt::Apt;
use crate::archive::Archive;
use crate::base::{self, Base, ImportedImage};
use crate::blocking;
use crate::build::Build;
use crate::builder::Builder;
use crate::cache::{LayerCache, keep_note_key};
use crate::candidates::Candidates;
use crate::contents::Contents;
use crate::error::Error;
use crate::indexed;
use crate::install::LayerSet;
use crate::key::Key;
use crate::workshop::StagedLayer;

pub use exchange::ExportedBase;

/// Status file of dpkg, and its maximum size in bytes.
const STATUS: (&str, u64) = ("var/lib/dpkg/status", 64 << 20);
/// Maximum size of a package.xml in bytes.
const MANIFEST: u64 = 1 << 20;

/// Layers of a base and their contents.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BaseStock {
    /// Hash of what the layers depend on in the definition.
    made_for: String,
    /// Fingerprint of the package lists at that time.
    lists: String,
    /// Layers of every image, lowest first.
    layers: Vec<Digest>,
    /// Layers above them that are present only while compiling; empty until sources were pushed.
    toolchain: Vec<Digest>,
    /// True if the layers of every image have all that sources are compiled with.
    #[serde(default)]
    compiles: bool,
    /// Installed Debian packages with their versions.
    pub debian: BTreeMap<String, String>,
    /// Python packages from wheels with their versions.
    pub python: BTreeMap<String, String>,
    /// ROS packages with their versions.
    pub ros: BTreeMap<String, String>,
    /// True if the layers were imported: exported by another server, or of an image.
    pub is_imported: bool,
}

impl BaseStock {
    /// Returns whether sources can be compiled without setting up the toolchain first.
    pub fn has_toolchain(&self) -> bool {
        self.compiles || !self.toolchain.is_empty()
    }

    /// Returns what an image that became a base has.
    fn from_image(base: &Base, image: &ImportedImage) -> Self {
        Self {
            made_for: definition_key(base),
            lists: String::new(),
            layers: image.layers.clone(),
            toolchain: Vec::new(),
            compiles: image.missing_tools.is_empty(),
            debian: image.debian.clone(),
            python: BTreeMap::new(),
            ros: image.ros.clone(),
            is_imported: true,
        }
    }

    /// Returns the layers of every image, as a part of a build.
    pub(crate) fn layer_set(&self) -> LayerSet {
        LayerSet { layers: self.layers.iter().map(|diff_id| StagedLayer { diff_id: *diff_id, cached: true }).collect() }
    }

    /// Returns all layers in which sources are compiled; `None` if the toolchain is not there.
    pub(crate) fn tool_layers(&self) -> Option<Vec<Digest>> {
        self.has_toolchain().then(|| self.all_layers().copied().collect())
    }

    fn all_layers(&self) -> impl Iterator<Item = &Digest> {
        self.layers.iter().chain(&self.toolchain)
    }
}

/// A base and what this server has of it.
#[derive(Debug, Clone, PartialEq)]
pub struct BaseReport {
    /// Definition.
    pub base: Base,
    /// Layers and contents; `None` if the base was not set up here yet.
    pub stock: Option<BaseStock>,
    /// Compressed size of the layers of every image in bytes; 0 if unknown.
    pub bytes: u64,
}

/// Package index of a base's archive.
#[derive(Debug, Default, Serialize, Deserialize)]
struct PackageIndex {
    contents: String,
    candidates: String,
}

fn stock_key(base: &str) -> String {
    format!("stock-{base}")
}

fn index_key(base: &str) -> String {
    format!("index-{base}")
}

/// Returns the cache key of a layer of an imported base.
fn imported_layer_key(layer: &Digest) -> String {
    Key::new("imported-base").input("layer", layer.to_string()).finish()
}

/// Returns a hash of everything in a definition that its layers depend on.
fn definition_key(base: &Base) -> String {
    Key::new("base-definition")
        .input("system", base.system_key())
        .input("build", base.build_key())
        .input("wheels", serde_json::to_string(&base.wheels).unwrap_or_default())
        .input("runtime", base.required.runtime.key())
        .input("tools", base.required.build.key())
        .finish()
}

/// Returns what was recorded for this definition, regardless of whether the layers still exist.
fn read_stock(layers: &LayerCache, base: &Base) -> Option<BaseStock> {
    if let Some(image) = &base.image {
        return Some(BaseStock::from_image(base, image));
    }
    let stock = layers.read_note::<BaseStock>(&stock_key(&base.name))?;
    (stock.made_for == definition_key(base)).then_some(stock)
}

/// Returns the stock of an imported base whose layers are there. Blocking.
///
/// # Errors
/// [`Error::ImageGone`] if layers of an image are missing, which nothing can set up again.
pub(crate) fn find_imported(layers: &LayerCache, base: &Base) -> Result<Option<BaseStock>, Error> {
    let Some(stock) = read_stock(layers, base).filter(|stock| stock.is_imported) else {
        return Ok(None);
    };
    if let Some(image) = &base.image {
        image.check_layers(layers.store(), &base.name)?;
        return Ok(Some(stock));
    }
    for layer in stock.all_layers() {
        if layers.get(&imported_layer_key(layer))?.is_none() {
            tracing::warn!("layer {layer} of the imported base {} is missing; the base is set up again", base.name);
            return Ok(None);
        }
    }
    Ok(Some(stock))
}

/// Opens the archive of an imported base by its index, without package lists: packages are found, and none can be
/// downloaded. `None` if there is no such base. Blocking.
pub(crate) fn open_index(layers: &LayerCache, base: &Base) -> Result<Option<Archive>, Error> {
    if !read_stock(layers, base).is_some_and(|stock| stock.is_imported) {
        return Ok(None);
    }
    let index = match (layers.read_note::<PackageIndex>(&index_key(&base.name)), &base.image) {
        (Some(index), _) => index,
        // What is installed in it is all that there is.
        (None, Some(_)) => PackageIndex::default(),
        (None, None) => return Ok(None),
    };
    Ok(Some(Archive {
        apt: Apt::open(&layers.cache().join("apt").join("imported"), "")?,
        contents: Arc::new(Contents::from_text(&index.contents)),
        candidates: Candidates::from_lines(&index.candidates),
        stamp: format!("imported {}", crate::key::sha256(index.candidates.as_bytes())),
        sources: String::new(),
    }))
}

/// Records what a build found of its base, unless it is known.
pub(crate) async fn record(build: &Build<'_>) -> Result<(), Error> {
    let layers = build.shop.layers.clone();
    let (base, archive, below) = (build.base.clone(), Arc::clone(&build.archive), build.base_diff_ids());
    let trees = build.shop.extract_layers(&below).await?;
    blocking::spawn(move || {
        let known = read_stock(&layers, &base);
        let tools = layers.read_note::<Vec<Digest>>(&keep_note_key(&base.name)).unwrap_or_default();
        let toolchain = tools.strip_prefix(&below[..]).map(<[Digest]>::to_vec).unwrap_or_default();
        let is_known = |stock: &BaseStock| {
            stock.layers == below && stock.toolchain == toolchain && stock.lists == archive.stamp && !stock.is_imported
        };
        if known.as_ref().is_some_and(is_known) {
            return Ok(());
        }
        let debian = privilege::run_as_reader(|| debian_packages(&trees))?;
        let ros = privilege::run_as_reader(|| ros_packages(&base, &archive, &debian, &trees))?;
        let python = base.required.runtime.versions().filter_map(|wheel| {
            let (name, version) = wheel.split_once("==")?;
            Some((name.to_owned(), version.to_owned()))
        });
        let stock = BaseStock {
            made_for: definition_key(&base),
            lists: archive.stamp.clone(),
            layers: below,
            toolchain,
            compiles: false,
            python: python.collect(),
            debian,
            ros,
            is_imported: false,
        };
        if known.is_none_or(|known| known.lists != stock.lists) {
            let index = PackageIndex {
                contents: archive.contents.as_text(),
                candidates: archive.candidates.as_text().to_owned(),
            };
            layers.write_note(&index_key(&base.name), &index)?;
        }
        layers.write_note(&stock_key(&base.name), &stock)
    })
    .await?
}

/// Returns the installed packages of the lowest layer that has dpkg's status, with their versions.
fn debian_packages(trees: &[PathBuf]) -> Result<BTreeMap<String, String>, Error> {
    for tree in trees {
        if let Some(file) = Tree::open(tree)?.read_file(STATUS.0, STATUS.1)? {
            let text = String::from_utf8_lossy(&file.bytes);
            return Ok(parse_status(&text).map(|deb| (deb.name, deb.version)).collect());
        }
    }
    Ok(BTreeMap::new())
}

/// Returns the ROS packages with their versions: those in installed Debian packages if ROS is the distribution's own,
/// otherwise those in install spaces.
fn ros_packages(
    base: &Base,
    archive: &Archive,
    debian: &BTreeMap<String, String>,
    trees: &[PathBuf],
) -> Result<BTreeMap<String, String>, Error> {
    if base.has_distributions_ros() {
        let carried = archive.contents.ros_packages_by_deb(&debian.keys().map(String::as_str).collect());
        return Ok(carried.into_iter().map(|(package, deb)| (package, debian[&deb].clone())).collect());
    }
    let prefixes = base.install_prefixes();
    let names: BTreeSet<String> = indexed::list_packages(base.ros, trees, &prefixes)?;
    let version = |name: &str| {
        let mut places = prefixes.iter().flat_map(|prefix| trees.iter().map(move |tree| (prefix, tree)));
        places.find_map(|(prefix, tree)| manifest_version(tree, prefix, name)).unwrap_or_default()
    };
    Ok(names.into_iter().map(|name| (name.clone(), version(&name))).collect())
}

/// Returns the version in the package.xml of an installed package; `None` if there is none in this layer.
fn manifest_version(tree: &Path, prefix: &str, name: &str) -> Option<String> {
    let path = format!("{}/share/{name}/package.xml", prefix.trim_matches('/'));
    let file = Tree::open(tree).ok()?.read_file(path, MANIFEST).ok()??;
    let text = String::from_utf8(file.bytes).ok()?;
    let document = package::xml::parse(&text).ok()?;
    let mut parts = document.root_element().children();
    let version = parts.find(|part| part.has_tag_name("version"))?;
    version.text().map(|text| text.trim().to_owned())
}

impl Builder {
    /// Returns all bases and what this server has of them. Blocking.
    pub fn bases(&self) -> Result<Vec<BaseReport>, Error> {
        base::names(self.bases_dir())?.iter().map(|name| self.base(name)).collect()
    }

    /// Returns a base and what this server has of it. Blocking.
    pub fn base(&self, name: &str) -> Result<BaseReport, Error> {
        let base = base::load(self.bases_dir(), name)?;
        let stock = read_stock(self.layers(), &base);
        let mut bytes = 0;
        for layer in stock.iter().flat_map(|stock| &stock.layers) {
            bytes += self.layers().store().layer(layer)?.map_or(0, |layer| layer.size);
        }
        Ok(BaseReport { base, stock, bytes })
    }

    /// Forgets that a base was imported: the next push that uses it sets it up; one that was made from an image is
    /// gone. Blocking.
    ///
    /// # Errors
    /// [`Error::UnknownBase`], and [`Error::BaseNotImported`] if it was set up here or not at all.
    pub fn forget_base(&self, name: &str) -> Result<(), Error> {
        let base = base::load(self.bases_dir(), name)?;
        if self.forget_image(&base)? {
            return Ok(());
        }
        if !read_stock(self.layers(), &base).is_some_and(|stock| stock.is_imported) {
            return Err(Error::BaseNotImported { base: base.name });
        }
        for key in [stock_key(name), index_key(name), keep_note_key(name)] {
            self.layers().remove_note(&key)?;
        }
        Ok(())
    }
}
