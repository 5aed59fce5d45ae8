//! Common steps of the three kinds of push: stacking layers and writing the image.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use image::{Digest, ImageSpec};
use package::inventory::{Inventory, SearchHints};

use crate::advice::{self, AdviceIndex};
use crate::archive::Archive;
use crate::base::Base;
use crate::bootstrap::EPOCH;
use crate::debian_package::Deb;
use crate::error::Error;
use crate::event::Progress;
use crate::indexed::{self, IndexedPackages};
use crate::install::{self, LayerAddition, LayerSet};
use crate::key::Key;
use crate::keys;
use crate::launch::{self, LaunchPlan, LaunchQuery};
use crate::middleware;
use crate::missing_modules;
use crate::pushed_packages;
use crate::request::{BuildOutcome, BuiltLayer, BuiltUnderlay, PushRequest};
use crate::underlay::{Foundation, UnderlayContents};
use crate::workshop::{BuildContext, StagedLayer};

/// Status file of dpkg.
const STATUS: &str = "var/lib/dpkg/status";

/// A build in progress, whose base layer exists.
pub(crate) struct Build<'a> {
    pub(crate) shop: BuildContext,
    pub(crate) base: Base,
    pub(crate) archive: Arc<Archive>,
    pub(crate) base_layer: LayerSet,
    /// Underlays that it is compiled and runs upon.
    pub(crate) foundation: Foundation,
    /// Layers in which sources are compiled, if an imported base has them.
    pub(crate) tools: Option<Vec<Digest>>,
    pub(crate) request: &'a PushRequest,
    pub(crate) progress: &'a Progress,
    pub(crate) log: PathBuf,
}

/// Result of one kind of push.
pub(crate) struct BuildParts {
    /// ROS packages of the push, most important first.
    pub(crate) packages: Vec<String>,
    /// Versions of these packages, as far as known.
    pub(crate) versions: BTreeMap<String, String>,
    pub(crate) dependencies: LayerSet,
    /// Empty if the dependencies are everything.
    pub(crate) package: LayerSet,
    /// Prefix of its install space; `None` for one below `/usr`.
    pub(crate) prefix: Option<PathBuf>,
    /// Facts for packages that are built upon it, if it becomes an underlay.
    pub(crate) contents: Option<UnderlayContents>,
}

