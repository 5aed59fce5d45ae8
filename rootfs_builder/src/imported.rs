//! Bases made from an image of a lab, or from a root file system: a definition that is written here, from what was
//! found by looking, and the image's own layers, as they are.
//!
//! ```text
//!   podman save, docker save, skopeo ─▶ layers ─┐
//!   tar of a root file system ──────▶ one layer ┴─▶ find_system ─▶ definition with an [image] ─▶ pushes upon it
//! ```
//!
//! What the image lacks for compiling is installed by the first push of sources, in layers of its own, if the archive
//! of its distribution can be reached.

mod definition;
mod findings;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::PathBuf;

use foreign::Tree;
use image::{Digest, LayerInfo, Limits, write_atomically};
use package::system;

use crate::archive::Archive;
use crate::base::{self, Base, ImportedImage};
use crate::builder::Builder;
use crate::cache::keep_note_key;
use crate::error::{Error, IoContext};

/// Content of an archive that becomes a base, as received.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ImportSource {
    /// Unpacked archive of an image.
    Image(PathBuf),
    /// Tar archive of a root file system: a file.
    Root(PathBuf),
}

/// Request to make a base.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BaseImport {
    /// Name of the base.
    pub name: String,
    /// Content.
    pub source: ImportSource,
    /// True if an imported base of this name is replaced.
    pub replace: bool,
    /// ROS distribution that counts, if it has several.
    pub ros_distribution: Option<String>,
}

impl Archive {
    /// Adds packages that are installed in a base, whether the archive has them or not, to those that can be asked for.
    pub(crate) fn with_installed(mut self, image: &ImportedImage) -> Self {
        let lines = image.debian.iter().map(|(name, version)| crate::debian_package::Deb {
            name: name.clone(),
            version: version.clone(),
            architecture: "installed".to_owned(),
        });
        let known = self.candidates.names().filter_map(|name| self.candidates.get(name));
        // Of several with one name the first counts: that of the archive, which can be downloaded.
        self.candidates = known.chain(lines).collect();
        self
    }
}

impl Builder {
    /// Makes a base from an image or a root file system: finds what it is, and writes its definition. All digests are
    /// checked. Returns its name. Blocking.
    ///
    /// # Errors
    /// [`Error::BaseName`] for a name that cannot be used, [`Error::BaseExists`] for one that is taken,
    /// [`Error::System`] if packages of ROS cannot be built upon it, and [`image::Error`] for layers that are damaged
    /// or exceed `limits`.
    pub fn import_image(&self, import: &BaseImport, limits: &Limits) -> Result<String, Error> {
        let name = import.name.as_str();
        self.check_new_name(name, import.replace)?;
        let store = self.layers().store();
        // Until the definition names the layers.
        let _hold = store.hold()?;
        let received = self.receive_layers(&import.source, limits)?;
        let diff_ids: Vec<Digest> = received.layers.iter().map(|layer| layer.diff_id).collect();
        let trees = diff_ids.iter().map(|layer| store.ensure_extracted(layer)).collect::<Result<Vec<_>, _>>()?;
        let wanted = import.ros_distribution.as_deref();
        let (system, environment) = privilege::run_as_reader(|| {
            let system = system::find_system(&trees, &received.env, wanted)?;
            let environment = system::make_environment(&trees, &system, &received.env)?;
            Ok::<_, system::SystemError>((system, environment))
        })?;
        let debian = system.debian.clone().unwrap_or_default();
        let image = ImportedImage {
            source: received.source,
            layers: diff_ids,
            missing_tools: definition::find_missing_tools(&system),
            installs_python: definition::installs_python(&system),
            findings: findings::list_findings(&system, &received.env, debian.len()),
            debian,
            ros: system.packages(),
        };
        let definition = definition::make_definition(self.bases_dir(), &system, environment, image)?;
        let text = toml::to_string(&definition).map_err(|error| Error::BaseText { base: name.to_owned(), error })?;
        let file = format!("{name}.toml");
        fs::create_dir_all(self.imported_dir()).io_context("making", self.imported_dir())?;
        write_atomically(&self.imported_dir().join(&file), text.as_bytes())?;
        write_atomically(&self.bases_dir().join(&file), text.as_bytes())?;
        // That of the toolchain upon an earlier image.
        self.layers().remove_note(&keep_note_key(name))?;
        Ok(base::load(self.bases_dir(), name)?.name)
    }

    /// Checks that a base of this name can be made. Blocking.
    ///
    /// # Errors
    /// [`Error::BaseName`] and [`Error::BaseExists`].
    pub fn check_new_name(&self, name: &str, replace: bool) -> Result<(), Error> {
        let is_good = !name.is_empty()
            && name.len() <= 64
            && name.as_bytes()[0].is_ascii_alphanumeric()
            && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b));
        if !is_good {
            return Err(Error::BaseName { name: name.to_owned() });
        }
        if !base::names(self.bases_dir())?.iter().any(|known| known == name) {
            return Ok(());
        }
        let is_imported = base::load(self.bases_dir(), name).is_ok_and(|base| base.image.is_some());
        match (is_imported, replace) {
            (true, true) => Ok(()),
            (true, false) => Err(Error::BaseExists { name: name.to_owned(), next: "replace it with --replace" }),
            (false, _) => Err(Error::BaseExists { name: name.to_owned(), next: "choose another name" }),
        }
    }

    fn receive_layers(&self, source: &ImportSource, limits: &Limits) -> Result<ReceivedLayers, Error> {
        let store = self.layers().store();
        match source {
            ImportSource::Image(tree) => {
                let image = store.receive_saved(&Tree::open(tree)?, limits)?;
                let named = if image.name.is_empty() { String::new() } else { format!(" {}", image.name) };
                Ok(ReceivedLayers { layers: image.layers, env: image.env, source: format!("image{named}") })
            }
            ImportSource::Root(path) => {
                let file = File::open(path).io_context("opening", path)?;
                let layer = store.receive_root(file, limits)?;
                let source = "root file system".to_owned();
                Ok(ReceivedLayers { layers: vec![layer], env: BTreeMap::new(), source })
            }
        }
    }

    /// Removes the definition of a base that was made from an image; returns false if it was not. Blocking.
    pub(crate) fn forget_image(&self, base: &Base) -> Result<bool, Error> {
        if base.image.is_none() {
            return Ok(false);
        }
        // First the one that the next start reads.
        for directory in [self.imported_dir(), self.bases_dir()] {
            let path = directory.join(format!("{}.toml", base.name));
            match fs::remove_file(&path) {
                Err(error) if error.kind() != ErrorKind::NotFound => return Err(Error::io("removing", path, error)),
                _ => {}
            }
        }
        self.layers().remove_note(&keep_note_key(&base.name))?;
        Ok(true)
    }
}

/// Layers in the store, and what is known of them.
struct ReceivedLayers {
    layers: Vec<LayerInfo>,
    env: BTreeMap<String, String>,
    source: String,
}

#[cfg(test)]
mod tests;
