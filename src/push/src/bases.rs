//! Bases: what there is, export, and import of an untrusted archive.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use api::Size;
use api::bases::{BaseDetail, BaseState, BaseSummary};
use catalogue::names;
use rootfs_builder::{BaseReport, Builder, blocking};
use tokio::sync::mpsc;

use super::reporter::Reporter;
use super::told::{PUSHED, to_push_error};
use super::{Archive, Error, Pusher, receive};
use store::NewEvent;

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
        let pusher = Arc::clone(self);
        let work = async move {
            let directory = pusher.home.join("build").join(format!("base-{}", names::random(8)));
            let outcome = tokio::select! {
                outcome = blocking::cancellable(pusher.receive_base(archive, &directory)) => outcome,
                () = pusher.cancel.cancelled() => Err(Error::Ending),
            };
            let removed = privilege::spawn_blocking(move || foreign::remove(&directory)).await;
            if let Ok(Err(error)) = removed {
                tracing::warn!("leftovers of an imported base remain until the next start: {error}");
            }
            let imported = pusher.base(&outcome?).await?;
            let message = format!("base {} was imported", imported.summary.name);
            pusher.journal.info("base-imported", &message, &NewEvent::default());
            Ok(imported)
        };
        self.tasks.spawn(work).await.map_err(|_| Error::Internal("importing a base"))?
    }

    /// Forgets that a base was imported, so that the next push that uses it sets it up; returns what is known of it
    /// then.
    pub async fn forget_base(&self, name: &str) -> Result<BaseDetail, Error> {
        let owned = name.to_owned();
        self.ask_builder(move |builder| builder.forget_base(&owned)).await?;
        let message = format!("the imported base {name} was removed");
        self.journal.info("base-removed", &message, &NewEvent::default());
        self.base(name).await
    }

    async fn receive_base(&self, archive: Archive, directory: &Path) -> Result<String, Error> {
        self.disks.check().await?;
        let tree = directory.join(PUSHED);
        // Nobody listens to the progress: the client knows how much it has sent.
        let (events, _) = mpsc::channel(1);
        receive::unpack(archive, &tree, &self.options, &Reporter::new(events)).await?;
        let limits =
            image::Limits { entries: self.options.entries, bytes: self.options.unpacked.0, ..image::Limits::default() };
        self.ask_builder(move |builder| builder.import_base(&tree, &limits)).await
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
            E::BaseNotSetUp { .. } => Error::BaseNotSetUp(error.to_string()),
            error => to_push_error(&error, &self.home, "the file"),
        }
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
    let includes = report.base.definition.runtime.packages;
    let (ros_packages, python_packages, debian_packages) =
        report.stock.map(|stock| (stock.ros, stock.python, stock.debian)).unwrap_or_default();
    BaseDetail { summary, includes, ros_packages, python_packages, debian_packages }
}
