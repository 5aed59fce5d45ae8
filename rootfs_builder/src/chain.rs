//! Layers of packages that stand on one another, and which of them a new set of packages can be put on.
//!
//! ```text
//!    base ◀── link {a, b} ◀── link {c}          for {a, b, c, d}: the chain {a, b} {c}, and a new link {d} on it;
//!                        ╰─── link {e}          for {a, b, d}:    the chain {a, b}, and a new link {d} on it
//! ```
//!
//! A link's key is made of what it stands on (the key of the link below it, or the layers below the whole chain) and
//! of exactly what it adds, so that one name never means two contents. Its record tells both and is believed only
//! where it gives the key that it is named by.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use image::Digest;
use serde::{Deserialize, Serialize};

use crate::cache::write_whole;
use crate::error::{Error, IoAt};
use crate::key::Key;
use crate::unused;

/// The most links that are put on each other: what an image has besides its base and package layers. Registries and
/// the kernel allow more, but each costs every lookup of a file a little.
pub(crate) const MOST_LINKS: usize = 8;

/// One layer of a chain.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Link {
    /// Key of the link below; none for the first.
    pub(crate) parent: Option<String>,
    /// What it adds: packages at versions, and single files.
    pub(crate) items: BTreeSet<String>,
    /// Bytes of the layer: what reusing it saves.
    pub(crate) bytes: u64,
}

/// All chains on the same layers below.
pub(crate) struct Chains {
    directory: PathBuf,
    /// What all keys begin with.
    ground: String,
}

impl Chains {
    /// Chains of `kind` in a cache, on these layers below, in a system of this key.
    pub(crate) fn new(cache: &Path, kind: &str, system: &str, below: &[Digest]) -> Self {
        let ground = Key::new("install")
            .with("kind", kind)
            .with("system", system)
            .with_all("below", below.iter().map(Digest::to_string))
            .finish();
        Self {
            directory: cache.join("chains").join(&ground),
            ground,
        }
    }

    /// The key of a link.
    pub(crate) fn key(&self, parent: Option<&str>, items: &BTreeSet<String>) -> String {
        Key::new("link")
            .with("ground", &self.ground)
            .with("parent", parent.unwrap_or_default())
            .with_all("item", items)
            .finish()
    }

    /// Where it is remembered which chain a whole set got.
    pub(crate) fn memo(&self, items: &BTreeSet<String>) -> String {
        Key::new("chain")
            .with("ground", &self.ground)
            .with_all("item", items)
            .finish()
    }

    /// Records a link whose layer is in the cache. Blocking.
    pub(crate) fn keep(&self, key: &str, link: &Link) -> Result<(), Error> {
        fs::create_dir_all(&self.directory).at("making", &self.directory)?;
        let text = serde_json::to_vec(link).unwrap_or_default();
        write_whole(&self.directory.join(format!("{key}.json")), &text)
    }

    /// Notes that these links are in use.
    pub(crate) fn used(&self, keys: &[String]) {
        for key in keys {
            unused::used(&self.directory.join(format!("{key}.json")));
        }
    }

    /// All links there are, by key. Records that are damaged or do not fit their name count as absent.
    fn links(&self) -> BTreeMap<String, Link> {
        let mut links = BTreeMap::new();
        for entry in fs::read_dir(&self.directory)
            .into_iter()
            .flatten()
            .flatten()
        {
            let name = entry.file_name();
            let Some(key) = name.to_str().and_then(|name| name.strip_suffix(".json")) else {
                continue;
            };
            let Ok(text) = fs::read(entry.path()) else {
                continue;
            };
            match serde_json::from_slice::<Link>(&text) {
                Ok(link) if self.key(link.parent.as_deref(), &link.items) == key => {
                    links.insert(key.to_owned(), link);
                }
                _ => {
                    tracing::warn!(path = %entry.path().display(), "a record of a cached layer is damaged and not used");
                }
            }
        }
        links
    }

    /// Chains all of whose items are among `wanted`, as keys, lowest first: those with the most bytes first, then the
    /// shorter ones. Blocking.
    pub(crate) fn within(&self, wanted: &BTreeSet<String>) -> Vec<Found> {
        let links = self.links();
        let fits: BTreeMap<&String, &Link> = links
            .iter()
            .filter(|(_, link)| link.items.is_subset(wanted))
            .collect();
        let mut found: Vec<Found> = fits.keys().filter_map(|tip| chain(&fits, tip)).collect();
        found.sort_by(|a, b| {
            (b.bytes, a.keys.len(), &a.keys).cmp(&(a.bytes, b.keys.len(), &b.keys))
        });
        found
    }
}

/// A chain.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Found {
    /// Keys of its links, lowest first.
    pub(crate) keys: Vec<String>,
    /// All that it holds.
    pub(crate) items: BTreeSet<String>,
    /// Bytes of its layers.
    pub(crate) bytes: u64,
}

