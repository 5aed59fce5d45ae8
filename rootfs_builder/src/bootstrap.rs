//! The base layer: mmdebstrap makes it, this makes it the same every time.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use image::{Mtime, TreeOptions};

use crate::apt::Deb;
use crate::archive::Archive;
use crate::base::Base;
use crate::cache::Entry;
use crate::error::{Error, IoAt};
use crate::event::Progress;
use crate::key::Key;
use crate::process;
use crate::workshop::Workshop;

/// All times in layers are clamped to this moment, and programs that honour SOURCE_DATE_EPOCH believe it is now:
/// 2023-11-14, after the release of every distribution with ROS 1.
pub(crate) const EPOCH: u64 = 1_700_000_000;

/// What mmdebstrap copies from the host or leaves out, and every image should have the same.
const FILES: [(&str, &str); 4] = [
    ("etc/hosts", "127.0.0.1 localhost\n"),
    ("etc/hostname", "localhost\n"),
    ("etc/resolv.conf", ""),
    ("etc/machine-id", ""),
];

/// How trees become layers here.
pub(crate) fn tree_options(base: &Base) -> TreeOptions {
    TreeOptions {
        exclude: base
            .strip
            .paths
            .iter()
            .map(|path| path.trim_start_matches('/').to_owned())
            .collect(),
        mtime: Mtime::Clamp(EPOCH),
        // Hundreds of megabytes: four times as fast as the default level, and a fifth larger.
        level: 1,
        ..TreeOptions::default()
    }
}

/// What the base will consist of, by the lists at hand. Remembered: apt takes seconds.
pub(crate) async fn resolve(
    shop: &Workshop,
    archive: &Archive,
    base: &Base,
) -> Result<Vec<Deb>, Error> {
    let mut names: BTreeSet<String> = base.runtime.packages.iter().cloned().collect();
    // What mmdebstrap's minbase adds.
    names.extend(["?essential".to_owned(), "apt".to_owned()]);
    let note = Key::new("base-resolved")
        .with("archive", &archive.stamp)
        .with_all("package", &names)
        .finish();
    if let Some(debs) = shop.layers.note(&note) {
        return Ok(debs);
    }
    let debs = archive
        .apt
        .resolve(None, &names)
        .await
        .map_err(|error| lacking(error, archive, base))?;
    shop.layers.keep_note(&note, &debs)?;
    Ok(debs)
}

/// Where apt cannot install a base, most often the archive is another one than it is made of.
fn lacking(error: Error, archive: &Archive, base: &Base) -> Error {
    let packages = base.runtime.packages.iter();
    let missing: Vec<&str> = packages
        .filter(|name| !archive.candidates.contains(name))
        .map(String::as_str)
        .collect();
    match error {
        Error::Unsolvable { .. } if !missing.is_empty() => Error::BaseLacks {
            base: base.name.clone(),
            missing: missing.join(", "),
        },
        error => error,
    }
}

/// Names the layer by what goes into it.
pub(crate) fn key(base: &Base, debs: &[Deb]) -> String {
    let mut names: Vec<String> = debs.iter().map(Deb::to_string).collect();
    names.sort();
    Key::new("base")
        .with("system", base.system_key())
        .with_all("deb", names)
        .finish()
}

