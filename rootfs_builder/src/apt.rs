//! Access to the distribution's archive through apt with a separate state directory: the host's apt is not changed, and
//! the host needs only apt itself.
//!
//! Input: names of Debian packages, and the dpkg status of what is installed. Output: exact versions, and the package
//! files.

mod output;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use nix::fcntl::{Flock, FlockArg};
use tokio::process::Command;

use crate::cache::write_atomically;
use crate::cache_cleanup;
use crate::candidates::Candidates;
use crate::debian_package::{Deb, Relations};
use crate::error::{Error, IoContext};
use crate::event::Progress;
use crate::process::{self, Stream};
use output::{NAMING, extract_errors, parse_relations, parse_stanza, parse_uri, suggest_next_step};

/// Package sources: lines of a sources.list for each base that is listed. Other bases use the host's own apt sources,
/// if the host has the same release, and otherwise mmdebstrap's default mirror.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Sources(pub BTreeMap<String, Vec<String>>);

/// apt with a separate state directory.
#[derive(Debug, Clone)]
pub struct Apt {
    root: PathBuf,
}

/// Age at which the package lists are fetched again before use.
const FRESH: Duration = Duration::from_secs(24 * 3600);

impl Apt {
    /// Prepares the state directory without network access. `sources` are lines of a sources.list.
    pub fn open(root: &Path, sources: &str) -> Result<Self, Error> {
        for directory in ["state/lists/partial", "cache", "archives", "parts"] {
            let path = root.join(directory);
            fs::create_dir_all(&path).io_context("making", &path)?;
        }
        let conf = CONFIGURATION.replace("@ROOT@", &root.display().to_string());
        for (name, text) in [("empty-status", ""), ("sources.list", sources), ("apt.conf", &conf)] {
            // Another daemon may be reading it, so a file with the right content is not touched.
            let path = root.join(name);
            if fs::read(&path).ok().as_deref() != Some(text.as_bytes()) {
                write_atomically(&path, text.as_bytes())?;
            }
        }
        Ok(Self { root: root.to_owned() })
    }

    fn command(&self, program: &str) -> Command {
        let mut command = process::command(program);
        // As an option, it is read after the host's own files and takes precedence.
        command.arg("-c").arg(self.root.join("apt.conf"));
        command
    }

    /// Fetches the package and Contents lists if they are missing or a day old, or if `force`d. If old lists exist, a
    /// failure is only returned as a warning.
    pub async fn refresh(&self, force: bool, progress: &Progress) -> Result<Option<String>, Error> {
        let stamp = self.root.join("updated");
        if !force && self.is_fresh() && self.compressed_lists()?.is_empty() {
            return Ok(None);
        }
        // One daemon at a time; the others then find fresh lists.
        let path = self.root.join("lock");
        let mut file = fs::File::create(&path).io_context("opening", &path)?;
        // Whoever can open the file can hold the lock.
        crate::modes::set_mode(&path, 0o600)?;
        // Polls instead of blocking a thread, so that no thread is left behind on cancellation.
        let _lock = loop {
            match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
                Ok(lock) => break lock,
                Err((again, nix::errno::Errno::EWOULDBLOCK)) => file = again,
                Err((_, error)) => return Err(Error::io("locking", &path, error.into())),
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        };
        let age = file_age(&stamp);
        let warning = if !force && self.is_fresh() { None } else { self.update(&stamp, age, progress).await? };
        for list in self.compressed_lists()? {
            self.unpack_list(&list).await?;
        }
        Ok(warning)
    }

    /// Fetches the lists; `age` is that of the existing ones.
    async fn update(&self, stamp: &Path, age: Option<Duration>, progress: &Progress) -> Result<Option<String>, Error> {
        progress.step("fetching package lists").await;
        let mut update = self.command("apt-get");
        update.args(["-q", "--error-on=any", "update"]);
        let mut lines = Vec::new();
        let result = process::run(update, "apt", |_, line| lines.push(line.to_owned())).await;
        let result = result.map_err(|error| match error {
            Error::Program { last_lines, .. } => {
                Error::Lists { next: suggest_next_step(&last_lines), words: extract_errors(&last_lines) }
            }
            error => error,
        });
        for line in lines {
            progress.log(&line).await;
        }
        match result {
            Ok(()) => {
                fs::write(stamp, "").io_context("writing", stamp)?;
                Ok(None)
            }
            Err(error) if age.is_some() => Ok(Some(format!("using the existing package lists: {error}"))),
            Err(error) => Err(error),
        }
    }

