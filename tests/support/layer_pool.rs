//! Shares layers between the homes of a run by hard links: sixty stories push the same few packages into homes of their
//! own, and unpacking half a gigabyte each time would be most of their work. A push finds the layers in its store, as
//! if the same package had been pushed before; everything else about it is unchanged.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};

use crate::story;
use crate::world::world;

/// Modules whose stories do without the pool, because they are about the creation, storage and removal of layers, or
/// about small disks.
const APART: [&str; 5] = ["bounds::", "images::", "push::", "refusals::", "survival::"];

/// Names of the layers in the pool, by what was pushed.
static KNOWN: Mutex<Option<HashMap<String, HashSet<String>>>> = Mutex::new(None);

/// A push into a home that has no layers yet.
#[derive(Debug)]
pub(crate) struct FirstPush {
    key: String,
    home: PathBuf,
}

impl FirstPush {
    /// Links the known layers of such a push into the home. Returns `None` if the home has layers, or if the story does
    /// without the pool.
    pub(crate) fn begin(home: &Path, arguments: &[&str]) -> Option<FirstPush> {
        let telling = story::current()?;
        let is_apart = APART.iter().any(|module| telling.name.starts_with(module));
        if is_apart || !home.join("layers").exists() || !list_layers(home).is_empty() {
            return None;
        }
        let push = FirstPush { key: find_key(arguments)?, home: home.to_owned() };
        let known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
        let layers = known.as_ref().and_then(|known| known.get(&push.key)).cloned();
        drop(known);
        for layer in layers.into_iter().flatten() {
            link_layer(&pool_directory(), home, &layer);
        }
        Some(push)
    }

    /// Keeps the layers of the home for later pushes of the same package.
    pub(crate) fn keep(self) {
        let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.get_or_insert_default();
        if known.contains_key(&self.key) {
            return;
        }
        let layers = list_layers(&self.home);
        for layer in &layers {
            link_layer(&self.home, &pool_directory(), layer);
        }
        known.insert(self.key, layers);
    }
}

/// Returns the directory of the pool, which is laid out like the stores in a home.
fn pool_directory() -> PathBuf {
    world().place().join("layer-pool")
}

/// Identifies what is pushed, independent of other arguments: the package's directory, or the word after `--apt`.
fn find_key(arguments: &[&str]) -> Option<String> {
    let at = arguments.iter().position(|word| *word == "push")?;
    let apt = arguments.iter().position(|word| *word == "--apt");
    let what = arguments.get(apt.unwrap_or(at) + 1)?;
    let name = Path::new(what).file_name()?;
    Some(name.to_string_lossy().into_owned())
}

/// Returns the names of extracted layers.
fn list_layers(home: &Path) -> HashSet<String> {
    let entries = fs::read_dir(home.join("layers")).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    // The digest of a layer in hexadecimal; a tree that is being written has a longer name.
    let is_layer = |name: &String| name.len() == 64;
    names.filter(is_layer).collect()
}

/// Links a layer's blob, record and tree, in the order in which a store creates them. If anything is missing, the push
/// creates the layer itself.
fn link_layer(from: &Path, to: &Path, layer: &str) {
    let record = format!("layers/{layer}.json");
    let text = fs::read(from.join(&record)).unwrap_or_default();
    let Ok(about) = serde_json::from_slice::<serde_json::Value>(&text) else {
        return;
    };
    let digest = about["digest"].as_str().unwrap_or_default();
    let blob = format!("images/blobs/sha256/{}", digest.trim_start_matches("sha256:"));
    for file in [&blob, &record] {
        let target = to.join(file);
        let _ = target.parent().map(fs::create_dir_all);
        let linked = fs::hard_link(from.join(file), &target);
        if linked.is_err() && !target.exists() {
            return;
        }
    }
    let half = to.join(format!("layers/linking-{layer}"));
    let copied = Command::new("cp").args(["-al", "--"]).arg(from.join("layers").join(layer)).arg(&half).status();
    if copied.is_ok_and(|status| status.success()) {
        let _ = fs::rename(&half, to.join("layers").join(layer));
    }
    let _ = fs::remove_dir_all(&half);
}
