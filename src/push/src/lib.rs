//! From an archive to a published revision, told line by line; rolling back and removing what is published.
//!
//! ```text
//!  body ─▶ unpack (nothing leaves the tree) ─▶ build (layers, image) ─▶ probe (start once, record the interface)
//!                                                                              │
//!             whoever connects next gets the new revision ◀─ tags ◀─ database ◀┘
//! ```
//!
//! Until the database has the revision nothing of it can be seen, so whatever fails, and whenever the client goes
//! away, an earlier revision keeps serving. Pushes of one service follow one another; others run side by side.

#![forbid(unsafe_code)]

mod bounds;
mod error;
mod exported;
mod interface_limits;
mod naming;
mod options;
mod patience;
mod places;
mod probe;
mod publish;
mod receive;
mod request;
mod room;
mod shared;
mod stateful;
mod supplement;
mod told;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use api::PushOptions;
use catalogue::{Catalogue, names};
use choreographer::Choreographer;
use package::inventory::Inventory;
use package::requests;
use reach::Opener;
use reach::group::shareable;
use rootfs_builder::{BuildOutcome, Builder, PushRequest, Source};
use servant::engine::Engine;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use bounds::Left;
use exported::Imported;
use places::Places;
use request::Reporter;
use room::Disks;
use store::{Journal, Plan, RevisionRecord};

pub use error::Error;
pub use exported::{RECORD, ServiceRecord};
pub use options::Options;
pub use receive::Archive;
pub use request::{Deployer, Published};

/// Events that may wait for a slow client before the build waits for it.
pub const EVENTS_AHEAD: usize = 256;
/// The unpacked archive, in the directory of its build.
const PUSHED: &str = "pushed";
/// Where nodes run, and keep what they write: a tmpfs.
const HOME_INSIDE: &str = "/root";

/// What a push is done with.
pub struct Parts {
    /// Makes images.
    pub builder: Arc<Builder>,
    /// Where they are published.
    pub catalogue: Arc<Catalogue>,
    /// Starts the container in which the interface is looked for.
    pub engine: Arc<dyn Engine>,
    /// Reaches its ROS.
    pub opener: Arc<dyn Opener>,
    /// Admits it, and ends the servants of what is removed.
    pub choreographer: Choreographer,
    /// Where the operator reads what came of it.
    pub journal: Journal,
}

/// Publishes, rolls back and removes services.
pub struct Pusher {
    options: Options,
    home: PathBuf,
    catalogue: Arc<Catalogue>,
    engine: Arc<dyn Engine>,
    opener: Arc<dyn Opener>,
    choreographer: Choreographer,
    builder: Arc<Builder>,
    journal: Journal,
    places: Places,
    disks: Disks,
    published: AtomicU64,
    failed: AtomicU64,
    cancel: CancellationToken,
    tasks: TaskTracker,
}

impl Pusher {
    /// With half-made things below `home`, the state directory.
    pub fn new(options: Options, home: PathBuf, parts: Parts) -> Pusher {
        let Parts {
            builder,
            catalogue,
            engine,
            opener,
            choreographer,
            journal,
        } = parts;
        Pusher {
            places: Places::new(&options),
            disks: Disks::new(&home, builder.cache_dir(), options.free),
            options,
            home,
            journal,
            catalogue,
            engine,
            opener,
            choreographer,
            builder,
            published: AtomicU64::new(0),
            failed: AtomicU64::new(0),
            cancel: CancellationToken::new(),
            tasks: TaskTracker::new(),
        }
    }

    /// Pushes that succeeded and failed since the start.
    pub fn counts(&self) -> (u64, u64) {
        (
            self.published.load(Ordering::Relaxed),
            self.failed.load(Ordering::Relaxed),
        )
    }

    /// Cancels every push and waits until nothing is left of them, for `patience`: what is left then is swept by the
    /// next daemon.
    pub async fn cancel_all(&self, patience: Duration) {
        self.cancel.cancel();
        self.tasks.close();
        if tokio::time::timeout(patience, self.tasks.wait())
            .await
            .is_err()
        {
            tracing::warn!("what cancelled pushes left is removed at the next start");
        }
    }