/// The chain that ends in `tip`, if all of it is there and it is no longer than chains may be.
fn chain(links: &BTreeMap<&String, &Link>, tip: &str) -> Option<Found> {
    let mut found = Found::default();
    let mut next = Some(tip.to_owned());
    while let Some(key) = next {
        let link = links.get(&key)?;
        if found.keys.len() >= MOST_LINKS {
            return None;
        }
        found.items.extend(link.items.iter().cloned());
        found.bytes += link.bytes;
        next = link.parent.clone();
        found.keys.insert(0, key);
    }
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(items: &[&str]) -> BTreeSet<String> {
        items.iter().map(|&item| item.to_owned()).collect()
    }

    struct Lab {
        directory: tempfile::TempDir,
        chains: Chains,
    }

    fn lab() -> Lab {
        let directory = tempfile::tempdir().expect("a directory");
        let chains = Chains::new(directory.path(), "dependencies", "system", &[]);
        Lab { directory, chains }
    }

    impl Lab {
        fn add(&self, parent: Option<&str>, items: &[&str], bytes: u64) -> String {
            let link = Link {
                parent: parent.map(str::to_owned),
                items: set(items),
                bytes,
            };
            let key = self.chains.key(parent, &link.items);
            self.chains.keep(&key, &link).expect("kept");
            key
        }

        fn best(&self, wanted: &[&str]) -> Vec<String> {
            let found = self.chains.within(&set(wanted)).into_iter().next();
            found.map(|found| found.keys).unwrap_or_default()
        }
    }

    #[test]
    fn the_largest_set_that_holds_nothing_else_is_taken() {
        let lab = lab();
        let ab = lab.add(None, &["a", "b"], 100);
        let abc = lab.add(Some(&ab), &["c"], 1);
        lab.add(Some(&ab), &["e"], 50);
        assert_eq!(lab.best(&["a", "b", "c", "d"]), [ab.clone(), abc]);
        assert_eq!(lab.best(&["a", "b", "d"]), [ab]);
        // Something in every chain is not wanted.
        assert!(lab.best(&["b", "c", "d"]).is_empty());
        assert!(lab.best(&[]).is_empty());
    }

    #[test]
    fn keys_hold_all_that_a_link_stands_on() {
        let lab = lab();
        let (first, second) = (lab.add(None, &["a"], 1), lab.add(None, &["b"], 1));
        let of = |parent: Option<&str>| lab.chains.key(parent, &set(&["c"]));
        assert_ne!(of(Some(&first)), of(Some(&second)));
        assert_ne!(of(Some(&first)), of(None));
        let root = lab.directory.path();
        for other in [
            Chains::new(root, "dependencies", "another system", &[]),
            Chains::new(root, "build-dependencies", "system", &[]),
            Chains::new(
                root,
                "dependencies",
                "system",
                &[Digest::of("another base")],
            ),
        ] {
            assert_ne!(other.key(None, &set(&["c"])), of(None));
            assert!(other.within(&set(&["a", "b"])).is_empty());
        }
        assert_ne!(
            lab.chains.key(None, &set(&["ab"])),
            lab.chains.key(None, &set(&["a", "b"]))
        );
    }

    #[test]
    fn records_that_do_not_fit_their_name_are_not_believed() {
        let lab = lab();
        let key = lab.add(None, &["a", "evil"], 1000);
        let path = lab.chains.directory.join(format!("{key}.json"));
        for text in [
            // Made to look as if it were a layer of `a` alone.
            r#"{"parent":null,"items":["a"],"bytes":1000}"#,
            "{\"parent\":null,\"items\":[\"a\"",
            "",
        ] {
            fs::write(&path, text).expect("written");
            assert!(lab.best(&["a"]).is_empty(), "{text}");
        }
        fs::write(lab.chains.directory.join("notes.txt"), "x").expect("written");
        let good = lab.add(None, &["a"], 1);
        assert_eq!(lab.best(&["a"]), [good]);
    }

    #[test]
    fn a_chain_with_a_missing_link_or_too_many_is_left() {
        let lab = lab();
        let orphan = lab.add(Some("0123"), &["a"], 1000);
        assert!(lab.best(&["a"]).is_empty(), "{orphan} has nothing below it");
        let names: Vec<String> = (0..MOST_LINKS + 1).map(|n| format!("p{n}")).collect();
        let mut keys: Vec<String> = Vec::new();
        for name in &names {
            keys.push(lab.add(keys.last().map(String::as_str), &[name], 1));
        }
        let all: Vec<&str> = names.iter().map(String::as_str).collect();
        assert_eq!(lab.best(&all), keys[..MOST_LINKS]);
    }
}
