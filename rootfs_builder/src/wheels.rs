//! Layers of Python packages that provide ROS: downloaded by the host's pip as pinned, and installed below a prefix by
//! the base's own Python in a container without network.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use image::{Digest, TreeOptions};
use servant::container::{Mount, Profile};

use crate::base::{Base, Wheels};
use crate::bootstrap::{EPOCH, tree_options};
use crate::cache_cleanup::{self, DOWNLOADS};
use crate::error::{Error, IoContext};
use crate::event::Progress;
use crate::install::{LayerSet, link_or_copy, write_tree};
use crate::key::Key;
use crate::modes::set_mode;
use crate::process::{self, Stream};
use crate::requirements::Requirements;
use crate::sandbox::SandboxRun;
use crate::workshop::{BuildContext, PackJob};

const INSTALL: &str = include_str!("inside/wheels.py");

/// Adds the layer with the wheels of every image of this base to a base layer.
pub(crate) async fn add_runtime_wheels(
    shop: &BuildContext,
    base: &Base,
    mut made: LayerSet,
    progress: &Progress,
) -> Result<LayerSet, Error> {
    if let Some(wheels) = &base.wheels {
        let below: Vec<Digest> = made.diff_ids().collect();
        let part = WheelSet { name: "base", wheels, wanted: &base.required.runtime, files: Some(&wheels.files) };
        let more = wheel_layer(shop, base, &part, &below, progress).await?;
        made.layers.extend(more.layers);
    }
    Ok(made)
}

/// Returns the layer with the wheels present only while a package is compiled. `below` are base and toolchain.
pub(crate) async fn add_build_wheels(
    shop: &BuildContext,
    base: &Base,
    below: &[Digest],
    progress: &Progress,
) -> Result<LayerSet, Error> {
    let Some(wheels) = &base.wheels else {
        return Ok(LayerSet::default());
    };
    let part = WheelSet { name: "toolchain", wheels, wanted: &base.required.build, files: None };
    wheel_layer(shop, base, &part, below, progress).await
}

/// Python packages of one layer.
struct WheelSet<'a> {
    /// Name of the layer, for messages.
    name: &'static str,
    wheels: &'a Wheels,
    wanted: &'a Requirements,
    /// Additional files.
    files: Option<&'a BTreeMap<PathBuf, String>>,
}

/// Returns the layer of a set of wheels, on top of `below`, which contains Python.
async fn wheel_layer(
    shop: &BuildContext,
    base: &Base,
    part: &WheelSet<'_>,
    below: &[Digest],
    progress: &Progress,
) -> Result<LayerSet, Error> {
    let WheelSet { name, wheels, wanted, .. } = *part;
    if wanted.len() == 0 {
        return Ok(LayerSet::default());
    }
    let key = Key::new("wheels")
        .input("script", INSTALL)
        .input("strip", serde_json::to_string(&base.strip).unwrap_or_default())
        .input("wheels", serde_json::to_string(wheels).unwrap_or_default())
        .input("requirements", wanted.key())
        .inputs("below", below.iter().map(Digest::to_string))
        .finish();
    let turn = shop.lock_key(&key).await;
    if let Some(layer) = shop.get_cached(&key).await?.and_then(|entry| entry.layer) {
        return Ok(LayerSet::single(layer.diff_id, true));
    }
    let files = download_wheels(shop.layers.cache(), wheels, wanted, progress).await?;
    let (upper, options) = install_wheels(shop, base, part, below, &files, progress).await?;
    progress.step(&format!("packing the {name}")).await;
    let packing = PackJob {
        key,
        made_from: wanted.versions().collect(),
        directory: upper.parent().unwrap_or(&upper).to_owned(),
        tree: upper,
        options,
        turn,
    };
    Ok(LayerSet::single(shop.pack(packing, |_| Ok(())).await?, false))
}

/// Returns the wheels, from the cache or downloaded now, sorted by name.
async fn download_wheels(
    cache: &Path,
    wheels: &Wheels,
    wanted: &Requirements,
    progress: &Progress,
) -> Result<Vec<PathBuf>, Error> {
    let place = cache.join(DOWNLOADS).join(&wanted.key()[..16]);
    if let Some(files) = cached_wheels(&place, wanted).await? {
        return Ok(files);
    }
    let parent = cache.join(DOWNLOADS);
    fs::create_dir_all(&parent).io_context("making", &parent)?;
    let partial = tempfile::Builder::new()
        .prefix(".partial-")
        .tempdir_in(&parent)
        .io_context("creating a directory in", &parent)?;
    fetch_wheels(partial.path(), wheels, wanted, progress).await?;
    let fetched = partial.path().join("files");
    // Another daemon may have been faster; an incomplete directory is useless.
    if cached_wheels(&place, wanted).await?.is_none() {
        match fs::remove_dir_all(&place) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                return Err(Error::io("removing", &place, error));
            }
            _ => fs::rename(&fetched, &place).io_context("keeping", &fetched)?,
        }
    }
    cached_wheels(&place, wanted)
        .await?
        .ok_or_else(|| Error::Wheels { words: "pip's downloads do not match the requirements".to_owned() })
}