    /// Returns the package lists that apt has stored compressed: apt decompresses such a list from its beginning for
    /// every record that it looks up. If the host's apt stores them so, unchanged ones stay compressed.
    fn compressed_lists(&self) -> Result<Vec<PathBuf>, Error> {
        let lists = self.root.join("state/lists");
        let mut found = Vec::new();
        for entry in fs::read_dir(&lists).io_context("reading", &lists)? {
            let entry = entry.io_context("reading", &lists)?;
            if entry.file_name().to_string_lossy().contains("Packages.") {
                found.push(entry.path());
            }
        }
        Ok(found)
    }

    /// Replaces a compressed list by the uncompressed one; a list that apt cannot read is left as it is.
    async fn unpack_list(&self, list: &Path) -> Result<(), Error> {
        let directory = list.parent().unwrap_or(&self.root);
        let plain = tempfile::Builder::new()
            .prefix(".plain-")
            .permissions(fs::Permissions::from_mode(0o644))
            .tempfile_in(directory)
            .io_context("creating a file in", directory)?;
        let out = plain.reopen().io_context("opening", plain.path())?;
        let mut unpack = self.command("/usr/lib/apt/apt-helper");
        unpack.arg("cat-file").arg(list).stdout(out).stderr(std::process::Stdio::null());
        match unpack.status().await {
            Ok(status) if status.success() => {}
            result => {
                tracing::warn!(path = %list.display(), ?result, "a package list stays compressed, so lookups take \
                    longer");
                return Ok(());
            }
        }
        let to = list.with_extension("");
        plain.persist(&to).map_err(|error| Error::io("writing", &to, error.error))?;
        fs::remove_file(list).io_context("removing", list)
    }

    /// Returns the Contents lists, which map files to packages.
    pub fn contents_files(&self) -> Result<Vec<PathBuf>, Error> {
        let lists = self.root.join("state/lists");
        let mut files = Vec::new();
        for entry in fs::read_dir(&lists).io_context("reading", &lists)? {
            let path = entry.io_context("reading", &lists)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.contains("_Contents-") && name.ends_with(".gz") {
                files.push(path);
            }
        }
        files.sort();
        Ok(files)
    }

    /// Returns all installable packages at the versions that apt would choose. Cached next to the lists.
    pub async fn candidates(&self) -> Result<Candidates, Error> {
        let path = self.root.join("candidates");
        let stamp = self.stamp();
        let kept = fs::read_to_string(&path).unwrap_or_default();
        if let Some((of, lines)) = kept.split_once('\n')
            && of == stamp
        {
            return Ok(Candidates::from_lines(lines));
        }
        let mut query = self.command("apt-cache");
        query.arg("dumpavail");
        let (mut debs, mut stanza) = (Vec::new(), String::new());
        process::run(query, "apt", |stream, line| match stream {
            Stream::Out if line.is_empty() => debs.extend(parse_stanza(&std::mem::take(&mut stanza))),
            Stream::Out if NAMING.iter().any(|field| line.starts_with(field)) => {
                stanza.push_str(line);
                stanza.push('\n');
            }
            _ => {}
        })
        .await?;
        debs.extend(parse_stanza(&stanza));
        let candidates: Candidates = debs.into_iter().collect();
        let text = format!("{stamp}\n{}", candidates.as_text());
        write_atomically(&path, text.as_bytes())?;
        Ok(candidates)
    }

