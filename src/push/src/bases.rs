//! Bases: what there is, export, and import of an untrusted archive.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use api::Size;
use api::bases::{BaseDetail, BaseFinding, BaseState, BaseSummary};
use catalogue::names;
use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use image::ArchiveKind;
use rootfs_builder::{BaseImport, BaseReport, Builder, ImportSource, blocking};
use tokio::sync::mpsc;

use super::deployer_text::{TREE_DIRECTORY, to_push_error};
use super::reporter::Reporter;
use super::{Archive, Error, Pusher, receive};
use store::NewEvent;

/// Request to make a base from an image or a root file system.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewBase {
    /// Name of the base.
    pub name: String,
    /// True if an imported base of this name is replaced.
    pub replace: bool,
    /// ROS distribution that counts, if there are several, or if nothing says which it is.
    pub ros_distribution: Option<String>,
}

impl Pusher {
    /// Returns all bases.
    pub async fn bases(&self) -> Result<Vec<BaseSummary>, Error> {
        let reports = self.ask_builder(|builder| builder.bases()).await?;
        Ok(reports.iter().map(to_summary).collect())
    }

    /// Returns a base with its contents.
    pub async fn base(&self, name: &str) -> Result<BaseDetail, Error> {
        let name = name.to_owned();
        self.ask_builder(move |builder| builder.base(&name)).await.map(to_detail)
    }

    /// Writes a base to a file, which it returns with its size.
    pub async fn export_base(&self, name: &str) -> Result<(File, u64), Error> {
        self.disks.check().await?;
        let name = name.to_owned();
        let exported = self.ask_builder(move |builder| builder.export_base(&name)).await?;
        Ok((exported.file, exported.bytes))
    }

    /// Imports an exported base, in place of that of the same name; runs to completion even if the caller stops
    /// waiting.
    pub async fn import_base(self: &Arc<Self>, archive: Archive) -> Result<BaseDetail, Error> {
        let receive = |pusher: Arc<Self>, directory: PathBuf| {
            async move { pusher.receive_base(archive, &directory).await }.boxed()
        };
        self.run_import(receive, |base| format!("base {} was imported", base.name)).await
    }

    /// Makes a base from an image or a root file system; runs to completion even if the caller stops waiting.
    pub async fn import_image(self: &Arc<Self>, archive: Archive, request: NewBase) -> Result<BaseDetail, Error> {
        let receive = |pusher: Arc<Self>, directory: PathBuf| {
            async move { pusher.receive_image(archive, &directory, request).await }.boxed()
        };
        self.run_import(receive, |base| format!("base {} was made of {}", base.name, base.summary)).await
    }

    /// Runs `receive` with the path of a directory of its own, which is removed at the end, and tells of the base that
    /// it names.
    async fn run_import(
        self: &Arc<Self>,
        receive: impl FnOnce(Arc<Self>, PathBuf) -> BoxFuture<'static, Result<String, Error>>,
        message: fn(&BaseSummary) -> String,
    ) -> Result<BaseDetail, Error> {
        let directory = self.home.join("build").join(format!("base-{}", names::random(8)));
        let receiving = receive(Arc::clone(self), directory.clone());
        let pusher = Arc::clone(self);
        let work = async move {
            let limit = pusher.options.time;
            let outcome = tokio::select! {
                outcome = tokio::time::timeout(limit, blocking::cancellable(receiving)) => {
                    outcome.unwrap_or_else(|_| Err(too_long_error(limit)))
                }
                error = pusher.disks.wait_until_low() => Err(error),
                () = pusher.cancel.cancelled() => Err(Error::Ending),
            };
            let removed = privilege::spawn_blocking(move || foreign::remove(&directory)).await;
            if let Ok(Err(error)) = removed {
                tracing::warn!("leftovers of an imported base remain until the next start: {error}");
            }
            // Layers of what was refused, or replaced.
            pusher.collect_garbage().await;
            let imported = pusher.base(&outcome?).await?;
            pusher.journal.info("base-imported", &message(&imported.summary), &NewEvent::default());
            Ok(imported)
        };
        self.tasks.spawn(work).await.map_err(|_| Error::Internal("importing a base"))?
    }

    /// Forgets that a base was imported, so that the next push that uses it sets it up; one that was made from an image
    /// is gone. Returns what is known of it then, or was before.
    pub async fn forget_base(&self, name: &str) -> Result<BaseDetail, Error> {
        let before = self.base(name).await?;
        let owned = name.to_owned();
        self.ask_builder(move |builder| builder.forget_base(&owned)).await?;
        let message = format!("the imported base {name} was removed");
        self.journal.info("base-removed", &message, &NewEvent::default());
        match self.base(name).await {
            Err(Error::UnknownBase { .. }) => {
                self.collect_garbage().await;
                Ok(before)
            }
            now => now,
        }
    }

