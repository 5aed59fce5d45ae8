//! Publication pipeline: from an archive to a published revision, with progress events; also rollback and removal of
//! services.
//!
//! ```text
//!  body ─▶ unpack (confined to the tree) ─▶ build (layers, image) ─▶ probe (start once, record the interface)
//!                                                                      │
//!            new connections get the new revision ◀─ tags ◀─ database ◀┘
//! ```
//!
//! Nothing of a revision is visible until the database has it, so if anything fails, the earlier revision remains in
//! service. Pushes of the same service are serialized; others run concurrently. A push needs its client until the
//! archive is complete; then it runs by itself, and anyone who may can follow or cancel it ([`RunningPush`]).

#![forbid(unsafe_code)]

mod bases;
mod bounds;
mod building;
mod deployer;
mod deployer_text;
mod disks;
mod error;
mod forward;
mod interface_limits;
mod naming;
mod option_check;
mod options;
mod patience;
mod places;
mod probe;
mod publish;
mod pusher;
mod receive;
mod registry;
mod reporter;
mod request;
mod room;
mod running;
mod service_record;
mod shared;
mod stateful;
mod supplement;
mod underlays;

use std::collections::BTreeMap;
use std::time::Instant;

use api::PushOptions;
use catalogue::names;
use package::inventory::Inventory;
use package::requests;
use reach::group::shareable;
use rootfs_builder::{BuildOutcome, PushSource};

use bounds::PushBudget;
use building::PushedImage;
use deployer_text::TREE_DIRECTORY;
use places::QueuedPush;
use pusher::HOME_INSIDE;
use reporter::Reporter;
use service_record::ImportedService;
use store::{Plan, RevisionRecord};

pub use bases::NewBase;
pub use deployer::{Deployer, UnderlayUse};
pub use error::{Error, OptionsError};
pub use options::Options;
pub use pusher::{Pusher, PusherParts};
pub use receive::Archive;
pub use request::{Published, PushResult};
pub use running::{PushFollower, ReceptionGuard, RunningPush};
pub use service_record::{RECORD, ServiceRecord};

