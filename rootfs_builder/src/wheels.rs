//! Layers of Python packages that bring ROS: downloaded by the host's pip, as pinned, and put below a prefix by the base's own
//! Python in a container without network.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use image::{Digest, TreeOptions};
use servant::container::{Mount, Profile};

use crate::base::{Base, Wheels};
use crate::bootstrap::{EPOCH, tree_options};
use crate::error::{Error, IoAt};
use crate::event::Progress;
use crate::install::{Made, lay_out, link_or_copy, set_mode};
use crate::key::Key;
use crate::process::{self, Stream};
use crate::requirements::Requirements;
use crate::sandbox::Run;
use crate::unused;
use crate::workshop::{Packing, Workshop};

const INSTALL: &str = include_str!("inside/wheels.py");

/// Where downloaded wheels are, below the cache: a directory for each list of requirements.
pub(crate) const DOWNLOADS: &str = "wheels";

/// A base layer, and on top of it the one with the wheels that every image of this base has.
pub(crate) async fn on_base(
    shop: &Workshop,
    base: &Base,
    mut made: Made,
    progress: &Progress,
) -> Result<Made, Error> {
    if let Some(wheels) = &base.wheels {
        let below: Vec<Digest> = made.diff_ids().collect();
        let part = Part {
            name: "base",
            wheels,
            wanted: &base.required.runtime,
            files: Some(&wheels.files),
        };
        let more = layer(shop, base, &part, &below, progress).await?;
        made.layers.extend(more.layers);
    }
    Ok(made)
}

/// The layer with the wheels that are there while a package is compiled. `below`: base and toolchain.
pub(crate) async fn to_compile(
    shop: &Workshop,
    base: &Base,
    below: &[Digest],
    progress: &Progress,
) -> Result<Made, Error> {
    let Some(wheels) = &base.wheels else {
        return Ok(Made::default());
    };
    let part = Part {
        name: "toolchain",
        wheels,
        wanted: &base.required.build,
        files: None,
    };
    layer(shop, base, &part, below, progress).await
}

/// Packages that make one layer.
struct Part<'a> {
    /// Of what, for people.
    name: &'static str,
    wheels: &'a Wheels,
    wanted: &'a Requirements,
    /// Files that come with them.
    files: Option<&'a BTreeMap<PathBuf, String>>,
}

/// The layer of a part, on top of `below`, which has Python.
async fn layer(
    shop: &Workshop,
    base: &Base,
    part: &Part<'_>,
    below: &[Digest],
    progress: &Progress,
) -> Result<Made, Error> {
    let Part {
        name,
        wheels,
        wanted,
        ..
    } = *part;
    if wanted.len() == 0 {
        return Ok(Made::default());
    }
    let key = Key::new("wheels")
        .with("script", INSTALL)
        .with(
            "strip",
            serde_json::to_string(&base.strip).unwrap_or_default(),
        )
        .with("wheels", serde_json::to_string(wheels).unwrap_or_default())
        .with("requirements", wanted.key())
        .with_all("below", below.iter().map(Digest::to_string))
        .finish();
    let turn = shop.turn(&key).await;
    if let Some(layer) = shop.cached(&key).await?.and_then(|entry| entry.layer) {
        return Ok(Made::one(layer.diff_id, true));
    }
    let files = downloaded(shop.layers.cache(), wheels, wanted, progress).await?;
    let (upper, options) = install(shop, base, part, below, &files, progress).await?;
    progress.step(&format!("packing the {name}")).await;
    let packing = Packing {
        key,
        made_from: wanted.versions().collect(),
        directory: upper.parent().unwrap_or(&upper).to_owned(),
        tree: upper,
        options,
        turn,
    };
    Ok(Made::one(shop.pack(packing, |_| Ok(())).await?, false))
}

/// The wheels, from the cache or fetched now; sorted by name.
async fn downloaded(
    cache: &Path,
    wheels: &Wheels,
    wanted: &Requirements,
    progress: &Progress,
) -> Result<Vec<PathBuf>, Error> {
    let place = cache.join(DOWNLOADS).join(&wanted.key()[..16]);
    if let Some(files) = at_hand(&place, wanted).await? {
        return Ok(files);
    }
    let parent = cache.join(DOWNLOADS);
    fs::create_dir_all(&parent).at("making", &parent)?;
    let partial = tempfile::Builder::new()
        .prefix(".partial-")
        .tempdir_in(&parent)
        .at("making a directory in", &parent)?;
    fetch(partial.path(), wheels, wanted, progress).await?;
    let fetched = partial.path().join("files");
    // Another daemon may have been faster; what is there but not whole is of no use.
    if at_hand(&place, wanted).await?.is_none() {
        match fs::remove_dir_all(&place) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                return Err(Error::io("removing", &place, error));
            }
            _ => fs::rename(&fetched, &place).at("keeping", &fetched)?,
        }
    }
    at_hand(&place, wanted).await?.ok_or_else(|| Error::Wheels {
        words: "what pip fetched is not what the requirements name".to_owned(),
    })
}