impl Build<'_> {
    /// Returns the base layers, on which others are stacked.
    pub(crate) fn base_diff_ids(&self) -> Vec<Digest> {
        self.base_layer.diff_ids().collect()
    }

    /// Returns the ROS packages in the install spaces of these layers.
    pub(crate) async fn indexed_packages(&self, layers: &[Digest]) -> Result<BTreeSet<String>, Error> {
        let trees = self.shop.extract_layers(layers).await?;
        indexed::find_packages(&self.base, trees).await
    }

    /// Returns the Python modules in the install spaces of these layers.
    pub(crate) async fn indexed_modules(&self, layers: &[Digest]) -> Result<BTreeSet<String>, Error> {
        let trees = self.shop.extract_layers(layers).await?;
        indexed::find_modules(&self.base, trees).await
    }

    /// Finds the packages of the base, in `tools` with its toolchain, and keeps them for pushes that are only looked
    /// at.
    pub(crate) async fn find_known_packages(&self, tools: &[Digest]) -> Result<IndexedPackages, Error> {
        let below = self.base_diff_ids();
        let there = IndexedPackages {
            build: self.indexed_packages(tools).await?,
            run: self.indexed_packages(&below).await?,
            modules: self.indexed_modules(&below).await?,
        };
        indexed::write_known(&self.shop.layers, &self.base, &self.archive, &there)?;
        Ok(there)
    }

    /// Adds layers with these Debian packages and their dependencies on top of `below`.
    pub(crate) async fn add_packages(
        &self,
        name: &'static str,
        below: &[Digest],
        packages: &BTreeSet<String>,
        extras: Vec<crate::deb::DebMember>,
    ) -> Result<LayerSet, Error> {
        let debs = self.resolve(below, packages).await?;
        let addition = LayerAddition { name, below, debs, extras };
        install::add_layers(&self.shop, &self.archive, &self.base, addition, self.progress).await
    }

    /// Resolves the packages to install on top of `below`. Cached, since apt takes seconds.
    async fn resolve(&self, below: &[Digest], packages: &BTreeSet<String>) -> Result<Vec<Deb>, Error> {
        if packages.is_empty() {
            return Ok(Vec::new());
        }
        let key = Key::new("resolved")
            .input("archive", &self.archive.stamp)
            .inputs("below", below.iter().map(Digest::to_string))
            .inputs("package", packages)
            .finish();
        if let Some(debs) = self.shop.layers.read_note(&key) {
            return Ok(debs);
        }
        let trees = self.shop.extract_layers(below).await?;
        let status = trees
            .iter()
            .rev()
            // Looked up in the layer itself: apt, which runs on the host, would follow a link to the host.
            .find(|tree| foreign::Tree::open(tree).is_ok_and(|tree| tree.has_file(STATUS)))
            .map(|tree| tree.join(STATUS));
        let debs = self.archive.apt.resolve(status.as_deref(), packages).await?;
        self.shop.layers.write_note(&key, &debs)?;
        Ok(debs)
    }

    /// Returns the names given with `--with`: first ROS packages, then Debian packages.
    pub(crate) async fn extra_packages(&self) -> Result<(BTreeSet<String>, BTreeSet<String>), Error> {
        if !self.base.has_distributions_ros() {
            return Ok((BTreeSet::new(), self.extra_debs().await?));
        }
        let (mut ros, mut debs) = (BTreeSet::new(), BTreeSet::new());
        let mut missing = Vec::new();
        for name in &self.request.with {
            if !self.archive.contents.ros_package(name).is_empty() {
                ros.insert(name.clone());
            } else if self.archive.candidates.contains(name) {
                ros.extend(self.archive.contents.ros_packages_in(name).into_iter().map(str::to_owned));
                debs.insert(name.clone());
            } else {
                missing.push(keys::unresolved_name(&self.archive, &self.base, name, &BTreeSet::new()));
            }
        }
        if missing.is_empty() { Ok((ros, debs)) } else { Err(Error::Unresolved(missing)) }
    }

    /// Returns the names given with `--with` on a base with install spaces: Debian packages, without ROS packages that
    /// are already there.
    async fn extra_debs(&self) -> Result<BTreeSet<String>, Error> {
        if self.request.with.is_empty() {
            return Ok(BTreeSet::new());
        }
        let there = self.indexed_packages(&self.base_diff_ids()).await?;
        let (mut debs, mut missing) = (BTreeSet::new(), Vec::new());
        let wanted = self.request.with.iter();
        for name in wanted.filter(|name| !there.contains(*name)) {
            match keys::find_named_deb(&self.archive, &self.base, name) {
                Some(deb) => {
                    debs.insert(deb);
                }
                None => missing.push(keys::unresolved_name(&self.archive, &self.base, name, &there)),
            }
        }
        if missing.is_empty() { Ok(debs) } else { Err(Error::Unresolved(missing)) }
    }

    /// Resolves what to run and writes the image.
    pub(crate) async fn finish(&self, made: BuildParts, hold: image::GcHold) -> Result<BuildOutcome, Error> {
        let underlay = self.foundation.run_layers().map(|diff_id| StagedLayer { diff_id, cached: true });
        let underlay = LayerSet { layers: underlay.collect() };
        let parts = [
            ("base", &self.base_layer),
            ("dependencies", &made.dependencies),
            ("underlay", &underlay),
            ("package", &made.package),
        ];
        let parts = parts.into_iter().flat_map(|(name, part)| part.layers.iter().map(move |layer| (name, *layer)));
        let parts: Vec<(&'static str, StagedLayer)> = parts.collect();
        let diff_ids: Vec<Digest> = parts.iter().map(|(_, layer)| layer.diff_id).collect();
        let trees = self.shop.extract_layers(&diff_ids).await?;
        self.progress.step("resolving what to run").await;
        let request = self.request;
        let ask = LaunchQuery {
            packages: made.packages.clone(),
            prefix: made.prefix.as_deref().map_or_else(String::new, |prefix| prefix.display().to_string()),
            launch: request.launch.clone().unwrap_or_default(),
            nodes: request.nodes.clone(),
            args: request.args.clone(),
            remaps: request.remaps.clone(),
            params: request.params.clone(),
        };
        let answer = launch::query_plan(&self.shop, self.base.ros, trees.clone(), self.base.environment.clone(), &ask)
            .await
            .map_err(|error| advice::add_advice(error, AdviceIndex::for_base(&self.archive, &self.base)))?;
        middleware::check_plan(&answer, self.base.ros)?;
        for warning in &answer.warnings {
            self.progress.warn(warning.as_str()).await;
        }
        let mut environment = self.base.environment.clone();
        environment.extend(answer.environment);
        // The home directory is set when it is run.
        let flavour = self.base.flavour();
        for name in flavour.environment("").keys() {
            environment.remove(name);
        }
        let package = pushed_packages::main_package(&made.packages, &answer.nodes);
        let version = made.versions.get(&package).cloned().unwrap_or_default();
        let of = (package.clone(), environment.clone(), answer.nodes.clone());
        let known = (self.archive.clone(), self.base.clone());
        let (inventory, undeclared) = crate::blocking::spawn_reader(move || {
            let (package, environment, nodes) = of;
            let commands: Vec<&[String]> = nodes.iter().map(|node| node.argv.as_slice()).collect();
            let of = SearchHints { package: &package, environment: &environment, commands: &commands };
            let inventory = Inventory::scan(&trees, of)?;
            let (archive, base) = known;
            let undeclared = if base.has_distributions_ros() {
                missing_modules::missing_module_advice(&trees, &inventory, AdviceIndex::for_base(&archive, &base))
            } else {
                // Programs of ROS 2 are created by setuptools and import their packages by name, and the archive's
                // index does not tell what is in install spaces.
                Vec::new()
            };
            Ok::<_, Error>((inventory, undeclared))
        })
        .await??;
        for words in undeclared {
            self.progress.warn(words).await;
        }
        launch::check_composition(&answer.components, &inventory.definitions)?;
        let layers = self.pack_layers(parts).await?;
        let spec = ImageSpec {
            layers: layers.iter().map(|layer| layer.info).collect(),
            env: environment.clone(),
            labels: BTreeMap::from([
                ("org.cloudroid.package".to_owned(), package.clone()),
                ("org.cloudroid.base".to_owned(), self.base.name.clone()),
            ]),
            annotations: BTreeMap::from([
                ("org.opencontainers.image.title".to_owned(), package.clone()),
                ("org.opencontainers.image.version".to_owned(), version.clone()),
            ]),
            created: creation_time(request.created, SystemTime::now()),
            ..ImageSpec::default()
        };
        let store = self.shop.layers.store().clone();
        let image = crate::blocking::spawn(move || store.put_image(&spec)).await??;
        // The log of a successful build is not kept.
        let _ = fs::remove_file(&self.log);
        Ok(BuildOutcome {
            package,
            version,
            flavour,
            image,
            layers,
            environment,
            plan: LaunchPlan { nodes: answer.nodes, parameters: answer.parameters, components: answer.components },
            inventory,
            hold,
        })
    }

    /// Writes the image that keeps the layers of an underlay and of those below it.
    pub(crate) async fn finish_underlay(&self, made: BuildParts, hold: image::GcHold) -> Result<BuiltUnderlay, Error> {
        let contents = made.contents.unwrap_or_default();
        let layers = self.pack_layers(made.package.layers.iter().map(|layer| ("package", *layer)).collect()).await?;
        let all = contents.layers.iter().flat_map(|layer| [layer.run, layer.compile]);
        let all = all.map(|diff_id| ("underlay", StagedLayer { diff_id, cached: true })).collect();
        let kept = self.pack_layers(all).await?;
        let package = made.packages.first().cloned().unwrap_or_default();
        let spec = ImageSpec {
            layers: kept.iter().map(|layer| layer.info).collect(),
            labels: BTreeMap::from([
                ("org.cloudroid.package".to_owned(), package.clone()),
                ("org.cloudroid.base".to_owned(), self.base.name.clone()),
            ]),
            created: creation_time(self.request.created, SystemTime::now()),
            ..ImageSpec::default()
        };
        let store = self.shop.layers.store().clone();
        let image = crate::blocking::spawn(move || store.put_image(&spec)).await??;
        let _ = fs::remove_file(&self.log);
        Ok(BuiltUnderlay { package, contents, flavour: self.base.flavour(), image, layers, hold })
    }

    /// Completes the layers with their archives.
    async fn pack_layers(&self, parts: Vec<(&'static str, StagedLayer)>) -> Result<Vec<BuiltLayer>, Error> {
        if self.shop.is_packing() {
            self.progress.step("packing the rest of the layers").await;
        }
        self.shop.wait_until_packed().await?;
        let store = self.shop.layers.store().clone();
        tokio::task::spawn_blocking(move || {
            let whole = parts.into_iter().map(|(name, layer)| {
                let info = store.layer(&layer.diff_id)?;
                let info = info.ok_or_else(|| image::Error::UnknownLayer {
                    diff_id: layer.diff_id,
                    store: store.images_dir().to_owned(),
                })?;
                Ok(BuiltLayer { name, info, cached: layer.cached })
            });
            whole.collect()
        })
        .await?
    }
}

/// Returns the creation time of an image in seconds since 1970: that of its newest source, but not in the future.
fn creation_time(newest: Option<u64>, now: SystemTime) -> u64 {
    let now = now.duration_since(UNIX_EPOCH).map_or(EPOCH, |since| since.as_secs());
    newest.map_or(EPOCH, |newest| newest.min(now))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn an_image_is_not_newer_than_now() {
        let now = UNIX_EPOCH + Duration::from_secs(1_800_000_000);
        for (newest, expected) in [
            (None, EPOCH),
            (Some(1_750_000_000), 1_750_000_000),
            (Some(1_900_000_000), 1_800_000_000),
            (Some(u64::MAX), 1_800_000_000),
        ] {
            assert_eq!(creation_time(newest, now), expected, "{newest:?}");
        }
    }
}
