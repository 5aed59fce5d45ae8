//! What this server has of a base: its layers and their contents, as the last build found them, or as another server
//! exported them.
//!
//! ```text
//!   build ──record──▶ stock ──export──▶ archive (image layout, record, package index) ──import──▶ stock, pinned
//! ```
//!
//! Layers of an imported base are used as they are, instead of what the archive has now, until their definition
//! changes. The package index serves while the archive cannot be reached: nothing is downloaded for a package that
//! needs only the base.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use foreign::Tree;
use image::{Digest, ImageSpec, LayerInfo};
use serde::{Deserialize, Serialize};

use crate::apt::Apt;
use crate::archive::Archive;
use crate::base::{self, Base, ImportedImage};
use crate::blocking;
use crate::bootstrap::{self, EPOCH};
use crate::build::Build;
use crate::builder::Builder;
use crate::cache::{LayerCache, LayerEntry, keep_note_key};
use crate::candidates::Candidates;
use crate::contents::Contents;
use crate::error::{Error, IoContext};
use crate::indexed;
use crate::install::LayerSet;
use crate::key::Key;
use crate::workshop::StagedLayer;

/// Annotation of an exported base with the digest of its record.
const RECORD: &str = "org.cloudroid.base";
/// Annotation of an exported base with the digest of its package index.
const INDEX: &str = "org.cloudroid.base.index";
/// Format version of the record.
const FORMAT: u32 = 1;
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

/// An exported base, open at its first byte.
#[derive(Debug)]
pub struct ExportedBase {
    /// Tar archive of an image layout.
    pub file: File,
    /// Size in bytes.
    pub bytes: u64,
}

/// Record in an exported base.
#[derive(Debug, Serialize, Deserialize)]
struct BaseRecord {
    format: u32,
    base: String,
    stock: BaseStock,
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
            let installed = bootstrap::parse_status(&String::from_utf8_lossy(&file.bytes));
            return Ok(installed.into_iter().map(|deb| (deb.name, deb.version)).collect());
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
    let document = roxmltree::Document::parse(&text).ok()?;
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

    /// Writes a base to a file without a name: its layers, with the toolchain if that was set up. Blocking.
    ///
    /// # Errors
    /// [`Error::UnknownBase`], and [`Error::BaseNotSetUp`] if there is nothing to export.
    pub fn export_base(&self, name: &str) -> Result<ExportedBase, Error> {
        let base = base::load(self.bases_dir(), name)?;
        let not_set_up = || Error::BaseNotSetUp { base: name.to_owned() };
        let stock = read_stock(self.layers(), &base).ok_or_else(not_set_up)?;
        let store = self.layers().store();
        let _hold = store.hold()?;
        let layers = stock.all_layers().map(|layer| store.layer(layer)?.ok_or_else(not_set_up));
        let spec = ImageSpec {
            layers: layers.collect::<Result<_, Error>>()?,
            env: base.environment.clone(),
            labels: BTreeMap::from([("org.cloudroid.base".to_owned(), name.to_owned())]),
            annotations: BTreeMap::from([("org.opencontainers.image.title".to_owned(), name.to_owned())]),
            created: EPOCH,
            ..ImageSpec::default()
        };
        let image = store.put_image(&spec)?;
        let record = BaseRecord { format: FORMAT, base: name.to_owned(), stock };
        let mut documents = BTreeMap::from([(RECORD, serde_json::to_vec(&record).unwrap_or_default())]);
        if let Some(index) = self.layers().read_note::<PackageIndex>(&index_key(name)) {
            documents.insert(INDEX, serde_json::to_vec(&index).unwrap_or_default());
        }
        let place = self.build_dir();
        let mut file = tempfile::tempfile_in(place).io_context("creating a file in", place)?;
        store.write_layout(&image, &documents, &file)?;
        let bytes = file.stream_position().io_context("writing a base to", place)?;
        file.seek(SeekFrom::Start(0)).io_context("reading a base from", place)?;
        Ok(ExportedBase { file, bytes })
    }

