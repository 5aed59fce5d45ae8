//! A base as a file: exported by one server, and imported, with its toolchain, by others.
//!
//! ```text
//!   stock ──export──▶ archive (image layout, record, package index) ──import──▶ stock of another server, pinned
//! ```

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Seek, SeekFrom};
use std::path::Path;

use foreign::Tree;
use image::{ImageSpec, LayerInfo};
use serde::{Deserialize, Serialize};

use super::{BaseStock, PackageIndex, definition_key, imported_layer_key, index_key, read_stock, stock_key};
use crate::base;
use crate::bootstrap::EPOCH;
use crate::builder::Builder;
use crate::cache::{LayerEntry, keep_note_key};
use crate::error::{Error, IoContext};

/// Annotation of an exported base with the digest of its record.
const RECORD: &str = "org.cloudroid.base";
/// Annotation of an exported base with the digest of its package index.
const INDEX: &str = "org.cloudroid.base.index";
/// Format version of the record.
const FORMAT: u32 = 1;
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

impl Builder {
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
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;

    use image::{Limits, TreeOptions};

    use super::*;
    use crate::base::DEFAULT_BASE;
    use crate::builder::tests::new_builder;
    use crate::stock::{find_imported, open_index};

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
