//! Underlays: compiled workspaces that other packages are compiled and run upon, as ROS's overlays are.
//!
//! ```text
//!   push --as-underlay U:   base / toolchain / build dependencies / ▒ sources ▒ ──▶ layers of U, what U needs
//!   push --on U:            base / toolchain / U's and its own build dependencies / U / ▒ sources ▒ ──▶ package
//!   runs in:                base / U's and its own dependencies / U / package
//! ```
//!
//! All workspaces are installed below the same prefix, so an underlay is a layer below that of the push: to compilers,
//! ROS and launch files both are one merged install space, and no environment variable tells them apart. For that, no
//! package may be in two of them.

use std::collections::{BTreeMap, BTreeSet};

use image::Digest;
use serde::{Deserialize, Serialize};

use crate::base::Base;
use crate::error::Error;
use crate::indexed::IndexedPackages;
use crate::needs::RuntimeNeeds;
use package::workspace::Package;

/// Install space of an underlay, as two layers with the same files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct UnderlayLayer {
    /// Layer of images, with files of root.
    pub run: Digest,
    /// Layer that is compiled upon, with files of the compiling user, who adds to their directories.
    pub compile: Digest,
}

/// Contents of an underlay, and what is needed to compile and to run upon it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct UnderlayContents {
    /// Name of its base.
    pub base: String,
    /// Diff-ids of the base's layers if it was made from an image, which another import may replace.
    #[serde(default)]
    pub(crate) image: Vec<Digest>,
    /// ROS packages of the underlay and of those below it, each with its layer in images.
    pub packages: BTreeMap<String, Digest>,
    /// Install spaces of the underlays below it and its own, lowest first.
    pub layers: Vec<UnderlayLayer>,
    /// Other names under which its packages meet dependencies.
    pub(crate) replaces: BTreeSet<String>,
    /// Python modules of its packages.
    pub(crate) modules: BTreeSet<String>,
    /// Debian packages for compiling upon it.
    pub(crate) build: BTreeSet<String>,
    /// Needs of its packages at run time.
    pub(crate) run: RuntimeNeeds,
}

/// An underlay that a push stands on.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedUnderlay {
    /// Name of the underlay.
    pub name: String,
    /// Contents of the underlay.
    pub contents: UnderlayContents,
}

/// All underlays of a push, as one.
#[derive(Debug, Clone, Default)]
pub(crate) struct Foundation {
    contents: UnderlayContents,
    /// For each layer, the name of the underlay that brought it.
    names: BTreeMap<Digest, String>,
}

impl Foundation {
    /// Combines the underlays of a push on a base; later ones lie above earlier ones, and what both stand on is there
    /// once.
    ///
    /// # Errors
    /// One is on another base or on another image of it, or a package is in two of them that are not the same.
    pub(crate) fn combine(underlays: &[NamedUnderlay], base: &Base) -> Result<Self, Error> {
        let mut whole = Self::default();
        for NamedUnderlay { name, contents } in underlays {
            if contents.base != base.name {
                return Err(Error::UnderlayBase {
                    underlay: name.clone(),
                    base: contents.base.clone(),
                    wanted: base.name.clone(),
                });
            }
            if contents.image != base.layers_of_image() {
                return Err(Error::UnderlayImage { underlay: name.clone(), base: base.name.clone() });
            }
            let all = &mut whole.contents;
            for (package, layer) in &contents.packages {
                match all.packages.insert(package.clone(), *layer) {
                    Some(other) if other != *layer => {
                        return Err(Error::UnderlayConflict {
                            package: package.clone(),
                            first: whole.names.get(&other).cloned().unwrap_or_default(),
                            second: name.clone(),
                        });
                    }
                    _ => {}
                }
            }
            for layer in &contents.layers {
                if !all.layers.contains(layer) {
                    all.layers.push(*layer);
                }
                whole.names.entry(layer.run).or_insert_with(|| name.clone());
            }
            all.replaces.extend(contents.replaces.iter().cloned());
            all.modules.extend(contents.modules.iter().cloned());
            all.build.extend(contents.build.iter().cloned());
            all.run.extend(&contents.run);
        }
        Ok(whole)
    }

    /// Fails if a package of the push is in an underlay: their files would be mixed.
    pub(crate) fn check_packages(&self, packages: &[Package]) -> Result<(), Error> {
        for package in packages {
            let name = &package.manifest.name;
            if let Some(layer) = self.contents.packages.get(name) {
                let underlay = self.names.get(layer).cloned().unwrap_or_default();
                return Err(Error::InUnderlay { package: name.clone(), underlay });
            }
        }
        Ok(())
    }

    /// Adds the packages to those that are there anyway.
    pub(crate) fn add_to(&self, there: &mut IndexedPackages) {
        let names = || self.contents.packages.keys().chain(&self.contents.replaces).cloned();
        there.build.extend(names());
        there.run.extend(names());
        there.modules.extend(self.contents.modules.iter().cloned());
    }

    /// Returns the Debian packages for compiling.
    pub(crate) fn build_packages(&self) -> &BTreeSet<String> {
        &self.contents.build
    }

