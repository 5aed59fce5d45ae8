//! The base layer: created by mmdebstrap and made reproducible here.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use image::{Mtime, TreeOptions};
use package::system::parse_status;

use crate::archive::Archive;
use crate::base::Base;
use crate::cache::LayerEntry;
use crate::debian_package::Deb;
use crate::error::{Error, IoContext};
use crate::event::Progress;
use crate::key::Key;
use crate::process;
use crate::workshop::BuildContext;

/// Time to which all times in layers are clamped, and which programs that honour SOURCE_DATE_EPOCH take as the current
/// time: 2023-11-14, after the release of every distribution with ROS 1.
pub(crate) const EPOCH: u64 = 1_700_000_000;

/// Files that mmdebstrap copies from the host or leaves out, and that must be equal in every image.
const FILES: [(&str, &str); 4] = [
    ("etc/hosts", "127.0.0.1 localhost\n"),
    ("etc/hostname", "localhost\n"),
    ("etc/resolv.conf", ""),
    ("etc/machine-id", ""),
];

/// Returns the options for packing trees into layers.
pub(crate) fn tree_options(base: &Base) -> TreeOptions {
    TreeOptions {
        exclude: base.strip.paths.iter().map(|path| path.trim_start_matches('/').to_owned()).collect(),
        mtime: Mtime::Clamp(EPOCH),
        // For hundreds of megabytes: four times as fast as the default level, and 20 % larger.
        level: 1,
        ..TreeOptions::default()
    }
}

/// Resolves the packages of the base with the current lists. Cached, since apt takes seconds.
pub(crate) async fn resolve_base(shop: &BuildContext, archive: &Archive, base: &Base) -> Result<Vec<Deb>, Error> {
    let mut names: BTreeSet<String> = base.runtime.packages.iter().cloned().collect();
    // Added by mmdebstrap's minbase variant.
    names.extend(["?essential".to_owned(), "apt".to_owned()]);
    let note = Key::new("base-resolved").input("archive", &archive.stamp).inputs("package", &names).finish();
    if let Some(debs) = shop.layers.read_note(&note) {
        return Ok(debs);
    }
    let debs =
        archive.apt.resolve(None, &names).await.map_err(|error| explain_missing_packages(error, archive, base))?;
    shop.layers.write_note(&note, &debs)?;
    Ok(debs)
}

/// Explains a failure to install a base: most often the archive is not the one that the base is made for.
fn explain_missing_packages(error: Error, archive: &Archive, base: &Base) -> Error {
    let packages = base.runtime.packages.iter();
    let missing: Vec<&str> = packages.filter(|name| !archive.candidates.contains(name)).map(String::as_str).collect();
    match error {
        Error::Unsolvable { .. } if !missing.is_empty() => {
            Error::BaseLacks { base: base.name.clone(), missing: missing.join(", ") }
        }
        error => error,
    }
}

/// Returns the cache key of the base layer.
pub(crate) fn base_key(base: &Base, debs: &[Deb]) -> String {
    let mut names: Vec<String> = debs.iter().map(Deb::to_string).collect();
    names.sort();
    Key::new("base").input("system", base.system_key()).inputs("deb", names).finish()
}

/// Creates the base layer.
pub(crate) async fn make_base_layer(
    shop: &BuildContext,
    base: &Base,
    sources: &str,
    progress: &Progress,
) -> Result<LayerEntry, Error> {
    progress.step(&format!("bootstrapping base {} (once; about a minute)", base.name)).await;
    let root = shop.site.fresh_directory("base")?;
    let list = root.join("sources.list");
    fs::write(&list, sources).io_context("writing", &list)?;
    let tree = root.join("tree");
    let mut command = process::command("mmdebstrap");
    command
        .env("SOURCE_DATE_EPOCH", EPOCH.to_string())
        .env("PERL_HASH_SEED", "0")
        .env("TMPDIR", &root)
        .args(["--mode=root", "--variant=minbase", "--format=directory"])
        .arg(format!("--include={}", base.runtime.packages.join(",")))
        .args(base.strip.unpacked.iter().map(|rule| format!("--dpkgopt={rule}")))
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
    let status = installed_packages(&tree)?;
    progress.step("packing the base layer").await;
    let store = shop.layers.store().clone();
    let options = tree_options(base);
    let layer = crate::blocking::spawn(move || -> Result<_, Error> {
        normalize_tree(&tree)?;
        let layer = store.layer_from_tree(&tree, &options)?;
        foreign::remove(&root)?;
        Ok(layer)
    })
    .await??;
    Ok(LayerEntry { layer: Some(layer), made_from: status })
}

/// Makes the content independent of the host.
fn normalize_tree(tree: &Path) -> Result<(), Error> {
    for (name, text) in FILES {
        let path = tree.join(name);
        // It may be a link to somewhere on the host.
        match fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(Error::io("replacing", path, error));
            }
            _ => {}
        }
        fs::write(&path, text).io_context("writing", &path)?;
    }
    Ok(())
}

/// Returns `name=version:architecture` of every package installed in a tree according to dpkg, sorted.
pub(crate) fn installed_packages(tree: &Path) -> Result<Vec<String>, Error> {
    let path = tree.join("var/lib/dpkg/status");
    let text = fs::read_to_string(&path).io_context("reading", &path)?;
    let installed = parse_status(&text).map(|package| Deb {
        name: package.name,
        version: package.version,
        architecture: package.architecture,
    });
    let mut all: Vec<String> = installed.map(|deb| deb.to_string()).collect();
    all.sort();
    Ok(all)
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
        normalize_tree(tree.path()).expect("done");
        assert_eq!(fs::read_to_string(etc.join("hosts")).expect("there"), "127.0.0.1 localhost\n");
        assert_eq!(fs::read_to_string(etc.join("hostname")).expect("there"), "localhost\n");
        assert_eq!(fs::read_to_string(etc.join("resolv.conf")).expect("there"), "");
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
        assert_eq!(installed_packages(tree.path()).expect("read"), ["a=1:1-1:amd64", "b=2:all"]);
    }
}
