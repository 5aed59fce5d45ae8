//! What the three ways of pushing have in common: layers on layers, and the image at the end.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use std::sync::Arc;

use image::{Digest, ImageSpec};
use package::inventory::{Inventory, Published};
use ros::flavour::Version;

use crate::advice::{self, Known};
use crate::apt::Deb;
use crate::archive::Archive;
use crate::base::Base;
use crate::error::Error;
use crate::event::Progress;
use crate::indexed;
use crate::install::{self, Addition, Made};
use crate::key::Key;
use crate::keys;
use crate::launch::{self, Ask, LaunchPlan};
use crate::pushed;
use crate::request::{BuildOutcome, BuiltLayer, PushRequest};
use crate::undeclared;
use crate::workshop::{Layer, Workshop};

/// Where dpkg writes down what is installed.
const STATUS: &str = "var/lib/dpkg/status";

/// A push that is being built, its base layer made.
pub(crate) struct Build<'a> {
    pub(crate) shop: Workshop,
    pub(crate) base: Base,
    pub(crate) archive: Arc<Archive>,
    pub(crate) base_layer: Made,
    pub(crate) request: &'a PushRequest,
    pub(crate) progress: &'a Progress,
    pub(crate) log: PathBuf,
}

/// What one of them found and made.
pub(crate) struct Parts {
    /// ROS packages that the push is about, most important first.
    pub(crate) packages: Vec<String>,
    /// Theirs, as far as they are known.
    pub(crate) versions: BTreeMap<String, String>,
    pub(crate) dependencies: Made,
    /// Nothing where the dependencies are all.
    pub(crate) package: Made,
    /// Its install space; none for one below `/usr`.
    pub(crate) prefix: Option<PathBuf>,
}