    /// Pushes when it is its turn, within what a push may use.
    async fn push(
        &self,
        id: &str,
        options: &PushOptions,
        by: &Deployer,
        archive: Archive,
        report: &Reporter,
    ) -> Result<Published, Error> {
        let began = Instant::now();
        let known = options.name.as_deref().or(options.apt.as_deref());
        let mut admitted = self.places.enter(known, report).await?;
        self.disks.check().await?;
        self.check_quota(by.owner.as_deref(), None).await?;
        let build = self.home.join("build").join(id);
        let mut left = Left::new(&self.options, build, &self.disks);
        let made = left
            .during(Box::pin(self.made(id, options, archive, (by, report))))
            .await?;
        let (built, imported) = match made {
            Made::Built(built) => (*built, None),
            Made::Imported(imported) => {
                let Imported {
                    record,
                    options,
                    built,
                } = *imported;
                // Another server allowed it; this one may not.
                self.check(&options, by)?;
                (built, Some((record, options)))
            }
        };
        let options = imported.as_ref().map_or(options, |(_, options)| options);
        let name = options
            .name
            .clone()
            .unwrap_or_else(|| built.package.clone());
        names::service(&name).map_err(catalogue::Error::from)?;
        admitted.named(&name, report).await?;
        // Pushes of one service follow one another: whose it is does not change until this one is done.
        by.may(&name)?;
        let image = built.image.to_string();
        self.check_quota(by.owner.as_deref(), Some(&image)).await?;
        let mut plan = plan_of(&built, options);
        if let Some((record, _)) = &imported {
            plan.restart = record.plan.restart;
        }
        let layers: Vec<_> = built.layers.iter().map(layer).collect();
        // Together they take more than a thread's stack has in a build that is not optimised.
        let shown = Box::pin(self.shown(id, options, (built, plan), (name.clone(), by), report));
        let (record, inventory) = left.during(shown).await?;
        // The token may have been revoked meanwhile.
        by.may(&name)?;
        // From here on nothing breaks it off: what was published is not told to have been cancelled.
        report.publishing.cancel();
        let terms = options.rollout;
        Box::pin(self.publish(record, inventory, terms, report)).await?;
        if let Some((record, _)) = &imported {
            self.take_over_rows(&name, record, report);
        }
        Ok(Published {
            layers,
            service: name,
            took: began.elapsed(),
        })
    }