/// The files of a directory, if they are all that is wanted.
async fn at_hand(place: &Path, wanted: &Requirements) -> Result<Option<Vec<PathBuf>>, Error> {
    let (place, wanted) = (place.to_owned(), wanted.clone());
    crate::blocking::spawn(move || {
        let entries = match fs::read_dir(&place) {
            Ok(entries) => entries,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(Error::io("reading", &place, error)),
        };
        let mut found = BTreeMap::new();
        for entry in entries {
            let path = entry.at("reading", &place)?.path();
            let bytes = fs::read(&path).at("reading", &path)?;
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if let Some(name) = wanted.asks_for(&name, &bytes) {
                found.insert(name.to_owned(), path.clone());
            }
        }
        let whole = found.len() == wanted.len();
        found.values().for_each(|path| unused::used(path));
        Ok(whole.then(|| found.into_values().collect()))
    })
    .await?
}

/// Has the host's pip fetch them, from wherever it is configured to.
async fn fetch(
    place: &Path,
    wheels: &Wheels,
    wanted: &Requirements,
    progress: &Progress,
) -> Result<(), Error> {
    let total = wanted.len() as u64;
    let title = format!("downloading {total} Python packages");
    progress.step(&title).await;
    let list = place.join("requirements.txt");
    fs::write(&list, wanted.text()).at("writing", &list)?;
    let mut pip = process::command("pip3");
    pip.args(["download", "--no-input", "--disable-pip-version-check"])
        .args(["--progress-bar", "off", "--no-deps", "--require-hashes"])
        .args(["--only-binary", ":all:", "--implementation", "cp"])
        .args(["--python-version", &wheels.python])
        .args(wheels.abis().flat_map(|abi| ["--abi".to_owned(), abi]))
        .args(
            wheels
                .platforms(std::env::consts::ARCH)
                .flat_map(|platform| ["--platform".to_owned(), platform]),
        )
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
        Err(Error::Program { last_lines, .. }) => Err(Error::Wheels {
            words: pips_words(&last_lines),
        }),
        result => result,
    }
}

/// The part of what pip says that is about its failure.
fn pips_words(lines: &str) -> String {
    let errors = lines
        .lines()
        .filter_map(|line| line.strip_prefix("ERROR: "));
    let errors: Vec<&str> = errors.collect();
    if errors.is_empty() {
        lines.to_owned()
    } else {
        errors.join("; ")
    }
}

/// Puts them in place in a container on top of `below`; gives the container's upper directory, in a directory of its own, and how
/// it is to be packed.
async fn install(
    shop: &Workshop,
    base: &Base,
    part: &Part<'_>,
    below: &[Digest],
    files: &[PathBuf],
    progress: &Progress,
) -> Result<(PathBuf, TreeOptions), Error> {
    let Part { name, wheels, .. } = *part;
    let total = files.len() as u64;
    let title = format!("installing {total} Python packages of the {name}");
    progress.step(&title).await;
    let directory = shop.site.fresh("wheels")?;
    let (tools, given, upper) = (
        directory.join("tools"),
        directory.join("given"),
        directory.join("upper"),
    );
    for path in [&given, &upper] {
        fs::create_dir(path).at("making", path)?;
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
    lay_out(&tools, &tools_of)?;
    let mut layers = shop.extracted(below).await?;
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
            Run {
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
                argv: [
                    "/usr/bin/python3",
                    "-I",
                    "/cloudroid/wheels.py",
                    "/cloudroid/job.json",
                    "/cloudroid/wheels",
                ]
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
        return Err(Error::Inside {
            what: "installing Python packages",
            last_lines: finished.last_words(),
        });
    }
    let options = TreeOptions {
        uid_offset: finished.uid_offset,
        overlay_upper: true,
        ..tree_options(base)
    };
    Ok((upper, options))
}

#[cfg(test)]
mod tests;