    /// Returns the packages to install, in an order accepted by dpkg, so that all of `names` are installed, given a
    /// dpkg status file (none for an empty system). Recommended packages are not installed.
    pub async fn resolve(&self, status: Option<&Path>, names: &BTreeSet<String>) -> Result<Vec<Deb>, Error> {
        if names.is_empty() {
            return Ok(Vec::new());
        }
        if let Some(name) = names.iter().find(|name| !is_package_name(name)) {
            return Err(Error::Unsolvable {
                wanted: name.clone(),
                words: "it is not the name of a Debian package".to_owned(),
            });
        }
        let status = status.map_or_else(|| self.root.join("empty-status"), Path::to_owned);
        // Derived from what apt would fetch, which is in the order of unpacking. A simulated installation gives the
        // same result but takes five times as long, since it goes through all packages after each one.
        let mut ask = self.command("apt-get");
        ask.arg("-o").arg(format!("Dir::State::status={}", status.display()));
        ask.args(["-q", "--print-uris", "-y", "--no-install-recommends", "--no-remove", "install", "--"]);
        ask.args(names);
        match process::output(ask, "apt").await {
            Ok(text) => Ok(text.lines().filter_map(parse_uri).collect()),
            Err(Error::Program { last_lines, .. }) => Err(Error::Unsolvable {
                wanted: names.iter().map(String::as_str).collect::<Vec<_>>().join(", "),
                words: extract_errors(&last_lines),
            }),
            Err(error) => Err(error),
        }
    }

    /// Returns the relations of packages, by name. `names` are `NAME` for the candidate, or `NAME=VERSION`; packages
    /// that are not in the lists are left out.
    pub async fn relations(
        &self,
        names: impl IntoIterator<Item = String>,
    ) -> Result<BTreeMap<String, Relations>, Error> {
        let mut names = names.into_iter().peekable();
        // apt-cache fails without arguments.
        if names.peek().is_none() {
            return Ok(BTreeMap::new());
        }
        let mut query = self.command("apt-cache");
        query.args(["--no-all-versions", "show", "--"]).args(names);
        let text = process::output(query, "apt").await?;
        let mut all: BTreeMap<String, Relations> = BTreeMap::new();
        for (name, about) in text.split("\n\n").filter_map(parse_relations) {
            // A version from two sources may be listed twice.
            let there = all.entry(name).or_default();
            there.source = about.source;
            there.needs.extend(about.needs);
            there.before.extend(about.before);
            there.provides.extend(about.provides);
        }
        Ok(all)
    }

    /// Returns the files of packages, in the same order; those not in the cache are fetched and verified by apt.
    pub async fn download(&self, debs: &[Deb], progress: &Progress) -> Result<Vec<PathBuf>, Error> {
        let archives = self.root.join("archives");
        let missing: Vec<&Deb> = debs.iter().filter(|deb| !archives.join(deb.file_name()).is_file()).collect();
        if !missing.is_empty() {
            let total = missing.len() as u64;
            progress.step(&format!("downloading {total} packages")).await;
            // Downloaded into a separate directory and then renamed, so that files in `archives` are complete.
            let partial = tempfile::Builder::new()
                .prefix(".partial-")
                .tempdir_in(&archives)
                .io_context("creating a directory in", &archives)?;
            let mut download = self.command("apt-get");
            download.current_dir(partial.path()).args(["-q", "download", "--"]);
            download.args(missing.iter().map(|deb| format!("{}={}", deb.name, deb.version)));
            let mut done = 0;
            let result = process::run(download, "apt", |stream, line| {
                if stream == Stream::Out && line.starts_with("Get:") {
                    done += 1;
                    progress.count("packages", done, Some(total));
                }
            })
            .await;
            match result {
                Ok(()) => {}
                Err(Error::Program { last_lines, .. }) => {
                    // Usually the mirror has newer versions by now: the next push fetches the lists again.
                    let _ = fs::remove_file(self.root.join("updated"));
                    return Err(Error::Download { words: extract_errors(&last_lines) });
                }
                Err(error) => return Err(error),
            }
            for deb in missing {
                let from = partial.path().join(deb.file_name());
                fs::rename(&from, archives.join(deb.file_name())).io_context("keeping", &from)?;
            }
        }
        let files: Vec<PathBuf> = debs.iter().map(|deb| archives.join(deb.file_name())).collect();
        for file in &files {
            cache_cleanup::mark_used(file);
        }
        Ok(files)
    }

    /// Returns whether the lists are recent enough to be used.
    pub fn is_fresh(&self) -> bool {
        file_age(&self.root.join("updated")).is_some_and(|age| age < FRESH)
    }