impl Pusher {
    /// Receives a push, and runs it when its turn comes, within its budget. `entered` is what counts it among the
    /// others; it outlives a push that is cancelled.
    async fn push<'a>(
        &'a self,
        id: &str,
        options: &PushOptions,
        (by, archive): (&Deployer, Archive),
        report: &Reporter,
        entered: &mut Option<QueuedPush<'a>>,
    ) -> Result<PushResult, Error> {
        let began = Instant::now();
        let asked_name = options.name.as_deref();
        let as_underlay = options.as_underlay.as_deref().map(underlays::lock_name);
        let known = asked_name.or(options.apt.as_deref()).or(as_underlay.as_deref());
        *entered = Some(self.places.enter()?);
        self.disks.check().await?;
        self.check_quota(by.owner.as_deref(), None).await?;
        let build = self.home.join("build").join(id);
        let mut left = PushBudget::new(&self.options, build, &self.disks);
        let source = left.run_within(Box::pin(self.receive(id, options, archive, report))).await?;
        // From here on the push needs no client.
        report.received.cancel();
        // Whoever has forgotten something need not wait for others to be told so.
        report.step("looking at what was pushed").await;
        let work = left.run_within(Box::pin(self.inspect(id, options, source, (by, report)))).await?;
        let mut admitted = self.places.admit(known, report).await?;
        let work = left.run_within(Box::pin(self.renew_underlays(options, work, (by, report)))).await?;
        let made = left.run_within(Box::pin(self.build_or_import(options, work, (by, report)))).await?;
        let (built, underlays, imported) = match made {
            PushedImage::Built(built) => {
                let (built, underlays) = *built;
                (built, underlays, None)
            }
            PushedImage::Underlay(built) => {
                let (layers, underlay, unchanged) = self.publish_underlay(options, *built, (by, report)).await?;
                let published = Published::Underlay(Box::new(underlay));
                return Ok(PushResult { layers, published, took: began.elapsed(), unchanged });
            }
            PushedImage::Imported(imported) => {
                let ImportedService { record, options, built } = *imported;
                // The exporting server allowed it; this one may not.
                self.check_request(&options, by)?;
                (built, BTreeMap::new(), Some((record, options)))
            }
        };
        let options = imported.as_ref().map_or(options, |(_, options)| options);
        let name = options.name.clone().unwrap_or_else(|| built.package.clone());
        names::validate_service(&name).map_err(catalogue::Error::from)?;
        if let Some(push) = self.registry.find_build(id) {
            push.set_service(&name);
        }
        if asked_name.is_none() {
            tracing::Span::current().record("service", &*name);
        }
        admitted.assign_service(&name, report).await?;
        // Pushes of one service are serialized, so its owner does not change until this push is done.
        by.check_may_publish(&name)?;
        let image = built.image.to_string();
        self.check_quota(by.owner.as_deref(), Some(&image)).await?;
        let mut plan = make_plan(&built, options);
        plan.underlays = underlays;
        if let Some((record, _)) = &imported {
            plan.restart = record.plan.restart;
        }
        let layers: Vec<_> = built.layers.iter().map(api_layer).collect();
        // Boxed: in an unoptimized build both together would overflow a thread's stack.
        let shown = Box::pin(self.probe_image(id, options, (built, plan), (name.clone(), by), report));
        let (record, inventory) = left.run_within(shown).await?;
        // The token may have been revoked meanwhile.
        by.check_may_publish(&name)?;
        // From here on the push cannot be cancelled: a published revision must not be reported as cancelled.
        report.publishing.cancel();
        let terms = options.rollout;
        let unchanged = self.find_unchanged(&record, terms).await?;
        if unchanged.is_none() {
            Box::pin(self.publish_and_rollout(record, inventory, terms, report)).await?;
        }
        if let Some((record, _)) = &imported {
            self.import_dictionary(&name, record, report);
        }
        let published = Published::Service(name);
        Ok(PushResult { layers, published, took: began.elapsed(), unchanged: unchanged.is_some() })
    }

    /// Receives what is pushed.
    async fn receive(
        &self,
        id: &str,
        options: &PushOptions,
        archive: Archive,
        report: &Reporter,
    ) -> Result<PushSource, Error> {
        if let Some(package) = &options.apt {
            return Ok(PushSource::Packaged(package.clone()));
        }
        report.step("receiving the package").await;
        let tree = self.home.join("build").join(id).join(TREE_DIRECTORY);
        receive::unpack(archive, &tree, &self.options, report).await?;
        Ok(PushSource::Tree(tree))
    }

    /// Probes the interface of an image; returns the revision to publish.
    async fn probe_image(
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
        let found = probe::probe_interface(self, id, &built, &mut plan, options, report);
        let found = Box::pin(found).await?;
        for warning in found.warnings {
            report.warning(warning).await;
        }
        let mut interface = found.interface;
        if let Some(text) = &options.interface {
            let known = (built.flavour.ros.ros_version(), &built.inventory.definitions);
            supplement::add(&mut interface, text, known).map_err(|error| OptionsError::Supplement(Box::new(error)))?;
        }
        interface_limits::check_interface(&interface)?;
        let ros = built.flavour.ros.ros_version();
        let decided = requests::decide_requests(ros, &interface, &found.watched);
        let stated = options.parse_requests().map_err(OptionsError::RequestPair)?;
        let decided = requests::apply_stated(ros, &interface, &stated, decided).map_err(OptionsError::Requests)?;
        for request in &decided {
            report.request(request).await;
        }
        interface.requests = Some(decided);
        if !(options.stateful || options.stateless) {
            let signs = stateful::find_signs(&interface, &found.growing);
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
        if let Some(problem) = self.catalogue.find_types_without_twins(&record) {
            report.warning(problem.to_string()).await;
        }
        report.step(api::push::PUBLISHING).await;
        Ok((record, built.inventory))
    }

    /// Checks that the service belongs to the package that it was first built from.
    fn check_owner(&self, name: &str, packages: &[String]) -> Result<(), Error> {
        match (self.catalogue.service_package(name)?, packages) {
            (Some(owner), [first, ..]) if !packages.contains(&owner) => {
                Err(Error::NameTaken { name: name.to_owned(), package: owner, newcomer: first.clone() })
            }
            _ => Ok(()),
        }
    }
}

/// Describes a layer for the deployer.
fn api_layer(of: &rootfs_builder::BuiltLayer) -> api::push::Layer {
    api::push::Layer {
        name: of.name.to_owned(),
        digest: of.info.digest.to_string(),
        size: of.info.size,
        cached: of.cached,
    }
}

fn make_plan(built: &BuildOutcome, options: &PushOptions) -> Plan {
    let mut environment = built.environment.clone();
    environment.extend(built.flavour.environment(HOME_INSIDE));
    let mut nodes: Vec<_> = built.plan.nodes.iter().map(|node| node.to_node_spec(HOME_INSIDE)).collect();
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
        // A launch file specifies itself which nodes are respawned.
        restart: options.launch.is_none(),
        stateful: options.stateful,
        shared: options.shared,
        underlays: BTreeMap::new(),
    }
}