/// Makes the base layer.
pub(crate) async fn make(
    shop: &Workshop,
    base: &Base,
    sources: &str,
    progress: &Progress,
) -> Result<Entry, Error> {
    progress
        .step(&format!(
            "bootstrapping base {} (once; about a minute)",
            base.name
        ))
        .await;
    let root = shop.site.fresh("base")?;
    let list = root.join("sources.list");
    fs::write(&list, sources).at("writing", &list)?;
    let tree = root.join("tree");
    let mut command = process::command("mmdebstrap");
    command
        .env("SOURCE_DATE_EPOCH", EPOCH.to_string())
        .env("PERL_HASH_SEED", "0")
        .env("TMPDIR", &root)
        .args(["--mode=root", "--variant=minbase", "--format=directory"])
        .arg(format!("--include={}", base.runtime.packages.join(",")))
        .args(
            base.strip
                .unpacked
                .iter()
                .map(|rule| format!("--dpkgopt={rule}")),
        )
        .arg("--aptopt=APT::Install-Recommends \"false\"")
        .arg(&base.suite)
        .arg(&tree)
        .arg(&list);
    let (mut lines, mut told) = crate::lines::channel();
    let forward = async {
        while let Some(line) = told.recv().await {
            progress.log(&line).await;
        }
    };
    let work = async {
        let result = process::run_in_namespaces(command, "mmdebstrap", |_, line| {
            lines.send(line.to_owned());
        })
        .await;
        drop(lines);
        result
    };
    let (result, ()) = tokio::join!(work, forward);
    result?;
    let status = installed(&tree)?;
    progress.step("packing the base layer").await;
    let store = shop.layers.store().clone();
    let options = tree_options(base);
    let layer = crate::blocking::spawn(move || -> Result<_, Error> {
        normalise(&tree)?;
        let layer = store.layer_from_tree(&tree, &options)?;
        foreign::remove(&root)?;
        Ok(layer)
    })
    .await??;
    Ok(Entry {
        layer: Some(layer),
        made_from: status,
    })
}

/// The same content on every host.
fn normalise(tree: &Path) -> Result<(), Error> {
    for (name, text) in FILES {
        let path = tree.join(name);
        // It may be a link to somewhere on the host.
        match fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(Error::io("replacing", path, error));
            }
            _ => {}
        }
        fs::write(&path, text).at("writing", &path)?;
    }
    Ok(())
}

/// `name=version:architecture` of every package that a tree's dpkg knows as installed, sorted.
pub(crate) fn installed(tree: &Path) -> Result<Vec<String>, Error> {
    let path = tree.join("var/lib/dpkg/status");
    let text = fs::read_to_string(&path).at("reading", &path)?;
    let mut all: Vec<String> = text.split("\n\n").filter_map(stanza).collect();
    all.sort();
    Ok(all)
}

fn stanza(text: &str) -> Option<String> {
    let field = |name: &str| {
        text.lines()
            .find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
    };
    (field("Status")? == "install ok installed").then_some(())?;
    let deb = Deb {
        name: field("Package")?.to_owned(),
        version: field("Version")?.to_owned(),
        architecture: field("Architecture")?.to_owned(),
    };
    Some(deb.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_host_left_is_replaced() {
        let tree = tempfile::tempdir().expect("a directory");
        let etc = tree.path().join("etc");
        fs::create_dir(&etc).expect("made");
        let outside = tree.path().join("outside");
        fs::write(&outside, "the host's").expect("written");
        std::os::unix::fs::symlink(&outside, etc.join("resolv.conf")).expect("linked");
        fs::write(etc.join("hostname"), "build-host-7\n").expect("written");
        normalise(tree.path()).expect("done");
        assert_eq!(
            fs::read_to_string(etc.join("hosts")).expect("there"),
            "127.0.0.1 localhost\n"
        );
        assert_eq!(
            fs::read_to_string(etc.join("hostname")).expect("there"),
            "localhost\n"
        );
        assert_eq!(
            fs::read_to_string(etc.join("resolv.conf")).expect("there"),
            ""
        );
        assert_eq!(fs::read_to_string(outside).expect("there"), "the host's");
    }

    #[test]
    fn only_installed_packages_count() {
        let tree = tempfile::tempdir().expect("a directory");
        let dpkg = tree.path().join("var/lib/dpkg");
        fs::create_dir_all(&dpkg).expect("made");
        fs::write(
            dpkg.join("status"),
            "Package: b\nStatus: install ok installed\nVersion: 2\nArchitecture: all\n\n\
             Package: gone\nStatus: deinstall ok config-files\nVersion: 1\nArchitecture: all\n\n\
             Package: a\nStatus: install ok installed\nArchitecture: amd64\nVersion: 1:1-1\n",
        )
        .expect("written");
        assert_eq!(
            installed(tree.path()).expect("read"),
            ["a=1:1-1:amd64", "b=2:all"]
        );
    }
}
