//! Chains of package layers, and the search for a chain that a new set of packages can extend.
//!
//! ```text
//!    base ◀── link {a, b} ◀── link {c}          for {a, b, c, d}: the chain {a, b} {c}, and a new link {d} on it;
//!                        ╰─── link {e}          for {a, b, d}:    the chain {a, b}, and a new link {d} on it
//! ```
//!
//! The key of a link is computed from what is below it (the key of the link below, or the layers below the whole chain)
//! and from exactly what it adds, so that a name never has two meanings. Its record contains both and is trusted only
//! if it yields the key that it is stored under.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use image::Digest;
use serde::{Deserialize, Serialize};

use crate::cache::write_atomically;
use crate::cache_cleanup;
use crate::error::{Error, IoContext};
use crate::key::Key;

/// Maximum number of links in a chain, in addition to the base and package layers of an image. Registries and the
/// kernel allow more, but each link slows down file lookups a little.
pub(crate) const MOST_LINKS: usize = 8;

/// A layer in a chain.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Link {
    /// Key of the link below; `None` for the first.
    pub(crate) parent: Option<String>,
    /// Items that it adds: packages at versions, and single files.
    pub(crate) items: BTreeSet<String>,
    /// Size of the layer in bytes, which is saved by reusing it.
    pub(crate) bytes: u64,
}

/// All chains on the same layers.
pub(crate) struct Chains {
    directory: PathBuf,
    /// Common prefix of all keys.
    ground: String,
}

impl Chains {
    /// Creates the chains of `kind` in a cache, on these layers, in a system with this key.
    pub(crate) fn new(cache: &Path, kind: &str, system: &str, below: &[Digest]) -> Self {
        let ground = Key::new("install")
            .input("kind", kind)
            .input("system", system)
            .inputs("below", below.iter().map(Digest::to_string))
            .finish();
        Self { directory: cache.join("chains").join(&ground), ground }
    }

    /// Returns the key of a link.
    pub(crate) fn key(&self, parent: Option<&str>, items: &BTreeSet<String>) -> String {
        Key::new("link")
            .input("ground", &self.ground)
            .input("parent", parent.unwrap_or_default())
            .inputs("item", items)
            .finish()
    }

    /// Returns the key of the note with the chain used for a whole set.
    pub(crate) fn memo_key(&self, items: &BTreeSet<String>) -> String {
        Key::new("chain").input("ground", &self.ground).inputs("item", items).finish()
    }

    /// Writes the record of a link whose layer is in the cache. Blocking.
    pub(crate) fn write_link(&self, key: &str, link: &Link) -> Result<(), Error> {
        fs::create_dir_all(&self.directory).io_context("making", &self.directory)?;
        let text = serde_json::to_vec(link).unwrap_or_default();
        write_atomically(&self.directory.join(format!("{key}.json")), &text)
    }

    /// Marks links as used.
    pub(crate) fn mark_used(&self, keys: &[String]) {
        for key in keys {
            cache_cleanup::mark_used(&self.directory.join(format!("{key}.json")));
        }
    }

    /// Returns all links by key. Records that are damaged or inconsistent with their name count as missing.
    fn links(&self) -> BTreeMap<String, Link> {
        let mut links = BTreeMap::new();
        for entry in fs::read_dir(&self.directory).into_iter().flatten().flatten() {
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
                    tracing::warn!(path = %entry.path().display(), "a record of a cached layer is \
                                                                    damaged and not used");
                }
            }
        }
        links
    }

    /// Returns the chains whose items are all in `wanted`: those with the most bytes first, then the shorter ones.
    /// Blocking.
    pub(crate) fn find_subsets(&self, wanted: &BTreeSet<String>) -> Vec<FoundChain> {
        let links = self.links();
        let fits: BTreeMap<&String, &Link> = links.iter().filter(|(_, link)| link.items.is_subset(wanted)).collect();
        let mut found: Vec<FoundChain> = fits.keys().filter_map(|tip| collect_chain(&fits, tip)).collect();
        found.sort_by(|a, b| (b.bytes, a.keys.len(), &a.keys).cmp(&(a.bytes, b.keys.len(), &b.keys)));
        found
    }
}

/// A chain of links.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct FoundChain {
    /// Keys of its links, lowest first.
    pub(crate) keys: Vec<String>,
    /// All items that it contains.
    pub(crate) items: BTreeSet<String>,
    /// Total size of its layers in bytes.
    pub(crate) bytes: u64,
}

/// Collects the chain that ends in `tip`, if it is complete and not too long.
fn collect_chain(links: &BTreeMap<&String, &Link>, tip: &str) -> Option<FoundChain> {
    let mut found = FoundChain::default();
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

    struct ChainFixture {
        directory: tempfile::TempDir,
        chains: Chains,
    }

    fn new_fixture() -> ChainFixture {
        let directory = tempfile::tempdir().expect("a directory");
        let chains = Chains::new(directory.path(), "dependencies", "system", &[]);
        ChainFixture { directory, chains }
    }

    impl ChainFixture {
        fn add(&self, parent: Option<&str>, items: &[&str], bytes: u64) -> String {
            let link = Link { parent: parent.map(str::to_owned), items: set(items), bytes };
            let key = self.chains.key(parent, &link.items);
            self.chains.write_link(&key, &link).expect("kept");
            key
        }

        fn best(&self, wanted: &[&str]) -> Vec<String> {
            let found = self.chains.find_subsets(&set(wanted)).into_iter().next();
            found.map(|found| found.keys).unwrap_or_default()
        }
    }

    #[test]
    fn the_largest_set_that_holds_nothing_else_is_taken() {
        let lab = new_fixture();
        let ab = lab.add(None, &["a", "b"], 100);
        let abc = lab.add(Some(&ab), &["c"], 1);
        lab.add(Some(&ab), &["e"], 50);
        assert_eq!(lab.best(&["a", "b", "c", "d"]), [ab.clone(), abc]);
        assert_eq!(lab.best(&["a", "b", "d"]), [ab]);
        // Every chain contains something that is not wanted.
        assert!(lab.best(&["b", "c", "d"]).is_empty());
        assert!(lab.best(&[]).is_empty());
    }

    #[test]
    fn keys_hold_all_that_a_link_stands_on() {
        let lab = new_fixture();
        let (first, second) = (lab.add(None, &["a"], 1), lab.add(None, &["b"], 1));
        let of = |parent: Option<&str>| lab.chains.key(parent, &set(&["c"]));
        assert_ne!(of(Some(&first)), of(Some(&second)));
        assert_ne!(of(Some(&first)), of(None));
        let root = lab.directory.path();
        for other in [
            Chains::new(root, "dependencies", "another system", &[]),
            Chains::new(root, "build-dependencies", "system", &[]),
            Chains::new(root, "dependencies", "system", &[Digest::compute("another base")]),
        ] {
            assert_ne!(other.key(None, &set(&["c"])), of(None));
            assert!(other.find_subsets(&set(&["a", "b"])).is_empty());
        }
        assert_ne!(lab.chains.key(None, &set(&["ab"])), lab.chains.key(None, &set(&["a", "b"])));
    }

    #[test]
    fn records_that_do_not_fit_their_name_are_not_believed() {
        let lab = new_fixture();
        let key = lab.add(None, &["a", "evil"], 1000);
        let path = lab.chains.directory.join(format!("{key}.json"));
        for text in [
            // Forged to look like a layer of `a` alone.
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
        let lab = new_fixture();
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
