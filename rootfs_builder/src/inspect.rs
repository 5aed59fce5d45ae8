//! Inspection of a push before it is built, and before it waits for a place among the builds: whether it is a
//! package, on which base, what it will run, and which dependencies nothing provides.

use std::sync::Arc;

use package::foreseen::{self, SourceProblem};
use package::workspace::{PushedDirectory, Workspace};
use tokio::sync::mpsc;

use crate::archive::Archive;
use crate::base::Base;
use crate::builder::Builder;
use crate::error::Error;
use crate::event::{BuildEvent, Progress};
use crate::indexed::{self, IndexedPackages};
use crate::pushed_packages::{self, InspectedTree};
use crate::request::{PushRequest, PushSource};
use crate::underlay::Foundation;
use crate::workshop::PushLabel;
use crate::{blocking, choice, keys, launch, middleware, source};

/// Maximum number of mistakes in build files that are named.
const MOST_PROBLEMS: usize = 20;
/// Maximum number of packages that are named when they are not built.
const MAX_NAMED_PACKAGES: usize = 12;

/// A push of which nothing is known that would keep it from being built.
#[derive(Debug)]
pub struct InspectedPush {
    pub(crate) base: Base,
    pub(crate) content: PushContent,
    pub(crate) foundation: Foundation,
}

/// Content of a push.
#[derive(Debug)]
pub(crate) enum PushContent {
    /// Content of the pushed tree.
    Tree(PushedDirectory),
    /// Name of a package of the archive.
    Packaged(String),
}

impl PushContent {
    /// Returns the main package, as far as known.
    fn name(&self) -> String {
        match self {
            Self::Tree(pushed) => {
                let packages = pushed_packages::sort_by_importance(pushed.packages());
                packages.into_iter().next().unwrap_or_default()
            }
            Self::Packaged(name) => name.clone(),
        }
    }
}

impl InspectedPush {
    /// Returns how the push is called for others that wait for it.
    pub(crate) fn label(&self, request: &PushRequest) -> PushLabel {
        let name = request.name.clone().unwrap_or_else(|| self.content.name());
        PushLabel { id: request.id.clone(), name }
    }
}

impl Builder {
    /// Looks at a push before it is built: it needs no place among the builds, and starts no container. Reading the
    /// package lists may take minutes once a day.
    ///
    /// # Errors
    /// It is no package, does not fit the base, does not say which of several programs to run, selects a middleware
    /// that the bus does not speak, or has dependencies that are known to be provided by nothing.
    pub async fn inspect(
        &self,
        request: &PushRequest,
        events: mpsc::Sender<BuildEvent>,
    ) -> Result<InspectedPush, Error> {
        blocking::cancellable(self.look_at(request, &Progress::new(events))).await
    }

    async fn look_at(&self, request: &PushRequest, progress: &Progress) -> Result<InspectedPush, Error> {
        // What was pushed may have hundreds of thousands of files: it is read on blocking threads.
        let asked = Arc::new(request.clone());
        let (bases, of) = (self.bases_dir().to_owned(), Arc::clone(&asked));
        let choose = move || choice::choose_base(&bases, of.base_name(), &of.source);
        let choice::ChosenBase { base, note } = blocking::spawn_reader(choose).await??;
        if let Some(note) = note {
            progress.warn(note).await;
        }
        middleware::check_options(request, base.ros)?;
        let foundation = Foundation::combine(&request.underlays, &base)?;
        // Before anything is downloaded: what was pushed may not be a package at all.
        let content = match &request.source {
            PushSource::Tree(path) => {
                let (tree, of, on) = (path.clone(), Arc::clone(&asked), base.clone());
                let inspect = move || pushed_packages::inspect_pushed(&tree, &on, &of.package_query());
                let InspectedTree { mut pushed, left_out } = blocking::spawn_reader(inspect).await??;
                middleware::check_packages(pushed.packages(), request, base.ros)?;
                if let PushedDirectory::Source(workspace) = pushed {
                    tell_selection(&workspace, &left_out, progress).await;
                    foundation.check_packages(&workspace.packages)?;
                    let (of, on) = (Arc::clone(&asked), base.clone());
                    let read = move || {
                        ask_what_to_run(&of, &workspace, &on)?;
                        middleware::check_sources(&workspace, &of, on.ros)?;
                        let problems = find_source_problems(&of, &workspace, &on)?;
                        Ok::<_, Error>((workspace, problems))
                    };
                    let (workspace, problems) = blocking::spawn_reader(read).await??;
                    tell_source_problems(&problems, progress).await;
                    pushed = PushedDirectory::Source(workspace);
                }
                PushContent::Tree(pushed)
            }
            PushSource::Packaged(name) => PushContent::Packaged(name.clone()),
        };
        if !matches!(content, PushContent::Tree(PushedDirectory::Source(_))) && request.has_build_options() {
            return Err(Error::NothingToCompile);
        }
        let inspected = InspectedPush { base, content, foundation };
        let label = inspected.label(request);
        let archive = self.archive(&label, &inspected.base, progress).await?;
        let layers = self.layers().clone();
        let check = move || {
            let base = &inspected.base;
            match &inspected.content {
                PushContent::Tree(pushed) => {
                    if let PushedDirectory::Source(workspace) = pushed {
                        source::check_tools(base, &archive, workspace)?;
                    }
                    let there = indexed::read_known(&layers, base, &archive);
                    check_dependencies((&archive, base), &asked, pushed, (there, &inspected.foundation))?;
                }
                PushContent::Packaged(_) => drop(keys::mapped_packages(&archive, base, &asked.map)?),
            }
            Ok::<_, Error>(inspected)
        };
        blocking::spawn(check).await?
    }
}