    /// Imports an exported base from the tree of its archive and pins it; returns its name. All digests are checked.
    /// Blocking.
    ///
    /// # Errors
    /// [`Error::NotABase`] for another file, [`Error::OtherDefinition`] for one of another definition,
    /// [`Error::UnknownBase`], and [`image::Error`] for layers that are damaged or exceed `limits`.
    pub fn import_base(&self, tree: &Path, limits: &image::Limits) -> Result<String, Error> {
        let store = self.layers().store();
        let _hold = store.hold()?;
        let layout = Tree::open(tree)?;
        if !image::is_layout(&layout) {
            return Err(Error::NotABase { problem: "it is no image layout".to_owned() });
        }
        let received = store.receive(&layout, limits)?;
        let document = |annotation: &str| match received.annotations.get(annotation) {
            Some(digest) => Ok::<_, Error>(Some(image::read_layout_document(&layout, &digest.parse()?)?)),
            None => Ok(None),
        };
        let (record, index) = privilege::run_as_reader(|| {
            let record = document(RECORD)?.map(|bytes| serde_json::from_slice::<BaseRecord>(&bytes));
            let index = document(INDEX)?.map(|bytes| serde_json::from_slice::<PackageIndex>(&bytes));
            Ok::<_, Error>((record, index))
        })?;
        let unreadable = |error: serde_json::Error| Error::NotABase { problem: format!("its record: {error}") };
        let Some(record) = record.transpose().map_err(unreadable)? else {
            return Err(Error::NotABase { problem: "it has no record of a base".to_owned() });
        };
        if record.format != FORMAT {
            let problem = format!("its record has format {}; supported is {FORMAT}", record.format);
            return Err(Error::NotABase { problem });
        }
        let base = base::load(self.bases_dir(), &record.base)?;
        if record.stock.made_for != definition_key(&base) {
            return Err(Error::OtherDefinition { base: record.base });
        }
        let layers: &[LayerInfo] = &received.image.spec.layers;
        let found = layers.iter().map(|layer| layer.diff_id);
        if record.stock.layers.is_empty() || !found.eq(record.stock.all_layers().copied()) {
            return Err(Error::NotABase { problem: "its layers are not those of its record".to_owned() });
        }
        for layer in layers {
            let entry = LayerEntry { layer: Some(*layer), made_from: vec![format!("exported base {}", base.name)] };
            self.layers().insert(&imported_layer_key(&layer.diff_id), &entry)?;
        }
        if let Some(index) = index.transpose().map_err(unreadable)? {
            self.layers().write_note(&index_key(&base.name), &index)?;
        }
        let stock = BaseStock { is_imported: true, ..record.stock };
        // Otherwise the garbage collector removes the layers, which are then imported from the cache again.
        self.layers().write_note(&keep_note_key(&base.name), &stock.all_layers().collect::<Vec<_>>())?;
        self.layers().write_note(&stock_key(&base.name), &stock)?;
        Ok(base.name)
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

#[cfg(test)]
mod tests {
    use std::fs;

    use image::{Limits, TreeOptions};

    use super::*;
    use crate::base::DEFAULT_BASE;
    use crate::builder::tests::new_builder;

    /// Records a base of two layers, of which the upper one is the toolchain.
    fn set_up(builder: &Builder, place: &Path) -> BaseStock {
        let base = base::load(builder.bases_dir(), DEFAULT_BASE).expect("valid");
        let layer = |name: &str| {
            let tree = place.join(format!("tree-{name}"));
            fs::create_dir_all(&tree).expect("made");
            fs::write(tree.join(name), name).expect("written");
            let layer = builder.layers().store().layer_from_tree(&tree, &TreeOptions::default());
            layer.expect("a layer").diff_id
        };
        let versions = |name: &str| BTreeMap::from([(name.to_owned(), "1.2".to_owned())]);
        let stock = BaseStock {
            made_for: definition_key(&base),
            lists: "today".to_owned(),
            layers: vec![layer("base")],
            toolchain: vec![layer("tools")],
            compiles: false,
            debian: versions("python3-rospy"),
            python: BTreeMap::new(),
            ros: versions("rospy"),
            is_imported: false,
        };
        let index = PackageIndex {
            contents: "rtf\tlibtf-dev\tx\nlliba.so.1\tliba1".to_owned(),
            candidates: "libtf-dev 1.13 amd64\n".to_owned(),
        };
        builder.layers().write_note(&stock_key(DEFAULT_BASE), &stock).expect("written");
        builder.layers().write_note(&index_key(DEFAULT_BASE), &index).expect("written");
        stock
    }

    /// Unpacks an exported base.
    fn unpack(exported: ExportedBase, to: PathBuf) -> PathBuf {
        let mut file = exported.file;
        assert_eq!(file.metadata().expect("a file").len(), exported.bytes);
        image::unpack(&mut file, &to, &Limits::default()).expect("a tar archive");
        to
    }

    #[test]
    fn an_exported_base_is_what_another_server_uses() {
        let place = tempfile::tempdir().expect("a directory");
        let (one, other) = (place.path().join("one"), place.path().join("other"));
        for path in [&one, &other] {
            fs::create_dir(path).expect("made");
        }
        let (one, other, homes) = (new_builder(&one), new_builder(&other), (one, other));
        let stock = set_up(&one, &homes.0);
        let report = one.base(DEFAULT_BASE).expect("valid");
        assert!(report.bytes > 0 && report.stock.as_ref() == Some(&stock), "{report:?}");
        let base = report.base;
        assert_eq!(other.base(DEFAULT_BASE).expect("valid").stock, None);
        assert!(find_imported(one.layers(), &base).expect("read").is_none(), "it may be set up anew");

        let exported = one.export_base(DEFAULT_BASE).expect("written");
        let tree = unpack(exported, place.path().join("unpacked"));
        assert_eq!(other.import_base(&tree, &Limits::default()).expect("valid"), DEFAULT_BASE);
        let imported = find_imported(other.layers(), &base).expect("read").expect("imported");
        assert_eq!(imported, BaseStock { is_imported: true, ..stock.clone() });
        let tools = imported.tool_layers().expect("a toolchain");
        assert_eq!(tools, [&stock.layers[..], &stock.toolchain[..]].concat());
        let kept = other.layers_to_keep();
        assert!(tools.iter().all(|layer| kept.contains(layer)), "{kept:?}");
        let archive = open_index(other.layers(), &base).expect("read").expect("an index");
        assert!(archive.candidates.contains("libtf-dev") && !archive.contents.ros_package("tf").is_empty());
        assert_eq!(archive.contents.library("liba.so.1"), Some("liba1"));

        let refused = one.forget_base(DEFAULT_BASE).expect_err("it is its own");
        assert!(matches!(refused, Error::BaseNotImported { .. }), "{refused}");

        // A changed definition has nothing of it.
        let mut changed = base.clone();
        changed.definition.runtime.packages.push("python3-six".to_owned());
        assert!(find_imported(other.layers(), &changed).expect("read").is_none());
        assert!(open_index(other.layers(), &changed).expect("read").is_none());
        other.forget_base(DEFAULT_BASE).expect("it was imported");
        assert!(find_imported(other.layers(), &base).expect("read").is_none());
        assert!(other.layers_to_keep().is_empty());
    }

    #[test]
    fn what_is_no_base_of_this_server_is_refused() {
        let place = tempfile::tempdir().expect("a directory");
        let builder = new_builder(place.path());
        let stock = set_up(&builder, place.path());
        let refused = builder.export_base("bookworm-jazzy-wheels").expect_err("not set up");
        assert!(matches!(refused, Error::BaseNotSetUp { .. }), "{refused}");
        let refused = builder.export_base("../images").expect_err("no name");
        assert!(matches!(refused, Error::UnknownBase { .. }), "{refused}");

        let import = |name: &str, documents: &BTreeMap<&str, Vec<u8>>, layers: usize| {
            let store = builder.layers().store();
            let infos = stock.all_layers().take(layers).map(|layer| store.layer(layer).expect("read").expect("there"));
            let spec = ImageSpec { layers: infos.collect(), ..ImageSpec::default() };
            let image = store.put_image(&spec).expect("an image");
            let file = tempfile::tempfile().expect("a file");
            store.write_layout(&image, documents, &file).expect("written");
            let bytes = file.metadata().expect("a file").len();
            (&file).seek(SeekFrom::Start(0)).expect("a file");
            let tree = unpack(ExportedBase { file, bytes }, place.path().join(name));
            builder.import_base(&tree, &Limits::default()).expect_err(name).to_string()
        };
        let record = |format: u32, made_for: &str| {
            let stock = BaseStock { made_for: made_for.to_owned(), ..stock.clone() };
            let record = BaseRecord { format, base: DEFAULT_BASE.to_owned(), stock };
            BTreeMap::from([(RECORD, serde_json::to_vec(&record).expect("plain data"))])
        };
        let own = &stock.made_for;
        for (name, documents, layers, expected) in [
            ("service", BTreeMap::new(), 2, "no record of a base"),
            ("garbage", BTreeMap::from([(RECORD, b"{}".to_vec())]), 2, "its record: missing field"),
            ("format", record(FORMAT + 1, own), 2, "format 2; supported is 1"),
            ("other", record(FORMAT, "else"), 2, "another definition of base bookworm-ros1"),
            ("short", record(FORMAT, own), 1, "its layers are not those of its record"),
        ] {
            let refused = import(name, &documents, layers);
            assert!(refused.contains(expected), "{name}: {refused}");
        }
        fs::create_dir(place.path().join("empty")).expect("made");
        let refused = builder.import_base(&place.path().join("empty"), &Limits::default()).expect_err("nothing");
        assert!(refused.to_string().contains("no image layout"), "{refused}");
        assert_eq!(read_stock(builder.layers(), &builder.base(DEFAULT_BASE).expect("valid").base), Some(stock));
    }
}