    /// Returns the directory of lists and packages.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Returns a fingerprint of the lists.
    pub fn stamp(&self) -> String {
        let mut parts = Vec::new();
        let lists = self.root.join("state/lists");
        for entry in fs::read_dir(&lists).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.ends_with("Release") || name.ends_with("Packages") || name.contains("Packages.") {
                let about = entry.metadata().ok();
                let changed = about.as_ref().and_then(|m| m.modified().ok());
                let seconds = changed.and_then(|t| t.duration_since(SystemTime::UNIX_EPOCH).ok());
                let size = about.map_or(0, |m| m.len());
                parts.push(format!("{name} {size} {}", seconds.map_or(0, |s| s.as_secs())));
            }
        }
        parts.sort();
        crate::key::sha256(parts.join("\n").as_bytes())
    }
}

/// Returns whether a word is the name of a package in the archive (Debian policy, 5.6.1), as opposed to a local file
/// (`./x.deb`), a pattern, or another version or release, which apt, running as root, would also accept. One pattern
/// used by this crate is allowed.
fn is_package_name(name: &str) -> bool {
    let fits = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit();
    let mut bytes = name.bytes();
    name == "?essential"
        || bytes.next().is_some_and(fits) && bytes.all(|byte| fits(byte) || matches!(byte, b'+' | b'-' | b'.'))
}

/// Returns the time since a file was modified.
fn file_age(path: &Path) -> Option<Duration> {
    let changed = path.metadata().and_then(|about| about.modified()).ok()?;
    SystemTime::now().duration_since(changed).ok()
}

/// Differences from the host's apt. Hooks of the host's configuration are disabled. Debian has a Contents list for each
/// component, Ubuntu a single one.
const CONFIGURATION: &str = r#"
Dir::State "@ROOT@/state";
Dir::State::status "@ROOT@/empty-status";
Dir::Cache "@ROOT@/cache";
Dir::Cache::srcpkgcache "srcpkgcache.bin";
Dir::Cache::pkgcache "";
Dir::Etc::sourcelist "@ROOT@/sources.list";
Dir::Etc::sourceparts "@ROOT@/parts";
Dir::Etc::preferences "/dev/null";
Dir::Etc::preferencesparts "@ROOT@/parts";
APT::Sandbox::User "root";
APT::Default-Release "";
APT::Install-Recommends "false";
Acquire::Languages "none";
Acquire::Retries "3";
Acquire::GzipIndexes "false";
#clear APT::Update::Pre-Invoke;
#clear APT::Update::Post-Invoke;
#clear APT::Update::Post-Invoke-Success;
#clear DPkg::Pre-Install-Pkgs;
#clear DPkg::Pre-Invoke;
#clear DPkg::Post-Invoke;
Acquire::IndexTargets::deb::DEP-11::DefaultEnabled "false";
Acquire::IndexTargets::deb::DEP-11-icons-small::DefaultEnabled "false";
Acquire::IndexTargets::deb::DEP-11-icons::DefaultEnabled "false";
Acquire::IndexTargets::deb::Contents-deb {
  MetaKey "$(COMPONENT)/Contents-$(ARCHITECTURE)";
  flatMetaKey "Contents-$(ARCHITECTURE)";
  ShortDescription "Contents-$(ARCHITECTURE)";
  Description "$(RELEASE)/$(COMPONENT) $(ARCHITECTURE) Contents (deb)";
  KeepCompressed "true";
  KeepCompressedAs "gz";
};
Acquire::IndexTargets::deb::Contents-deb::DefaultEnabled "true";
Acquire::IndexTargets::deb::Contents-deb-legacy {
  MetaKey "Contents-$(ARCHITECTURE)";
  ShortDescription "Contents-$(ARCHITECTURE)";
  Description "$(RELEASE) $(ARCHITECTURE) Contents (deb)";
  KeepCompressed "true";
  KeepCompressedAs "gz";
  Fallback-Of "Contents-deb";
  Identifier "Contents-$(ARCHITECTURE)";
};
Acquire::IndexTargets::deb::Contents-deb-legacy::DefaultEnabled "true";
"#;

#[cfg(test)]
mod signed;
#[cfg(test)]
mod tests;