/// Fails before compiling if the sources show that the push must state what to run, or that there is no such launch
/// file. Blocking; reads what was pushed.
fn ask_what_to_run(request: &PushRequest, workspace: &Workspace, base: &Base) -> Result<(), Error> {
    let version = base.ros.ros_version();
    if let Some(launch) = &request.launch
        && foreseen::lacks_launch_file(workspace, launch, version)
    {
        let foreseen = foreseen::scan_sources(workspace, version);
        return Err(Error::NotInPackage {
            what: "launch file",
            name: launch.clone(),
            known: launch::join_names(&foreseen.launch_files),
            elsewhere: String::new(),
        });
    }
    if request.as_underlay || request.launch.is_some() || !request.nodes.is_empty() {
        return Ok(());
    }
    let foreseen = foreseen::scan_sources(workspace, version);
    if !foreseen.must_be_chosen() {
        return Ok(());
    }
    Err(Error::NothingToRun {
        executables: launch::join_names(&foreseen.executables),
        launch_files: launch::join_names(&foreseen.launch_files),
        more: "; nothing is compiled yet, so there may be more",
    })
}

/// Tells which packages are not built.
async fn tell_selection(workspace: &Workspace, left_out: &[String], progress: &Progress) {
    if left_out.is_empty() {
        return;
    }
    let built = workspace.packages.len();
    let more = if left_out.len() > MAX_NAMED_PACKAGES { ", …" } else { "" };
    let names = left_out[..left_out.len().min(MAX_NAMED_PACKAGES)].join(", ");
    let all = built + left_out.len();
    progress.step(&format!("building {built} of {all} packages; not needed, or skipped: {names}{more}")).await;
}

/// Warns of mistakes in build files.
async fn tell_source_problems(problems: &[SourceProblem], progress: &Progress) {
    for problem in problems.iter().take(MOST_PROBLEMS) {
        progress.warn(problem.to_string()).await;
    }
    if problems.len() > MOST_PROBLEMS {
        progress.warn(format!("{} more like these", problems.len() - MOST_PROBLEMS)).await;
    }
}

/// Returns mistakes in build files; fails if no program is left because of them. Blocking; reads what was pushed.
fn find_source_problems(
    request: &PushRequest,
    workspace: &Workspace,
    base: &Base,
) -> Result<Vec<SourceProblem>, Error> {
    let version = base.ros.ros_version();
    let problems = foreseen::find_problems(workspace, version);
    let is_own = |node: &String| {
        let program = node.split_whitespace().next().unwrap_or_default();
        let package = program.split_once('/').map(|(package, _)| package);
        package.is_none_or(|package| workspace.packages.iter().any(|own| own.manifest.name == package))
    };
    let runs_own = !request.as_underlay && request.launch.is_none() && request.nodes.iter().all(is_own);
    if runs_own && foreseen::has_no_programs(workspace, version) {
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        return Err(Error::NoPrograms { problems: problems.join("; ") });
    }
    Ok(problems)
}

/// Reports unresolvable dependencies now and not after minutes of preparation. In install spaces many may be in the
/// base itself; where `there`, its packages as the last build found them, is unknown, they are reported by the build.
/// Blocking.
fn check_dependencies(
    (archive, base): (&Archive, &Base),
    request: &PushRequest,
    pushed: &PushedDirectory,
    (there, foundation): (Option<IndexedPackages>, &Foundation),
) -> Result<(), Error> {
    let Some(mut there) = there.or(base.has_distributions_ros().then(IndexedPackages::default)) else {
        return Ok(());
    };
    let own = pushed_packages::names(pushed.packages());
    let mut asked = pushed_packages::required_keys(pushed.packages());
    if matches!(pushed, PushedDirectory::Installed(_)) {
        // It is compiled already.
        asked.build.clear();
        there.build = pushed_packages::build_tools(&asked);
    }
    foundation.add_to(&mut there);
    keys::resolve_keys(archive, base, &request.map, &own, &asked, &there)?;
    Ok(())
}

#[cfg(test)]
mod tests;