    async fn receive_base(&self, archive: Archive, directory: &Path) -> Result<String, Error> {
        self.disks.check().await?;
        let tree = directory.join(TREE_DIRECTORY);
        // Nobody listens to the progress: the client knows how much it has sent.
        let (events, _) = mpsc::channel(1);
        receive::unpack(archive, &tree, &self.options, &Reporter::new(events)).await?;
        let limits = self.layer_limits();
        self.ask_builder(move |builder| builder.import_base(&tree, &limits)).await
    }

    async fn receive_image(&self, archive: Archive, directory: &Path, request: NewBase) -> Result<String, Error> {
        self.disks.check().await?;
        // Before hundreds of megabytes are received for it.
        let (name, replace) = (request.name.clone(), request.replace);
        if let Err(error) = self.ask_builder(move |builder| builder.check_new_name(&name, replace)).await {
            self.discard(archive);
            return Err(error);
        }
        let tree = directory.join(TREE_DIRECTORY);
        let (events, _) = mpsc::channel(1);
        let report = Reporter::new(events);
        let (kind, archive) = receive::detect_kind(archive, &self.options).await?;
        let source = match kind {
            ArchiveKind::Image => {
                receive::unpack_image(archive, &tree, &self.options, &report).await?;
                ImportSource::Image(tree)
            }
            ArchiveKind::Root => ImportSource::Root(receive::store(archive, &tree, &self.options, &report).await?),
        };
        let NewBase { name, replace, ros_distribution } = request;
        let (import, limits) = (BaseImport { name, source, replace, ros_distribution }, self.layer_limits());
        self.ask_builder(move |builder| builder.import_image(&import, &limits)).await
    }

    fn layer_limits(&self) -> image::Limits {
        image::Limits { entries: self.options.entries, bytes: self.options.unpacked.0, ..image::Limits::default() }
    }

    /// Runs blocking work of the builder with access to the files of the cache.
    async fn ask_builder<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Builder) -> Result<T, rootfs_builder::Error> + Send + 'static,
    ) -> Result<T, Error> {
        let builder = Arc::clone(&self.builder);
        let work = blocking::cancel_with_caller(move || work(&builder));
        let done = privilege::spawn_blocking(work).await.map_err(|_| Error::Internal("reading the bases"))?;
        done.map_err(|error| self.to_base_error(error))
    }

    fn to_base_error(&self, error: rootfs_builder::Error) -> Error {
        use rootfs_builder::Error as E;
        match error {
            E::UnknownBase { name, known, .. } => {
                let exists = known.split(", ").map(str::to_owned).collect();
                Error::UnknownBase { name, exists }
            }
            E::BaseNotImported { .. } => Error::BaseNotImported(error.to_string()),
            E::BaseExists { .. } => Error::BaseExists(error.to_string()),
            E::BaseNotSetUp { .. } => Error::BaseNotSetUp(error.to_string()),
            error => to_push_error(&error, &self.home, "the file"),
        }
    }
}

fn too_long_error(limit: Duration) -> Error {
    Error::Failed {
        message: format!("importing the base took longer than {} s", limit.as_secs()),
        next: Some("import a smaller image, or raise time in [push] of the configuration".to_owned()),
        log: Vec::new(),
    }
}

fn to_summary(report: &BaseReport) -> BaseSummary {
    let BaseReport { base, stock, bytes } = report;
    let state = match stock {
        None => BaseState::NotSetUp,
        Some(stock) if stock.is_imported => BaseState::Imported,
        Some(_) => BaseState::Ready,
    };
    BaseSummary {
        name: base.name.clone(),
        summary: base.summary.clone(),
        ros: base.ros.ros_version().number(),
        distribution: base.ros_distribution.clone(),
        system: format!("{} {}", base.distribution, base.suite),
        state,
        toolchain: stock.as_ref().is_some_and(|stock| stock.has_toolchain()),
        bytes: Size(*bytes),
    }
}

fn to_detail(report: BaseReport) -> BaseDetail {
    let summary = to_summary(&report);
    let findings = report.base.definition.image.map(|image| image.findings).unwrap_or_default().into_iter();
    let findings = findings.map(|finding| BaseFinding {
        subject: finding.subject,
        found: finding.found,
        consequence: finding.consequence,
    });
    let includes = report.base.definition.runtime.packages;
    let (ros_packages, python_packages, debian_packages) =
        report.stock.map(|stock| (stock.ros, stock.python, stock.debian)).unwrap_or_default();
    BaseDetail { summary, includes, ros_packages, python_packages, debian_packages, findings: findings.collect() }
}