impl Build<'_> {
    /// The base layer alone, as what others are put on.
    pub(crate) fn on_base(&self) -> Vec<Digest> {
        self.base_layer.diff_ids().collect()
    }

    /// ROS packages of ROS 2 that are in these layers.
    pub(crate) async fn indexed(&self, layers: &[Digest]) -> Result<BTreeSet<String>, Error> {
        let trees = self.shop.extracted(layers).await?;
        indexed::packages(&self.base, trees).await
    }

    /// Layers with these Debian packages, and what they need, on top of `below`.
    pub(crate) async fn add(
        &self,
        name: &'static str,
        below: &[Digest],
        packages: &BTreeSet<String>,
        extras: Vec<crate::deb::Member>,
    ) -> Result<Made, Error> {
        let debs = self.resolve(below, packages).await?;
        let addition = Addition {
            name,
            below,
            debs,
            extras,
        };
        install::layers(
            &self.shop,
            &self.archive,
            &self.base,
            addition,
            self.progress,
        )
        .await
    }

    /// What is to be installed on top of `below`. Remembered: apt takes seconds.
    async fn resolve(
        &self,
        below: &[Digest],
        packages: &BTreeSet<String>,
    ) -> Result<Vec<Deb>, Error> {
        if packages.is_empty() {
            return Ok(Vec::new());
        }
        let key = Key::new("resolved")
            .with("archive", &self.archive.stamp)
            .with_all("below", below.iter().map(Digest::to_string))
            .with_all("package", packages)
            .finish();
        if let Some(debs) = self.shop.layers.note(&key) {
            return Ok(debs);
        }
        let trees = self.shop.extracted(below).await?;
        let status = trees
            .iter()
            .rev()
            // In the layer itself: apt, which reads it out here, would follow a link to the host.
            .find(|tree| foreign::Tree::open(tree).is_ok_and(|tree| tree.has_file(STATUS)))
            .map(|tree| tree.join(STATUS));
        let debs = self
            .archive
            .apt
            .resolve(status.as_deref(), packages)
            .await?;
        self.shop.layers.keep_note(&key, &debs)?;
        Ok(debs)
    }

    /// Names given with `--with`: ROS packages first, then Debian ones.
    pub(crate) async fn extra_packages(
        &self,
    ) -> Result<(BTreeSet<String>, BTreeSet<String>), Error> {
        if self.base.ros != Version::Ros1 {
            return Ok((BTreeSet::new(), self.extra_of_two().await?));
        }
        let (mut ros, mut debs) = (BTreeSet::new(), BTreeSet::new());
        let mut missing = Vec::new();
        for name in &self.request.with {
            if !self.archive.contents.ros_package(name).is_empty() {
                ros.insert(name.clone());
            } else if self.archive.candidates.contains(name) {
                ros.extend(
                    self.archive
                        .contents
                        .ros_packages_in(name)
                        .into_iter()
                        .map(str::to_owned),
                );
                debs.insert(name.clone());
            } else {
                missing.push(crate::error::Unresolved {
                    key: name.clone(),
                    wanted_by: vec!["--with".into()],
                    similar: self.archive.similar(name),
                });
            }
        }
        if missing.is_empty() {
            Ok((ros, debs))
        } else {
            Err(Error::Unresolved(missing))
        }
    }

    /// The same on a base of ROS 2: Debian packages, without ROS packages that are there already.
    async fn extra_of_two(&self) -> Result<BTreeSet<String>, Error> {
        if self.request.with.is_empty() {
            return Ok(BTreeSet::new());
        }
        let there = self.indexed(&self.on_base()).await?;
        let (mut debs, mut missing) = (BTreeSet::new(), Vec::new());
        let wanted = self.request.with.iter();
        for name in wanted.filter(|name| !there.contains(*name)) {
            match keys::named(&self.archive, &self.base, name) {
                Some(deb) => {
                    debs.insert(deb);
                }
                None => missing.push(keys::unresolved(&self.archive, &self.base, name, "--with")),
            }
        }
        match missing.is_empty() {
            true => Ok(debs),
            false => Err(Error::Unresolved(missing)),
        }
    }

    /// Resolves what to run and writes the image.
    pub(crate) async fn finish(
        &self,
        made: Parts,
        hold: image::Hold,
    ) -> Result<BuildOutcome, Error> {
        let parts = [
            ("base", &self.base_layer),
            ("dependencies", &made.dependencies),
            ("package", &made.package),
        ];
        let parts = parts
            .into_iter()
            .flat_map(|(name, part)| part.layers.iter().map(move |layer| (name, *layer)));
        let parts: Vec<(&'static str, Layer)> = parts.collect();
        let diff_ids: Vec<Digest> = parts.iter().map(|(_, layer)| layer.diff_id).collect();
        let trees = self.shop.extracted(&diff_ids).await?;
        self.progress.step("resolving what to run").await;
        let request = self.request;
        let ask = Ask {
            packages: made.packages.clone(),
            prefix: made
                .prefix
                .as_deref()
                .map_or_else(String::new, |prefix| prefix.display().to_string()),
            launch: request.launch.clone().unwrap_or_default(),
            nodes: request.nodes.clone(),
            args: request.args.clone(),
            remaps: request.remaps.clone(),
            params: request.params.clone(),
        };
        let answer = launch::ask(
            &self.shop,
            self.base.ros,
            trees.clone(),
            self.base.environment.clone(),
            &ask,
        )
        .await
        .map_err(|error| advice::on(error, Known::of(&self.archive, &self.base)))?;
        for warning in &answer.warnings {
            self.progress.warn(warning.as_str()).await;
        }
        let mut environment = self.base.environment.clone();
        environment.extend(answer.environment);
        // Where it works is made when it is run.
        let flavour = self.base.flavour();
        for name in flavour.environment("").keys() {
            environment.remove(name);
        }
        let package = pushed::subject(&made.packages, &answer.nodes);
        let version = made.versions.get(&package).cloned().unwrap_or_default();
        let of = (package.clone(), environment.clone(), answer.nodes.clone());
        let known = (self.archive.clone(), self.base.clone());
        let (inventory, undeclared) = crate::blocking::reading(move || {
            let (package, environment, nodes) = of;
            let commands: Vec<&[String]> = nodes.iter().map(|node| node.argv.as_slice()).collect();
            let of = Published {
                package: &package,
                environment: &environment,
                commands: &commands,
            };
            let inventory = Inventory::take(&trees, of)?;
            let (archive, base) = known;
            let undeclared = match base.ros {
                Version::Ros1 => undeclared::advice(&trees, &inventory, Known::of(&archive, &base)),
                // Its programs are made by setuptools, and import their packages by name.
                Version::Ros2 => Vec::new(),
            };
            Ok::<_, Error>((inventory, undeclared))
        })
        .await??;
        for words in undeclared {
            self.progress.warn(words).await;
        }
        launch::check_composition(&answer.components, &inventory.definitions)?;
        let layers = self.packed(parts).await?;
        let spec = ImageSpec {
            layers: layers.iter().map(|layer| layer.info).collect(),
            env: environment.clone(),
            labels: BTreeMap::from([
                ("org.cloudroid.package".to_owned(), package.clone()),
                ("org.cloudroid.base".to_owned(), self.base.name.clone()),
            ]),
            annotations: BTreeMap::from([
                ("org.opencontainers.image.title".to_owned(), package.clone()),
                (
                    "org.opencontainers.image.version".to_owned(),
                    version.clone(),
                ),
            ]),
            ..ImageSpec::default()
        };
        let store = self.shop.layers.store().clone();
        let image = crate::blocking::spawn(move || store.put_image(&spec)).await??;
        // A log that tells of no failure is of no use to anyone.
        let _ = fs::remove_file(&self.log);
        Ok(BuildOutcome {
            package,
            version,
            flavour,
            image,
            layers,
            environment,
            plan: LaunchPlan {
                nodes: answer.nodes,
                parameters: answer.parameters,
                components: answer.components,
            },
            inventory,
            hold,
        })
    }

    /// The layers with their archives.
    async fn packed(&self, parts: Vec<(&'static str, Layer)>) -> Result<Vec<BuiltLayer>, Error> {
        if self.shop.is_packing() {
            self.progress.step("packing the rest of the layers").await;
        }
        self.shop.settled().await?;
        let store = self.shop.layers.store().clone();
        tokio::task::spawn_blocking(move || {
            let whole = parts.into_iter().map(|(name, layer)| {
                let info = store.layer(&layer.diff_id)?;
                let info = info.ok_or_else(|| image::Error::UnknownLayer {
                    diff_id: layer.diff_id,
                    store: store.images_dir().to_owned(),
                })?;
                Ok(BuiltLayer {
                    name,
                    info,
                    cached: layer.cached,
                })
            });
            whole.collect()
        })
        .await?
    }
}