/// Returns the files of a directory, if they satisfy all requirements.
async fn cached_wheels(place: &Path, wanted: &Requirements) -> Result<Option<Vec<PathBuf>>, Error> {
    let (place, wanted) = (place.to_owned(), wanted.clone());
    crate::blocking::spawn(move || {
        let entries = match fs::read_dir(&place) {
            Ok(entries) => entries,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(Error::io("reading", &place, error)),
        };
        let mut found = BTreeMap::new();
        for entry in entries {
            let path = entry.io_context("reading", &place)?.path();
            let bytes = fs::read(&path).io_context("reading", &path)?;
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if let Some(name) = wanted.matching_name(&name, &bytes) {
                found.insert(name.to_owned(), path.clone());
            }
        }
        let whole = found.len() == wanted.len();
        found.values().for_each(|path| cache_cleanup::mark_used(path));
        Ok(whole.then(|| found.into_values().collect()))
    })
    .await?
}

/// Downloads wheels with the host's pip, from its configured source.
async fn fetch_wheels(place: &Path, wheels: &Wheels, wanted: &Requirements, progress: &Progress) -> Result<(), Error> {
    let total = wanted.len() as u64;
    let title = format!("downloading {total} Python packages");
    progress.step(&title).await;
    let list = place.join("requirements.txt");
    fs::write(&list, wanted.text()).io_context("writing", &list)?;
    let mut pip = process::command("pip3");
    pip.args(["download", "--no-input", "--disable-pip-version-check"])
        .args(["--progress-bar", "off", "--no-deps", "--require-hashes"])
        .args(["--only-binary", ":all:", "--implementation", "cp"])
        .args(["--python-version", &wheels.python])
        .args(wheels.abis().flat_map(|abi| ["--abi".to_owned(), abi]))
        .args(wheels.platforms(std::env::consts::ARCH).flat_map(|platform| ["--platform".to_owned(), platform]))
        .arg("--dest")
        .arg(place.join("files"))
        .arg("--requirement")
        .arg(&list);
    let mut done = 0;
    let result = process::run(pip, "python3-pip", |stream, line| {
        if stream == Stream::Out && line.starts_with("Collecting ") {
            done += 1;
            progress.count("packages", done, Some(total));
        }
    })
    .await;
    match result {
        Err(Error::Program { last_lines, .. }) => Err(Error::Wheels { words: pip_errors(&last_lines) }),
        result => result,
    }
}

/// Extracts the error messages from the output of pip.
fn pip_errors(lines: &str) -> String {
    let errors = lines.lines().filter_map(|line| line.strip_prefix("ERROR: "));
    let errors: Vec<&str> = errors.collect();
    if errors.is_empty() { lines.to_owned() } else { errors.join("; ") }
}

/// Installs wheels in a container on top of `below`; returns the container's upper directory, in a separate directory,
/// and the options for packing it.
async fn install_wheels(
    shop: &BuildContext,
    base: &Base,
    part: &WheelSet<'_>,
    below: &[Digest],
    files: &[PathBuf],
    progress: &Progress,
) -> Result<(PathBuf, TreeOptions), Error> {
    let WheelSet { name, wheels, .. } = *part;
    let total = files.len() as u64;
    let title = format!("installing {total} Python packages of the {name}");
    progress.step(&title).await;
    let directory = shop.site.fresh_directory("wheels")?;
    let (tools, given, upper) = (directory.join("tools"), directory.join("given"), directory.join("upper"));
    for path in [&given, &upper] {
        fs::create_dir(path).io_context("making", path)?;
    }
    set_mode(&given, 0o755)?;
    let mut names = Vec::new();
    for file in files {
        let name = file.file_name().unwrap_or_default();
        link_or_copy(file, &given.join(name))?;
        names.push(name.to_string_lossy().into_owned());
    }
    let job = serde_json::json!({
        "prefix": wheels.prefix,
        "rewrite": wheels.rewrite,
        "wheels": names,
        "files": part.files.cloned().unwrap_or_default(),
    });
    let tools_of = BTreeMap::from([
        ("cloudroid/wheels.py".into(), INSTALL.as_bytes().to_vec()),
        ("cloudroid/job.json".into(), job.to_string().into_bytes()),
        ("cloudroid/wheels/.keep".into(), Vec::new()),
    ]);
    write_tree(&tools, &tools_of)?;
    let mut layers = shop.extract_layers(below).await?;
    layers.push(tools);
    let environment = [
        ("SOURCE_DATE_EPOCH", EPOCH.to_string()),
        ("PYTHONHASHSEED", "0".to_owned()),
        ("LC_ALL", "C.UTF-8".to_owned()),
    ];
    let environment = environment.map(|(name, value)| (name.to_owned(), value));
    let mut done = 0;
    let finished = shop
        .site
        .run(
            SandboxRun {
                name: "wheels",
                profile: Profile::Install,
                layers,
                writable: Some(upper.clone()),
                owned: Vec::new(),
                mounts: vec![Mount {
                    source: given,
                    target: "/cloudroid/wheels".into(),
                    writable: false,
                    device: false,
                    opened: None,
                }],
                environment: environment.into(),
                argv: ["/usr/bin/python3", "-I", "/cloudroid/wheels.py", "/cloudroid/job.json", "/cloudroid/wheels"]
                    .map(str::to_owned)
                    .into(),
            },
            |line| {
                if line.starts_with("::wheel ") {
                    done += 1;
                    progress.count("packages", done, Some(total));
                }
            },
        )
        .await?;
    if !finished.success() {
        return Err(Error::Inside { what: "installing Python packages", last_lines: finished.last_output() });
    }
    let options = TreeOptions { uid_offset: finished.uid_offset, overlay_upper: true, ..tree_options(base) };
    Ok((upper, options))
}

#[cfg(test)]
mod tests;
