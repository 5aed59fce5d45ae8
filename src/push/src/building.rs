//! Builds an image of what was received: it is inspected, waits for its turn, and is built or imported.

use std::collections::BTreeMap;
use std::future::Future;
use std::path::PathBuf;
use std::sync::Arc;

use api::PushOptions;
use rootfs_builder::{
    BuildEvent, BuildOutcome, BuildResult, BuiltUnderlay, InspectedPush, NamedUnderlay, PushRequest, PushSource,
};
use store::UnderlayRecord;
use tokio::sync::mpsc;

use super::pusher::EVENTS_AHEAD;
use super::reporter::Reporter;
use super::service_record::ImportedService;
use super::{Deployer, Error, Pusher, deployer_text, receive, service_record};

impl Pusher {
    /// Looks at what was received: a service that another server has exported, or something to build.
    pub(super) async fn inspect(
        &self,
        id: &str,
        options: &PushOptions,
        source: PushSource,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<PushedWork, Error> {
        match &source {
            PushSource::Packaged(package) => {
                // Names of Debian packages contain hyphens, those of ROS packages do not.
                if let (Some(name), false) = (&options.name, package.contains('-')) {
                    self.check_owner(name, std::slice::from_ref(package))?;
                }
            }
            PushSource::Tree(tree) => {
                let of = tree.clone();
                if privilege::spawn_blocking(move || service_record::is_exported(&of)).await.unwrap_or(false) {
                    return Ok(PushedWork::Exported(tree.clone()));
                }
                if let Some(name) = &options.name {
                    let of = tree.clone();
                    let look = move || privilege::run_as_reader(|| receive::package_names(&of));
                    let packages =
                        privilege::spawn_blocking(look).await.map_err(|_| Error::Internal("inspecting the package"))?;
                    self.check_owner(name, &packages)?;
                }
            }
        }
        self.inspect_request(options, build_request(id, options, source), (by, report)).await
    }

    /// Looks at what is to be built, upon the underlays that it names.
    async fn inspect_request(
        &self,
        options: &PushOptions,
        mut request: PushRequest,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<PushedWork, Error> {
        let found = self.find_underlays(&options.on, by)?;
        let underlays = found.iter().map(|(record, _)| (record.name.clone(), record.number)).collect();
        let named = found.into_iter().map(|(record, contents)| NamedUnderlay { name: record.name, contents });
        request.underlays = named.collect();
        let (builder, of) = (Arc::clone(&self.builder), request.clone());
        let look = |events| async move { builder.inspect(&of, events).await };
        let inspected = self.run_builder(options, look, (by, report)).await?;
        Ok(PushedWork::Build(Box::new(BuildWork { request, inspected, underlays })))
    }

    /// Looks again at a push whose underlays were published anew or removed while it waited for its place.
    pub(super) async fn renew_underlays(
        &self,
        options: &PushOptions,
        work: PushedWork,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<PushedWork, Error> {
        let build = match work {
            PushedWork::Build(build) => build,
            exported @ PushedWork::Exported(_) => return Ok(exported),
        };
        let found = self.find_underlays(&options.on, by)?;
        let is_same = |(record, _): &(UnderlayRecord, _)| build.underlays.get(&record.name) == Some(&record.number);
        if found.iter().all(is_same) {
            return Ok(PushedWork::Build(build));
        }
        self.inspect_request(options, build.request, (by, report)).await
    }

    /// Builds or imports the image.
    pub(super) async fn build_or_import(
        &self,
        options: &PushOptions,
        work: PushedWork,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<PushedImage, Error> {
        let BuildWork { request, inspected, underlays } = match work {
            PushedWork::Exported(tree) => return self.import(options, tree, report).await,
            PushedWork::Build(work) => *work,
        };
        report.step("preparing the build").await;
        let builder = Arc::clone(&self.builder);
        let build = |events| async move { builder.build(&request, inspected, events).await };
        Ok(match self.run_builder(options, build, (by, report)).await? {
            BuildResult::Service(built) => PushedImage::Built(Box::new((*built, underlays))),
            BuildResult::Underlay(built) => PushedImage::Underlay(built),
        })
    }

    /// Runs work of the builder with the privileges that it needs, and forwards what it reports.
    async fn run_builder<T, F>(
        &self,
        options: &PushOptions,
        work: impl FnOnce(mpsc::Sender<BuildEvent>) -> F,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<T, Error>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, rootfs_builder::Error>> + Send + 'static,
    {
        let (sender, events) = mpsc::channel(EVENTS_AHEAD);
        let forwarded = self.forward_events(events, by, report);
        // If this future is dropped, the files of the build are removed once the builder has noticed (`Pusher::run`).
        let work = privilege::run(report.building.track_future(work(sender)));
        let (done, ()) = tokio::join!(work, forwarded);
        done.map_err(|error| deployer_text::to_push_error(&error, &self.home, &options.source))
    }
}

/// Returns what is to be built.
fn build_request(id: &str, options: &PushOptions, source: PushSource) -> PushRequest {
    PushRequest {
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
        created: options.created,
        packages_up_to: options.packages_up_to.clone(),
        packages_skip: options.packages_skip.clone(),
        cmake_args: options.cmake_args.clone(),
        underlays: Vec::new(),
        as_underlay: options.as_underlay.is_some(),
    }
}

/// Next step of an inspected push.
pub(super) enum PushedWork {
    /// Build it.
    Build(Box<BuildWork>),
    /// Import the exported service in this tree.
    Exported(PathBuf),
}

/// Something to build.
pub(super) struct BuildWork {
    request: PushRequest,
    inspected: InspectedPush,
    /// Underlays that it is built on, with their revisions.
    underlays: BTreeMap<String, u64>,
}

/// Result of building or importing, before it is probed or published.
pub(super) enum PushedImage {
    /// The image of a service, with the underlays that it stands on and their revisions.
    Built(Box<(BuildOutcome, BTreeMap<String, u64>)>),
    /// An exported service.
    Imported(Box<ImportedService>),
    /// An underlay, of which nothing is run.
    Underlay(Box<BuiltUnderlay>),
}