    /// The image of what is pushed.
    async fn made(
        &self,
        id: &str,
        options: &PushOptions,
        archive: Archive,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<Made, Error> {
        let source = match &options.apt {
            Some(package) => {
                // Names of Debian packages have hyphens, those of ROS packages do not.
                if let (Some(name), false) = (&options.name, package.contains('-')) {
                    self.check_owner(name, std::slice::from_ref(package))?;
                }
                Source::Packaged(package.clone())
            }
            None => {
                report.step("receiving the package").await;
                let tree = self.home.join("build").join(id).join(PUSHED);
                receive::unpack(archive, &tree, &self.options, report).await?;
                let of = tree.clone();
                if privilege::blocking(move || exported::is_exported(&of))
                    .await
                    .unwrap_or(false)
                {
                    return self.taken_in(options, tree, report).await;
                }
                if let Some(name) = &options.name {
                    let of = tree.clone();
                    let look = move || privilege::reading(|| receive::packages_of(&of));
                    let packages = privilege::blocking(look)
                        .await
                        .map_err(|_| Error::Internal("looking at the package"))?;
                    self.check_owner(name, &packages)?;
                }
                Source::Tree(tree)
            }
        };
        self.build(id, options, source, (by, report))
            .await
            .map(|built| Made::Built(Box::new(built)))
    }

    /// Finds the interface of an image: what is to be published of it.
    async fn shown(
        &self,
        id: &str,
        options: &PushOptions,
        (built, mut plan): (BuildOutcome, Plan),
        (name, by): (String, &Deployer),
        report: &Reporter,
    ) -> Result<(RevisionRecord, Inventory), Error> {
        self.check_owner(&name, std::slice::from_ref(&built.package))?;
        report.step("starting it once to find its interface").await;
        for warning in self.choreographer.check_grants(&plan.grants)? {
            report.warning(warning).await;
        }
        let found = probe::interface(self, id, &built, &mut plan, options, report);
        let found = Box::pin(found).await?;
        for warning in found.warnings {
            report.warning(warning).await;
        }
        let mut interface = found.interface;
        if let Some(text) = &options.interface {
            let known = (built.flavour.ros.bus(), &built.inventory.definitions);
            supplement::add(&mut interface, text, known)
                .map_err(|error| Error::Options(format!("the interface supplement: {error}")))?;
        }
        interface_limits::check_interface(&interface)?;
        let ros = built.flavour.ros.bus();
        let decided = requests::decide(ros, &interface, &found.watched);
        let stated = options.read_requests().map_err(Error::Options)?;
        let decided = requests::state(ros, &interface, &stated, decided)
            .map_err(|error| Error::Options(format!("--request: {error}")))?;
        for request in &decided {
            report.request(request).await;
        }
        interface.requests = Some(decided);
        if !(options.stateful || options.stateless) {
            let signs = stateful::signs(&interface, &found.growing);
            if let Some(question) = stateful::question(&signs) {
                report.warning(question).await;
            }
        }
        if plan.shared.is_some() {
            shared::check_interface(ros, &interface)?;
            for remark in shareable::remarks(&interface) {
                report.warning(remark).await;
            }
        }
        let record = RevisionRecord {
            service: name,
            number: 0,
            image: built.image.to_string(),
            published: store::now(),
            package: built.package.clone(),
            owner: by.owner.clone(),
            source: options.source.clone(),
            flavour: built.flavour,
            plan,
            interface,
        };
        report.step(api::push::PUBLISHING).await;
        Ok((record, built.inventory))
    }

    /// A service belongs to the package that it was first made of.
    fn check_owner(&self, name: &str, packages: &[String]) -> Result<(), Error> {
        match (self.catalogue.package(name)?, packages) {
            (Some(owner), [first, ..]) if !packages.contains(&owner) => Err(Error::NameTaken {
                name: name.to_owned(),
                package: owner,
                newcomer: first.clone(),
            }),
            _ => Ok(()),
        }
    }

    async fn build(
        &self,
        id: &str,
        options: &PushOptions,
        source: Source,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<BuildOutcome, Error> {
        let request = PushRequest {
            id: id.to_owned(),
            name: options.name.clone(),
            source,
            base: options.base.clone(),
            launch: options.launch.clone(),
            nodes: options.nodes.clone(),
            params: options.params.clone(),
            args: options.args.clone(),
            remaps: options.remaps.clone(),
            map: options.map.clone(),
            with: options.with.clone(),
        };
        let (sender, mut events) = mpsc::channel(EVENTS_AHEAD);
        let forwarded = async {
            while let Some(event) = events.recv().await {
                report.event(told::event(event, by)).await;
            }
        };
        let builder = Arc::clone(&self.builder);
        let work = async move { builder.build(&request, sender).await };
        // However this is left: what the build has begun is cleared away when it has seen so (`Pusher::run`).
        let work = privilege::run(report.building.track_future(work));
        let (built, ()) = tokio::join!(work, forwarded);
        built.map_err(|error| told::error(&error, &self.home, &options.source))
    }
}

/// What is published, before it was started once.
enum Made {
    Built(Box<BuildOutcome>),
    Imported(Box<Imported>),
}

fn layer(of: &rootfs_builder::BuiltLayer) -> api::push::Layer {
    api::push::Layer {
        name: of.name.to_owned(),
        digest: of.info.digest.to_string(),
        size: of.info.size,
        cached: of.cached,
    }
}

fn plan_of(built: &BuildOutcome, options: &PushOptions) -> Plan {
    let mut environment = built.environment.clone();
    environment.extend(built.flavour.environment(HOME_INSIDE));
    let mut nodes: Vec<_> = built
        .plan
        .nodes
        .iter()
        .map(|node| node.spec(HOME_INSIDE))
        .collect();
    for node in &mut nodes {
        naming::tell_parameters(&built.flavour, node, &built.plan.parameters);
    }
    Plan {
        environment,
        nodes,
        parameters: built.plan.parameters.clone(),
        components: built.plan.components.clone(),
        limits: options.limits,
        caps: options.caps,
        sla: options.sla,
        grants: options.grants.clone(),
        // A launch file says itself which nodes come again.
        restart: options.launch.is_none(),
        stateful: options.stateful,
        shared: options.shared,
    }
}