    /// Returns what the packages need at run time.
    pub(crate) fn runtime_needs(&self) -> &RuntimeNeeds {
        &self.contents.run
    }

    /// Returns the layers that are compiled upon, lowest first.
    pub(crate) fn compile_layers(&self) -> impl Iterator<Item = Digest> + '_ {
        self.contents.layers.iter().map(|layer| layer.compile)
    }

    /// Returns the layers of an image, lowest first.
    pub(crate) fn run_layers(&self) -> impl Iterator<Item = Digest> + '_ {
        self.contents.layers.iter().map(|layer| layer.run)
    }

    /// Returns the contents of an underlay on these ones: `packages` in its own `layer`, which need `build` for
    /// compiling upon them and `run` at run time.
    pub(crate) fn extend(
        &self,
        base: &Base,
        packages: &[Package],
        layer: UnderlayLayer,
        (build, run): (BTreeSet<String>, RuntimeNeeds),
    ) -> UnderlayContents {
        let mut contents = self.contents.clone();
        contents.base.clone_from(&base.name);
        contents.image = base.layers_of_image().to_vec();
        contents.layers.push(layer);
        for package in packages {
            contents.packages.insert(package.manifest.name.clone(), layer.run);
            contents.replaces.extend(package.manifest.replaces.iter().cloned());
            contents.modules.extend(package.modules.iter().cloned());
        }
        (contents.build, contents.run) = (build, run);
        contents
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn base() -> Base {
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        crate::base::load(&images, crate::DEFAULT_BASE).expect("valid")
    }

    fn digest(number: u8) -> Digest {
        format!("sha256:{}", hex::encode([number; 32])).parse().expect("a digest")
    }

    fn underlay(name: &str, packages: &[(&str, u8)], layers: &[u8]) -> NamedUnderlay {
        let layer = |number: &u8| UnderlayLayer { run: digest(*number), compile: digest(*number + 100) };
        let contents = UnderlayContents {
            base: crate::DEFAULT_BASE.to_owned(),
            packages: packages.iter().map(|(name, layer)| ((*name).to_owned(), digest(*layer))).collect(),
            layers: layers.iter().map(layer).collect(),
            build: BTreeSet::from([format!("lib{name}-dev")]),
            modules: BTreeSet::from([format!("{name}_module")]),
            ..UnderlayContents::default()
        };
        NamedUnderlay { name: name.to_owned(), contents }
    }

    #[test]
    fn what_two_underlays_stand_on_is_there_once() {
        let maps = underlay("maps", &[("grid", 1), ("maps", 2)], &[1, 2]);
        let arms = underlay("arms", &[("grid", 1), ("arms", 3)], &[1, 3]);
        let both = Foundation::combine(&[maps, arms], &base()).expect("they fit");
        assert_eq!(both.run_layers().collect::<Vec<_>>(), [digest(1), digest(2), digest(3)]);
        assert_eq!(both.compile_layers().collect::<Vec<_>>(), [digest(101), digest(102), digest(103)]);
        let mut there = IndexedPackages::default();
        both.add_to(&mut there);
        assert_eq!(there.run, ["arms", "grid", "maps"].map(str::to_owned).into());
        assert!(there.build == there.run && there.modules.contains("arms_module"), "{there:?}");
        assert_eq!(both.build_packages(), &["libarms-dev", "libmaps-dev"].map(str::to_owned).into());
    }

    #[test]
    fn a_package_is_in_one_place() {
        let (maps, arms) = (underlay("maps", &[("grid", 1)], &[1]), underlay("arms", &[("grid", 2)], &[2]));
        let refused = Foundation::combine(&[maps.clone(), arms], &base()).expect_err("two").to_string();
        assert!(refused.contains("grid") && refused.contains("maps") && refused.contains("arms"), "{refused}");
        let other = NamedUnderlay {
            contents: UnderlayContents { base: "lab-jazzy".to_owned(), ..maps.contents.clone() },
            ..maps.clone()
        };
        let refused = Foundation::combine(&[other], &base()).expect_err("another base").to_string();
        assert!(refused.contains("--base lab-jazzy"), "{refused}");
        let replaced = NamedUnderlay {
            contents: UnderlayContents { image: vec![digest(9)], ..maps.contents.clone() },
            ..maps.clone()
        };
        let refused = Foundation::combine(&[replaced], &base()).expect_err("another image").to_string();
        assert!(refused.contains("push the underlay again"), "{refused}");
        let maps = Foundation::combine(&[maps], &base()).expect("it fits");
        let place = tempfile::tempdir().expect("a directory");
        let text = "<package><name>grid</name><version>1.0.0</version></package>";
        std::fs::write(place.path().join("package.xml"), text).expect("written");
        let variables = package::condition::Variables::for_distribution(1, "noetic");
        let pushed = package::workspace::inspect(place.path(), &variables).expect("a package");
        let refused = maps.check_packages(pushed.packages()).expect_err("it is there").to_string();
        assert!(refused.contains("grid is also in underlay maps"), "{refused}");
    }
}
